"""The second moment matrix of a particle's neighbours, and the fullness of the neighbourhood.

The inverse of the moment matrix corrects gradients (Bonet and Lok 1999). The fullness is a number from the invariants
of the matrix: 1 inside the fluid, about 0.6 at a flat surface, and 0 if neighbours lie on a line or are missing.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from cortado.device.modules import by_name
from cortado.device.precision import FLOAT32, Precision

ROUNDING = 64.0
"""Regularisation of the fullness against round-off, in units of the last place."""


@cache
def cross_terms_function(precision: Precision) -> Any:
    vector = precision.vector

    @wp.func
    def cross_terms(a: vector, b: vector) -> vector:
        return vector(a[1] * b[2], a[0] * b[2], a[0] * b[1])

    return cross_terms


@cache
def symmetric(precision: Precision) -> SimpleNamespace:
    """A symmetric matrix is stored as its diagonal and its components yz, xz and xy."""
    vector, matrix, six = precision.vector, precision.matrix, precision.six

    @wp.func
    def pack(M: matrix) -> six:
        return six(M[0, 0], M[1, 1], M[2, 2], M[1, 2], M[0, 2], M[0, 1])

    @wp.func
    def times(M: six, v: vector) -> vector:
        return vector(
            M[0] * v[0] + M[5] * v[1] + M[4] * v[2],
            M[5] * v[0] + M[1] * v[1] + M[3] * v[2],
            M[4] * v[0] + M[3] * v[1] + M[2] * v[2],
        )

    return SimpleNamespace(kind=six, pack=pack, times=times)


@cache
def moment_functions(precision: Precision, dimension: int) -> SimpleNamespace:
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    plane, tiny = wp.constant(real(float(dimension == 2))), wp.constant(real(1e-12))
    rounding = wp.constant(real(ROUNDING * float(np.finfo(precision.numpy).eps) * (dimension == 3)))

    @wp.func
    def change(diagonal: vector, others: vector) -> matrix:
        x, y, z = others[0], others[1], others[2]
        return matrix(diagonal[0], z, y, z, diagonal[1], x, y, x, diagonal[2])

    @wp.func
    def whole(diagonal: vector, others: vector) -> matrix:
        return change(diagonal + vector(real(0.0), real(0.0), plane), others)

    @wp.func
    def fullness(M: matrix) -> real:
        product = M[0, 0] * M[1, 1] + M[1, 1] * M[2, 2] + M[2, 2] * M[0, 0]
        I_2 = product - M[0, 1] * M[0, 1] - M[1, 2] * M[1, 2] - M[0, 2] * M[0, 2]
        I_3, trace = wp.determinant(M), wp.trace(M)
        return (real(3.0) - plane) * I_3 / (I_2 - plane * I_3 + rounding * trace * trace + tiny)

    @wp.func
    def inverse(M: matrix) -> matrix:
        a = M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1]
        b = M[0, 2] * M[2, 1] - M[0, 1] * M[2, 2]
        c = M[0, 1] * M[1, 2] - M[0, 2] * M[1, 1]
        e = M[0, 0] * M[2, 2] - M[0, 2] * M[2, 0]
        f = M[0, 2] * M[1, 0] - M[0, 0] * M[1, 2]
        h = M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]
        per = real(1.0) / (M[0, 0] * a + M[1, 0] * b + M[2, 0] * c)
        return per * matrix(a, b, c, b, e, f, c, f, h)

    @wp.func
    def smoothstep(value: real, first: real, second: real) -> real:
        t = wp.clamp((value - first) / (second - first), real(0.0), real(1.0))
        return t * t * (real(3.0) - real(2.0) * t)

    return by_name(whole, change, fullness, inverse, smoothstep)


def round_off(precision: Precision) -> float:
    """Return the relative residual at which an iterative solve reaches round-off."""
    return 3e-7 if precision is FLOAT32 else 1e-14
