"""The second moment M = -V sum_j grad W_ij x_ij^T of a particle's neighbours, whose inverse corrects gradients (Bonet
and Lok 1999), the fullness of a neighbourhood, and conjugate gradients.

With the invariants I_2 and I_3 of M, the fullness is H = 3 I_3 / I_2, in the plane 2 det M / tr M: 1 inside, about 0.6
at a flat surface, and 0 where neighbours lie on a line or are missing. On a line I_2 and I_3 are pure round-off;
`ROUNDING` (tr M)^2 is added to I_2 so that H is 0.

Conjugate gradients (Hestenes and Stiefel 1952) solve B y = r for numbers or vectors of particles. B is symmetric and
positive definite in the product sum_i w_i a_i . b_i with weights w, which defines all norms here. A scene of a batch
iterates until |r| has fallen to a given part of the first |r|.
"""

from collections.abc import Callable, Sequence
from functools import cache
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
import warp as wp

from cortado.device.launching import Named
from cortado.device.modules import by_name, kernel_module
from cortado.device.precision import FLOAT32, Precision, TypesByName
from cortado.device.reduction import type_name
from cortado.particles.state import Layout, zeros
from cortado.sph.parts import StepContext

ROUNDING = 64.0
"""Multiple of (tr M)^2 that is added to I_2, in units of the last place of 1."""


@cache
def cross_terms_function(precision: Precision) -> Any:
    vector = precision.vector

    @wp.func
    def cross_terms(a: vector, b: vector) -> vector:
        return vector(a[1] * b[2], a[0] * b[2], a[0] * b[1])

    return cross_terms


@cache
def symmetric(precision: Precision) -> SimpleNamespace:
    """Make functions of symmetric matrices stored as six numbers: diagonal and entries yz, xz and xy. ``kind`` is the
    Warp type, ``pack`` converts a 3 x 3 matrix, ``times`` is the product with a vector."""
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
        """Return M from its diagonal and its other entries; in the plane M_zz is 1, without effect in the plane."""
        return change(diagonal + vector(real(0.0), real(0.0), plane), others)

    @wp.func
    def fullness(M: matrix) -> real:
        """Return H; ``tiny`` avoids 0 / 0 for particles without neighbours, where H is 0."""
        product = M[0, 0] * M[1, 1] + M[1, 1] * M[2, 2] + M[2, 2] * M[0, 0]
        I_2 = product - M[0, 1] * M[0, 1] - M[1, 2] * M[1, 2] - M[0, 2] * M[0, 2]
        I_3, trace = wp.determinant(M), wp.trace(M)
        return (real(3.0) - plane) * I_3 / (I_2 - plane * I_3 + rounding * trace * trace + tiny)

    @wp.func
    def inverse(M: matrix) -> matrix:
        """Return M^-1 by cofactors: the derivative of the determinant with respect to M must not be 0."""
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


@cache
def solve_kernels(precision: Precision, kind: Any) -> SimpleNamespace:
    """Make the kernels of conjugate gradients for numbers or vectors; ``going`` (members,) is 1 for scenes that
    iterate. ``begin`` and ``start`` begin a solve, ``descend`` takes a step along p, ``turn`` computes the next p,
    ``decide`` ends scenes."""
    real = precision.real
    module = kernel_module(f"conjugate_gradients_{type_name(kind)}")
    typed = TypesByName(real, {kind: "r p y product", wp.int32: "count going active"})
    dot = wp.mul if kind is real else wp.dot

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def begin(w, r, p, y, share):
        i = wp.tid()
        p[i] = r[i]
        y[i] = kind(real(0.0))
        share[i] = w[i] * dot(r[i], r[i])

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def start(total, first, size, count, going, active):
        b = wp.tid()
        first[b] = total[b]
        size[b] = total[b]
        count[b] = 0
        going[b] = 0
        if total[b] > real(0.0):
            going[b] = 1
            wp.atomic_add(active, 0, 1)

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def descend(particles: int, going, size, curvature, w, p, product, y, r, share):
        i = wp.tid()
        b = i // particles
        if going[b] == 0:
            return
        step = size[b] / curvature[b]
        left = r[i] - step * product[i]
        y[i] = y[i] + step * p[i]
        r[i] = left
        share[i] = w[i] * dot(left, left)

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def turn(particles: int, going, size, total, r, p):
        i = wp.tid()
        b = i // particles
        if going[b] == 1:
            p[i] = r[i] + (total[b] / size[b]) * p[i]

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def decide(tolerance: real, most: int, total, first, size, count, going, active):
        b = wp.tid()
        if going[b] == 0:
            return
        size[b] = total[b]
        count[b] = count[b] + 1
        if count[b] >= most or not total[b] > tolerance * tolerance * first[b]:
            going[b] = 0
            wp.atomic_sub(active, 0, 1)

    return by_name(begin, start, descend, turn, decide)


