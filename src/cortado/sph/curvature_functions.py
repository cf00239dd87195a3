"""What surface tension by curvature makes of the sums over a particle's neighbours, see
`cortado.sph.curvature_kernels`."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.sph.moment_functions import matrix_type, moment_functions

FAINT, CLEAR = 0.03, 0.1
"""s |q| below which a particle is no part of the surface, and above which all of it is."""
SINGULAR = {2: 1e-3, 3: 1e-4}
"""By dimension, what is added to det B: neighbours may lie on a line, or be missing. There kappa is 0."""
LONE = 1e-6
"""What is added to sum V W w: where no neighbour is part of the surface, the mean curvature is 0."""
HOLLOW = 0.25
"""delta kappa below which the depth of a hollow surface counts less, in a parabola, until it counts no more: bubbles of
a radius below 3 delta, which the divisor 1 + delta kappa would be 0 in."""


@dataclass(frozen=True)
class CurvatureFunctions:
    """Warp functions of one particle."""

    normal: Any
    """w and e of q and the spacing."""
    normal_tangent: Any
    """Their tangents, of q, the spacing and the tangent of q."""
    normal_back: Any
    """The adjoint of q, of q, the spacing and the adjoints of w and e."""
    curvature: Any
    """kappa of B and D."""
    curvature_back: Any
    """kappa and the symmetric adjoints of B and D, for that of kappa; a tangent follows from those for 1."""
    outermost: Any
    """k of a, b and delta."""
    outermost_back: Any
    """The derivatives of k by a and b."""


@cache
def curvature_functions(precision: Precision, dimension: int, module: Any) -> CurvatureFunctions:
    """In 2 or 3 dimensions, in a Warp module."""
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    smoothstep = moment_functions(precision, dimension).smoothstep
    faint, clear = wp.constant(real(FAINT)), wp.constant(real(CLEAR))
    singular, lone, hollow = wp.constant(real(SINGULAR[dimension])), wp.constant(real(LONE)), wp.constant(real(HOLLOW))

    @wp.func
    def rise(size: real) -> real:
        """The derivative of w by s |q|."""
        t = wp.clamp((size - faint) / (clear - faint), real(0.0), real(1.0))
        return real(6.0) * t * (real(1.0) - t) / (clear - faint)

    @wp.func
    def normal(q: vector, spacing: real):
        """Where w is 0, e is 0, as nothing depends on it."""
        size, w, e = wp.length(q), real(0.0), vector()
        if size * spacing > faint:
            w = smoothstep(size * spacing, faint, clear)
            e = q / size
        return w, e

    @wp.func
    def normal_tangent(q: vector, spacing: real, q_dot: vector):
        size, w_dot, e_dot = wp.length(q), real(0.0), vector()
        if size * spacing > faint:
            along = wp.dot(q, q_dot) / size
            w_dot = rise(size * spacing) * spacing * along
            e_dot = (q_dot - (along / size) * q) / size
        return w_dot, e_dot

    @wp.func
    def normal_back(q: vector, spacing: real, w_bar: real, e_bar: vector) -> vector:
        size, q_bar = wp.length(q), vector()
        if size * spacing > faint:
            along = rise(size * spacing) * spacing * w_bar - wp.dot(q, e_bar) / (size * size)
            q_bar = (e_bar + along * q) / size
        return q_bar

    @wp.func(module=module)
    def curvature(B: matrix, D: matrix) -> real:
        """-tr(B^-1 D), by cofactors."""
        a = B[1, 1] * B[2, 2] - B[1, 2] * B[2, 1]
        b = B[0, 2] * B[2, 1] - B[0, 1] * B[2, 2]
        c = B[0, 1] * B[1, 2] - B[0, 2] * B[1, 1]
        e = B[0, 0] * B[2, 2] - B[0, 2] * B[2, 0]
        f = B[0, 2] * B[1, 0] - B[0, 0] * B[1, 2]
        h = B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0]
        part = a * D[0, 0] + e * D[1, 1] + h * D[2, 2] + b * (D[0, 1] + D[1, 0])
        part += c * (D[0, 2] + D[2, 0]) + f * (D[1, 2] + D[2, 1])
        return -part / (B[0, 0] * a + B[1, 0] * b + B[2, 0] * c + singular)

    @wp.func(module=module)
    def curvature_back(B: matrix, D: matrix, bar: real):
        by_B, by_D = wp.grad(curvature)(B, D)
        return (
            curvature(B, D),
            (real(0.5) * bar) * (by_B + wp.transpose(by_B)),
            (real(0.5) * bar) * (by_D + wp.transpose(by_D)),
        )

    @wp.func(module=module)
    def outermost(a: real, b: real, depth: real) -> real:
        mean = a / (b + lone)
        more = depth * mean
        rest = wp.clamp(real(3.0) * hollow + more, real(0.0), real(2.0) * hollow)
        divisor = real(1.0) - real(2.0) * hollow + rest * rest / (real(4.0) * hollow) + wp.max(more + hollow, real(0.0))
        return mean / divisor

    @wp.func(module=module)
    def outermost_back(a: real, b: real, depth: real):
        by_a, by_b, _by_depth = wp.grad(outermost)(a, b, depth)
        return by_a, by_b

    return CurvatureFunctions(
        *(normal, normal_tangent, normal_back), *(curvature, curvature_back), *(outermost, outermost_back)
    )
