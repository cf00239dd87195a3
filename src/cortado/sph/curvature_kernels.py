"""Surface tension by curvature: a force across the surface (the continuum surface force of Brackbill et al. 1992) with
smoothed normals and a corrected curvature (Morris 2000; Zorilla et al. 2020).

With g_ij = V grad W_ij, sums over the fluid and the particle itself, the spacing s, and S(a, b) a smoothstep from a to
b:

    g_i = sum_j g_ij,   z_i = V sum_j W_ij,   q_i = V sum_j W_ij g_j / z_i,
    w_i = S(0.03, 0.1) of s |q_i|,   e_i = q_i / |q_i|,
    B_i = -sum_j w_j g_ij x_ij^T,   D_i = sum_j w_j (e_j - e_i) g_ij^T,   kappa_i = -tr(B_i^-1 D_i),
    a_i = V sum_j W_ij w_j kappa_j,   b_i = V sum_j W_ij w_j,
    k_i = (a_i / b_i) / (1 + delta a_i / b_i),   m_i times the acceleration = (sigma / J) k_i w_i q_i.

g is the gradient of the colour of the fluid, which is 1 in it and 0 outside; q, its average (Shepard 1968), points into
the fluid and forgets how the particles of a surface lie. w tells the surface from the inside, e is its normal, and D
B^-1 the gradient of normals, corrected so that it is exact where they are linear (Bonet and Lok 1999). The particles
that feel the force lie a mean depth delta below the surface, where a curvature of 1 / R is 1 / (R - delta): k is that
of the surface. Over the layers of a flat surface w |q| adds up to J. For delta and J see
`cortado.sph.curvature`.

D comes as its symmetric part, which is all that the trace needs.

Tangents go the way of the sums, adjoints from the last one to the first: what the adjoint of one adds to those of q, w,
e, c, g and z, the next one takes up.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import Kernels
from cortado.device.precision import Precision, TypesByName
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.particle_kernels import over, particle_kernel, sum_kernel
from cortado.sph.curvature import curvature_functions, curvature_sums
from cortado.sph.moment_functions import matrix_type, moment_functions


def entries(precision: Precision) -> dict[str, Any]:
    """Return names and types of the arrays of particles that surface tension by curvature keeps, with c = w kappa."""
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    vectors, matrices, numbers = dict.fromkeys("gqe", vector), dict.fromkeys("BD", matrix), dict.fromkeys("zwcab", real)
    return {**vectors, **matrices, **numbers}


@dataclass(frozen=True)
class CurvatureKernels:
    """The kernels of the four sums, each with its tangent and its adjoint, which comes after those of the later sums.
    The adjoint of ``mean`` has a first part without neighbours."""

    colour: Kernels
    normal: Kernels
    bend: Kernels
    mean: Kernels


@cache
def curvature_kernels(discretisation: Discretisation, dimension: int) -> CurvatureKernels:
    """Make the kernels of tension by curvature, in 2 or 3 dimensions; ``depth`` is delta and ``per_width`` 1 / J."""
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    matrix, sums = matrix_type(precision), curvature_sums(discretisation)
    moments = moment_functions(precision, dimension)
    whole, even = moments.whole, moments.change
    topic = f"surface_curvature_{dimension}d"
    module = discretisation.module(True, topic)
    own = curvature_functions(precision, dimension, module)
    normal_of, curvature_of, outermost = own.normal, own.curvature, own.outermost

    @particle_kernel(module, "g z", [over(sums.colour.forward, "g others")])
    def colour(i: int, g: vector, others: real, s: neighbourhood) -> tuple[vector, real]:
        return g, others + real(1 - s.filling[i]) * s.self_weight * s.volume

    @particle_kernel(module, "q w e", [over(sums.average.forward, "others")], numbers=["spacing"])
    def normal(
        i: int, others: vector, spacing: real, g_i: vector, z_i: real, s: neighbourhood
    ) -> tuple[vector, real, vector]:
        q = (others + (real(1 - s.filling[i]) * s.self_weight * s.volume) * g_i) / z_i
        w, e = normal_of(q, spacing)
        return q, w, e

    @particle_kernel(module, "B D c", [over(sums.bend.forward, "diagonal others turned mixed")])
    def bend(diagonal: vector, others: vector, turned: vector, mixed: vector, w_i: real) -> tuple[matrix, matrix, real]:
        B, D = whole(diagonal, others), even(turned, mixed)
        return B, D, w_i * curvature_of(B, D)

    @particle_kernel(
        module,
        "a b acceleration:acceleration_in",
        [over(sums.mean.forward, "others_a others_b")],
        numbers=["depth", "per_width"],
    )
    def mean(
        i: int,
        others_a: real,
        others_b: real,
        depth: real,
        per_width: real,
        surface_tension: real,
        m_i: real,
        q_i: vector,
        w_i: real,
        c_i: real,
        s: neighbourhood,
    ) -> tuple[real, real, vector]:
        self_weight = real(1 - s.filling[i]) * s.self_weight * s.volume
        a, b = others_a + self_weight * c_i, others_b + self_weight * w_i
        strength = surface_tension * per_width / m_i
        return a, b, (strength * outermost(a, b, depth) * w_i) * q_i

    made = discretisation, dimension, topic
    three = zip((colour, normal, bend, mean), curvature_tangents(*made), curvature_adjoints(*made), strict=True)
    return CurvatureKernels(*(Kernels(*each) for each in three))


@cache
def curvature_tangents(discretisation: Discretisation, dimension: int, topic: str) -> tuple[Any, ...]:
    """Make the tangents of the four curvature kernels, in 2 or 3 dimensions, in the Warp module of a topic."""
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    matrix, sums = matrix_type(precision), curvature_sums(discretisation)
    even = moment_functions(precision, dimension).change
    module = discretisation.tangent_module(topic)
    own = curvature_functions(precision, dimension, module)
    normal_work, curvature_of, outermost = own.normal_work, own.curvature, own.outermost

    @particle_kernel(module, "q_dot w_dot e_dot", [over(sums.average.tangent, "others")], numbers=["spacing"])
    def normal_tangent(
        i: int, others: vector, spacing: real, g_dot_i: vector, z_i: real, z_dot_i: real, q_i: vector, s: neighbourhood
    ) -> tuple[vector, real, vector]:
        own_part = (real(1 - s.filling[i]) * s.self_weight * s.volume) * g_dot_i
        q_dot = (others + own_part - z_dot_i * q_i) / z_i
        w_by_q, _spacing, _w, _e = wp.grad(normal_work)(q_i, spacing, real(1.0), vector())
        e_dot, _spacing, _w, _e = wp.grad(normal_work)(q_i, spacing, real(0.0), q_dot)
        return q_dot, wp.dot(w_by_q, q_dot), e_dot

    @particle_kernel(module, "c_dot", [over(sums.bend.tangent, "diagonal others turned mixed")])
    def bend_tangent(
        diagonal: vector,
        others: vector,
        turned: vector,
        mixed: vector,
        w_i: real,
        w_dot_i: real,
        B_i: matrix,
        D_i: matrix,
    ) -> real:
        by_B, by_D = wp.grad(curvature_of)(B_i, D_i)
        kappa_dot = wp.ddot(by_B, even(diagonal, others)) + wp.ddot(by_D, even(turned, mixed))
        return w_dot_i * curvature_of(B_i, D_i) + w_i * kappa_dot

    @particle_kernel(
        module,
        "acceleration_dot:acceleration_in_dot",
        [over(sums.mean.tangent, "others_a others_b")],
        numbers=["depth", "per_width"],
    )
    def mean_tangent(
        i: int,
        others_a: real,
        others_b: real,
        depth: real,
        per_width: real,
        surface_tension: real,
        surface_tension_dot: real,
        m_i: real,
        m_dot_i: real,
        q_i: vector,
        q_dot_i: vector,
        w_i: real,
        w_dot_i: real,
        c_dot_i: real,
        a_i: real,
        b_i: real,
        s: neighbourhood,
    ) -> vector:
        self_weight = real(1 - s.filling[i]) * s.self_weight * s.volume
        a_dot, b_dot = others_a + self_weight * c_dot_i, others_b + self_weight * w_dot_i
        k = outermost(a_i, b_i, depth)
        by_a, by_b, _by_depth = wp.grad(outermost)(a_i, b_i, depth)
        k_dot = by_a * a_dot + by_b * b_dot
        strength = surface_tension * per_width / m_i
        strength_dot = (surface_tension_dot * per_width - strength * m_dot_i) / m_i
        along = strength_dot * k * w_i + strength * (k_dot * w_i + k * w_dot_i)
        return along * q_i + (strength * k * w_i) * q_dot_i

    return (
        sum_kernel("colour_tangent", module, "g_dot z_dot", sums.colour.tangent),
        normal_tangent,
        bend_tangent,
        mean_tangent,
    )


@cache
def curvature_adjoints(discretisation: Discretisation, dimension: int, topic: str) -> tuple[Any, ...]:
    """Make the adjoints of the four curvature kernels; the last has two, the first of which has no neighbours."""
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    matrix, sums = matrix_type(precision), curvature_sums(discretisation)
    module = discretisation.module(False, topic)
    own = curvature_functions(precision, dimension, module)
    normal_work, curvature_of, outermost = own.normal_work, own.curvature, own.outermost

    typed = TypesByName(real, {vector: "q acceleration x e", matrix: "B D", neighbourhood: "s"})

    @particle_kernel(module, "+m_bar +surface_tension_bar q_bar w_bar a_bar b_bar", numbers=["depth", "per_width"])
    @typed
    def force_adjoint(
        depth, per_width, surface_tension, m_i, q_i, w_i, a_i, b_i, acceleration_bar_i
    ) -> tuple[real, real, vector, real, real, real]:
        """Turn the adjoint of the acceleration into those of a particle's own m, sigma, q, w, a and b."""
        k = outermost(a_i, b_i, depth)
        by_a, by_b, _by_depth = wp.grad(outermost)(a_i, b_i, depth)
        strength, work = surface_tension * per_width / m_i, wp.dot(q_i, acceleration_bar_i)
        return (
            -strength * k * w_i * work / m_i,
            per_width / m_i * k * w_i * work,
            (strength * k * w_i) * acceleration_bar_i,
            strength * k * work,
            strength * w_i * work * by_a,
            strength * w_i * work * by_b,
        )

    @particle_kernel(
        module, "+x_bar +w_bar B_bar D_bar", [over(sums.mean.adjoint, "c_part w_part x_part", a="a_bar", b="b_bar")]
    )
    @typed
    def mean_adjoint(
        i: int, c_part, w_part, x_part, w_i, a_bar_i, b_bar_i, B_i, D_i, s
    ) -> tuple[vector, real, matrix, matrix]:
        """Turn the adjoints of a and b into those of B and D, and add to those of x and w."""
        self_weight = real(1 - s.filling[i]) * s.self_weight * s.volume
        c_bar = c_part + self_weight * a_bar_i
        by_B, by_D = wp.grad(curvature_of)(B_i, D_i)
        half = real(0.5) * w_i * c_bar  # of each matrix and of its transpose, as both are symmetric
        w_bar = w_part + self_weight * b_bar_i + curvature_of(B_i, D_i) * c_bar
        return x_part, w_bar, half * (by_B + wp.transpose(by_B)), half * (by_D + wp.transpose(by_D))

    @particle_kernel(module, "+x_bar r z_bar", [over(sums.bend.adjoint, "e_bar w_part x_part")], numbers=["spacing"])
    @typed
    def bend_adjoint(e_bar, w_part, x_part, spacing, q_i, z_i, w_bar_i, q_bar_i) -> tuple[vector, vector, real]:
        """Turn the adjoints of B, D, w and q into those of z and of V sum W_ij g_j, which is r."""
        by_q, _spacing, _w, _e = wp.grad(normal_work)(q_i, spacing, w_bar_i + w_part, e_bar)
        r = (q_bar_i + by_q) / z_i
        return x_part, r, -wp.dot(q_i, r)

    @particle_kernel(module, "g_bar +x_bar", [over(sums.average.adjoint, "g_part x_part")])
    def normal_adjoint(i: int, g_part: vector, x_part: vector, r_i: vector, s: neighbourhood) -> tuple[vector, vector]:
        return g_part + (real(1 - s.filling[i]) * s.self_weight * s.volume) * r_i, x_part

    colour_adjoint = sum_kernel("colour_adjoint", module, "+x_bar", sums.colour.adjoint)
    return colour_adjoint, normal_adjoint, bend_adjoint, (force_adjoint, mean_adjoint)