def round_off(precision: Precision) -> float:
    """Return the ratio |r| / first |r| below which a solve improves no further."""
    return 3e-7 if precision is FLOAT32 else 1e-14


class Rows(Protocol):
    """Further unknowns of a solve, a few for each scene. All methods except `begin` act in scenes that are ``going``,
    and add the rows' terms to a sum (members,) over particles."""

    def begin(self, step: StepContext, total: wp.array) -> None:
        """Set the unknowns to 0, and add the square of the residual."""

    def multiply(self, step: StepContext, curvature: wp.array) -> None:
        """Write the rows of B p, and add their part of the product p^T B p."""

    def descend(self, step: StepContext, scene: Named, total: wp.array) -> None:
        """Take a step along p, and add the square of the new residual; ``scene`` has kernel arguments per scene."""

    def turn(self, step: StepContext, scene: Named, total: wp.array) -> None:
        """Write the next p."""


class ConjugateGradients:
    def __init__(self, layout: Layout, kind: Any, tolerance: float, most: int):
        """Prepare solves for a Warp ``kind`` that end at |r| <= ``tolerance`` |first r|, or after ``most``
        iterations."""
        real = layout.precision.real
        self._kernels, self._layout = solve_kernels(layout.precision, kind), layout
        self._limits = {"tolerance": tolerance, "most": most}
        self._sizes = {"particles": layout.particles}
        self._own = layout.arrays(p=kind, product=kind, share=real)
        kinds = {"first": real, "size": real, "count": wp.int32, "going": wp.int32}
        self._scenes = zeros({name: (layout.members, one) for name, one in kinds.items()}, layout.device)
        self.count = self._scenes["count"]
        self._active = wp.zeros(1, dtype=wp.int32, device=layout.device)
        self._sums = layout.sum_of(real), layout.sum_of(real)

    def solve(
        self,
        step: StepContext,
        multiply: Callable[[wp.array, dict[str, wp.array]], None],
        w: wp.array,
        r: wp.array,
        y: wp.array,
        rows: Sequence[Rows] = (),
    ) -> None:
        """Write to ``y`` the solution of B y = r, (n,) both, with weights ``w``, and overwrite ``r``.

        ``multiply`` takes p and a dictionary of arrays: it writes B p to ``product`` and each particle's w p B p to
        ``share``. Further ``rows`` of B belong to the same system.
        """
        kernels, members, (sum_shares, sum_curvatures) = self._kernels, self._layout.members, self._sums
        n = self._layout.all_particles
        own, scene = {**self._own, "w": w, "r": r, "y": y}, {**self._scenes, "active": self._active}
        p, product, share = self._own.values()
        step.launch(kernels.begin, own, threads=n)
        self._active.zero_()
        total = sum_shares(share)
        for row in rows:
            row.begin(step, total)
        step.launch(kernels.start, scene, total=total, threads=members)

        def iterate() -> None:
            multiply(p, {"product": product, "share": share})
            curvature = sum_curvatures(share)
            for row in rows:
                row.multiply(step, curvature)
            known = {**scene, "curvature": curvature}
            step.launch(kernels.descend, known, own, self._sizes, threads=n)
            total = sum_shares(share)
            for row in rows:
                row.descend(step, known, total)
            step.launch(kernels.turn, scene, own, self._sizes, total=total, threads=n)
            for row in rows:
                row.turn(step, scene, total)
            step.launch(kernels.decide, scene, self._limits, total=total, threads=members)

        step.join()  # a loop of a graph cannot begin while something is computed aside
        wp.capture_while(self._active, iterate)
