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

from functools import cache
from types import SimpleNamespace
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


@cache
def curvature_kernels(discretisation: Discretisation, dimension: int) -> SimpleNamespace:
    """Make the kernels of the four sums ``colour``, ``normal``, ``bend`` and ``mean``, in 2 or 3 dimensions, each with
    its tangent and its adjoint, which comes after those of the later sums. The adjoint of ``mean`` has a first part
    without neighbours. ``depth`` is delta and ``per_width`` 1 / J."""
    precision, (real, vector, _) = discretisation.precision, discretisation.types
    matrix, sums, typed = matrix_type(precision), curvature_sums(discretisation), types_of(discretisation)
    moments = moment_functions(precision, dimension)
    whole, even = moments.whole, moments.change
    topic = f"surface_curvature_{dimension}d"
    module = discretisation.module(True, topic)
    own = curvature_functions(precision, dimension, module)
    normal_of, curvature_of, outermost = own.normal, own.curvature, own.outermost

    @particle_kernel(module, "g z", [over(sums.colour.forward, "g z_part")])
    @typed
    def colour(i: int, g, z_part, s) -> tuple[vector, real]:
        return g, z_part + real(1 - s.filling[i]) * s.self_weight * s.volume

    @particle_kernel(module, "q w e", [over(sums.average.forward, "others")], numbers=["spacing"])
    @typed
    def normal(i: int, others, spacing, g_i, z_i, s) -> tuple[vector, real, vector]:
        q = (others + (real(1 - s.filling[i]) * s.self_weight * s.volume) * g_i) / z_i
        w, e = normal_of(q, spacing)
        return q, w, e

    @particle_kernel(module, "B D c", [over(sums.bend.forward, "diagonal others turned mixed")])
    @typed
    def bend(diagonal, others, turned, mixed, w_i) -> tuple[matrix, matrix, real]:
        B, D = whole(diagonal, others), even(turned, mixed)
        return B, D, w_i * curvature_of(B, D)

    means, constants = over(sums.mean.forward, "a_part b_part"), ["depth", "per_width"]

    @particle_kernel(module, "a b acceleration:acceleration_in", [means], numbers=constants)
    @typed
    def mean(
        i: int, a_part, b_part, depth, per_width, surface_tension, m_i, q_i, w_i, c_i, s
    ) -> tuple[real, real, vector]:
        self_weight = real(1 - s.filling[i]) * s.self_weight * s.volume
        a, b = a_part + self_weight * c_i, b_part + self_weight * w_i
        strength = surface_tension * per_width / m_i
        return a, b, (strength * outermost(a, b, depth) * w_i) * q_i

    made = discretisation, dimension, topic
    three = zip((colour, normal, bend, mean), curvature_tangents(*made), curvature_adjoints(*made), strict=True)
    names = ("colour", "normal", "bend", "mean")
    return SimpleNamespace(**{name: Kernels(*each) for name, each in zip(names, three, strict=True)})


def types_of(discretisation: Discretisation) -> TypesByName:
    """Return the Warp types, by name, of what kernels of tension by curvature compute with."""
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    vectors = "q g r x e diagonal others turned mixed acceleration"
    return TypesByName(real, {vector: vectors, matrix_type(precision): "B D", neighbourhood: "s"})


@cache
def curvature_tangents(discretisation: Discretisation, dimension: int, topic: str) -> tuple[Any, ...]:
    """Make the tangents of the four curvature kernels, in 2 or 3 dimensions, in the Warp module of a topic."""
    precision, (real, vector, _) = discretisation.precision, discretisation.types
    sums, typed = curvature_sums(discretisation), types_of(discretisation)
    even = moment_functions(precision, dimension).change
    module = discretisation.tangent_module(topic)
    own = curvature_functions(precision, dimension, module)
    normal_work, curvature_of, outermost = own.normal_work, own.curvature, own.outermost

    @particle_kernel(module, "q_dot w_dot e_dot", [over(sums.average.tangent, "others")], numbers=["spacing"])
    @typed
    def normal_tangent(i: int, others, spacing, g_dot_i, z_i, z_dot_i, q_i, s) -> tuple[vector, real, vector]:
        own_part = (real(1 - s.filling[i]) * s.self_weight * s.volume) * g_dot_i
        q_dot = (others + own_part - z_dot_i * q_i) / z_i
        w_by_q, _spacing, _w, _e = wp.grad(normal_work)(q_i, spacing, real(1.0), vector())
        e_dot, _spacing, _w, _e = wp.grad(normal_work)(q_i, spacing, real(0.0), q_dot)
        return q_dot, wp.dot(w_by_q, q_dot), e_dot

    @particle_kernel(module, "c_dot", [over(sums.bend.tangent, "diagonal others turned mixed")])
    @typed
    def bend_tangent(diagonal, others, turned, mixed, w_i, w_dot_i, B_i, D_i) -> real:
        by_B, by_D = wp.grad(curvature_of)(B_i, D_i)
        kappa_dot = wp.ddot(by_B, even(diagonal, others)) + wp.ddot(by_D, even(turned, mixed))
        return w_dot_i * curvature_of(B_i, D_i) + w_i * kappa_dot

    means, constants = over(sums.mean.tangent, "a_part b_part"), ["depth", "per_width"]

    @particle_kernel(module, "acceleration_dot:acceleration_in_dot", [means], numbers=constants)
    @typed
    def mean_tangent(
        i: int,
        a_part,
        b_part,
        depth,
        per_width,
        surface_tension,
        surface_tension_dot,
        m_i,
        m_dot_i,
        q_i,
        q_dot_i,
        w_i,
        w_dot_i,
        c_dot_i,
        a_i,
        b_i,
        s,
    ) -> vector:
        self_weight = real(1 - s.filling[i]) * s.self_weight * s.volume
        a_dot, b_dot = a_part + self_weight * c_dot_i, b_part + self_weight * w_dot_i
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
    precision, (real, vector, _) = discretisation.precision, discretisation.types
    matrix, sums, typed = matrix_type(precision), curvature_sums(discretisation), types_of(discretisation)
    module = discretisation.module(False, topic)
    own = curvature_functions(precision, dimension, module)
    normal_work, curvature_of, outermost = own.normal_work, own.curvature, own.outermost

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
    @typed
    def normal_adjoint(i: int, g_part, x_part, r_i, s) -> tuple[vector, vector]:
        return g_part + (real(1 - s.filling[i]) * s.self_weight * s.volume) * r_i, x_part

    colour_adjoint = sum_kernel("colour_adjoint", module, "+x_bar", sums.colour.adjoint)
    return colour_adjoint, normal_adjoint, bend_adjoint, (force_adjoint, mean_adjoint)
