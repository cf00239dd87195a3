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

from cortado.device.lanes import lane_functions
from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.sph.curvature import curvature_functions, curvature_sums
from cortado.sph.moment_functions import matrix_type, moment_functions


def entries(precision: Precision) -> dict[str, Any]:
    """Names and types of what is kept of each particle, with c = w kappa."""
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
    """In 2 or 3 dimensions; ``depth`` is delta and ``per_width`` 1 / J."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    neighbourhood, sums = neighbourhood_type(precision), curvature_sums(discretisation)
    colour_sum, average_sum, bend_sum, mean_sum = sums.colour, sums.average, sums.bend, sums.mean
    moments = moment_functions(precision, dimension)
    whole, even = moments.whole, moments.change
    topic = f"surface_curvature_{dimension}d"
    module = discretisation.module(True, topic)
    own = curvature_functions(precision, dimension, module)
    normal_of, curvature_of, outermost = own.normal, own.curvature, own.outermost
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane

    @wp.kernel(module=module)
    def colour(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        # out
        g: wp.array(dtype=vector),
        z: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        g_i, others = colour_sum(i, x, s)
        if lane() > 0:
            return
        g[i] = g_i
        z[i] = others + real(1 - s.filling[i]) * s.self_weight * s.volume

    @wp.kernel(module=module)
    def normal(
        s: neighbourhood,
        spacing: real,
        x: wp.array(dtype=vector),
        g: wp.array(dtype=vector),
        z: wp.array(dtype=real),
        # out
        q: wp.array(dtype=vector),
        w: wp.array(dtype=real),
        e: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        others = average_sum(i, x, g, s)
        if lane() > 0:
            return
        q_i = (others + (real(1 - s.filling[i]) * s.self_weight * s.volume) * g[i]) / z[i]
        w_i, e_i = normal_of(q_i, spacing)
        q[i] = q_i
        w[i] = w_i
        e[i] = e_i

    @wp.kernel(module=module)
    def bend(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        e: wp.array(dtype=vector),
        w: wp.array(dtype=real),
        # out
        B: wp.array(dtype=matrix),
        D: wp.array(dtype=matrix),
        c: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        diagonal, others, turned, mixed = bend_sum(i, x, e, w, s)
        if lane() > 0:
            return
        B_i, D_i = whole(diagonal, others), even(turned, mixed)
        B[i] = B_i
        D[i] = D_i
        c[i] = w[i] * curvature_of(B_i, D_i)

    @wp.kernel(module=module)
    def mean(
        s: neighbourhood,
        depth: real,
        per_width: real,
        surface_tension: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        q: wp.array(dtype=vector),
        w: wp.array(dtype=real),
        c: wp.array(dtype=real),
        acceleration_in: wp.array(dtype=vector),
        # out
        a: wp.array(dtype=real),
        b: wp.array(dtype=real),
        acceleration: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        a_i, b_i = mean_sum(i, x, c, w, s)
        if lane() > 0:
            return
        self_weight = real(1 - s.filling[i]) * s.self_weight * s.volume
        a_all, b_all = a_i + self_weight * c[i], b_i + self_weight * w[i]
        a[i] = a_all
        b[i] = b_all
        strength = surface_tension[i // s.particles] * per_width / m[i]
        acceleration[i] = acceleration_in[i] + (strength * outermost(a_all, b_all, depth) * w[i]) * q[i]

    made = discretisation, dimension, topic
    three = zip((colour, normal, bend, mean), curvature_tangents(*made), curvature_adjoints(*made), strict=True)
    return CurvatureKernels(*(Kernels(*each) for each in three))


@cache
def curvature_tangents(discretisation: Discretisation, dimension: int, topic: str) -> tuple[Any, ...]:
    """Of the four kernels, in 2 or 3 dimensions, in the Warp module of a topic."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    neighbourhood, sums = neighbourhood_type(precision), curvature_sums(discretisation)
    colour_sum, average_sum, bend_sum, mean_sum = (
        *(sums.colour_tangent, sums.average_tangent),
        *(sums.bend_tangent, sums.mean_tangent),
    )
    even = moment_functions(precision, dimension).change
    module = discretisation.tangent_module(topic)
    own = curvature_functions(precision, dimension, module)
    normal_of, curvature_back, outermost, outermost_back = (
        *(own.normal_tangent, own.curvature_back),
        *(own.outermost, own.outermost_back),
    )
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane
    coloured, bent = bundle(x=vector, g=vector, z=real), bundle(x=vector, e=vector, w=real)
    meant = bundle(x=vector, m=real, q=vector, w=real, c=real)

    @wp.kernel(module=module, enable_backward=False)
    def colour_tangent(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        # out
        g_dot: wp.array(dtype=vector),
        z_dot: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        g_i_dot, z_i_dot = colour_sum(i, x, x_dot, s)
        if lane() > 0:
            return
        g_dot[i] = g_i_dot
        z_dot[i] = z_i_dot

    @wp.kernel(module=module, enable_backward=False)
    def normal_tangent(
        s: neighbourhood,
        spacing: real,
        now: coloured,
        dot: coloured,
        q: wp.array(dtype=vector),
        # out
        q_dot: wp.array(dtype=vector),
        w_dot: wp.array(dtype=real),
        e_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        others = average_sum(i, now.x, dot.x, now.g, dot.g, s)
        if lane() > 0:
            return
        own_part = (real(1 - s.filling[i]) * s.self_weight * s.volume) * dot.g[i]
        q_i_dot = (others + own_part - dot.z[i] * q[i]) / now.z[i]
        w_i_dot, e_i_dot = normal_of(q[i], spacing, q_i_dot)
        q_dot[i] = q_i_dot
        w_dot[i] = w_i_dot
        e_dot[i] = e_i_dot

    @wp.kernel(module=module, enable_backward=False)
    def bend_tangent(
        s: neighbourhood,
        now: bent,
        dot: bent,
        B: wp.array(dtype=matrix),
        D: wp.array(dtype=matrix),
        c: wp.array(dtype=real),
        # out
        c_dot: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        diagonal, others, turned, mixed = bend_sum(i, now.x, dot.x, now.e, dot.e, now.w, dot.w, s)
        if lane() > 0:
            return
        kappa, by_B, by_D = curvature_back(B[i], D[i], real(1.0))
        kappa_dot = wp.ddot(by_B, even(diagonal, others)) + wp.ddot(by_D, even(turned, mixed))
        c_dot[i] = dot.w[i] * kappa + now.w[i] * kappa_dot

    @wp.kernel(module=module, enable_backward=False)
    def mean_tangent(
        s: neighbourhood,
        depth: real,
        per_width: real,
        surface_tension: wp.array(dtype=real),
        surface_tension_dot: wp.array(dtype=real),
        now: meant,
        dot: meant,
        a: wp.array(dtype=real),
        b: wp.array(dtype=real),
        acceleration_in_dot: wp.array(dtype=vector),
        # out
        acceleration_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        a_dot, b_dot = mean_sum(i, now.x, dot.x, now.c, dot.c, now.w, dot.w, s)
        if lane() > 0:
            return
        self_weight, member = real(1 - s.filling[i]) * s.self_weight * s.volume, i // s.particles
        a_dot += self_weight * dot.c[i]
        b_dot += self_weight * dot.w[i]
        k, w_i, q_i = outermost(a[i], b[i], depth), now.w[i], now.q[i]
        by_a, by_b = outermost_back(a[i], b[i], depth)
        k_dot = by_a * a_dot + by_b * b_dot
        strength = surface_tension[member] * per_width / now.m[i]
        strength_dot = (surface_tension_dot[member] * per_width - strength * dot.m[i]) / now.m[i]
        along = strength_dot * k * w_i + strength * (k_dot * w_i + k * dot.w[i])
        acceleration_dot[i] = acceleration_in_dot[i] + along * q_i + (strength * k * w_i) * dot.q[i]

    return colour_tangent, normal_tangent, bend_tangent, mean_tangent


@cache
def curvature_adjoints(discretisation: Discretisation, dimension: int, topic: str) -> tuple[Any, ...]:
    """Of the four kernels; that of the last one is two, the first of which has no neighbours."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    neighbourhood, sums = neighbourhood_type(precision), curvature_sums(discretisation)
    colour_back, average_back, bend_back, mean_back = (
        *(sums.colour_back, sums.average_back),
        *(sums.bend_back, sums.mean_back),
    )
    module = discretisation.module(False, topic)
    own = curvature_functions(precision, dimension, module)
    normal_back, curvature_back, outermost, outermost_back = (
        *(own.normal_back, own.curvature_back),
        *(own.outermost, own.outermost_back),
    )
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane
    acting, of_means = bundle(m=real, q=vector, w=real, a=real, b=real), bundle(a=real, b=real)
    bent, matrices = bundle(x=vector, e=vector, w=real), bundle(B=matrix, D=matrix)

    @wp.kernel(module=module, enable_backward=False)
    def force_adjoint(
        particles: int,
        depth: real,
        per_width: real,
        surface_tension: wp.array(dtype=real),
        now: acting,
        acceleration_bar: wp.array(dtype=vector),
        # in and out
        m_bar: wp.array(dtype=real),
        surface_tension_bar: wp.array(dtype=real),
        # out
        q_bar: wp.array(dtype=vector),
        w_bar: wp.array(dtype=real),
        bar: of_means,
    ):
        """What the adjoint of the acceleration asks of a particle's own numbers."""
        i = wp.tid()
        m_i, w_i, k = now.m[i], now.w[i], outermost(now.a[i], now.b[i], depth)
        by_a, by_b = outermost_back(now.a[i], now.b[i], depth)
        strength = surface_tension[i // particles] * per_width / m_i
        work = wp.dot(now.q[i], acceleration_bar[i])
        m_bar[i] = m_bar[i] - strength * k * w_i * work / m_i
        surface_tension_bar[i] = surface_tension_bar[i] + per_width / m_i * k * w_i * work
        q_bar[i] = (strength * k * w_i) * acceleration_bar[i]
        w_bar[i] = strength * k * work
        bar.a[i] = strength * w_i * work * by_a
        bar.b[i] = strength * w_i * work * by_b

    @wp.kernel(module=module, enable_backward=False)
    def mean_adjoint(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        c: wp.array(dtype=real),
        w: wp.array(dtype=real),
        a_bar: wp.array(dtype=real),
        b_bar: wp.array(dtype=real),
        now: matrices,
        # in and out
        x_bar: wp.array(dtype=vector),
        w_bar: wp.array(dtype=real),
        # out
        bar: matrices,
    ):
        """From the adjoints of a and b to those of B and D."""
        i = s.first + wp.tid() // LANES
        c_part, w_part, x_part = mean_back(i, x, c, w, a_bar, b_bar, s)
        if lane() > 0:
            return
        self_weight = real(1 - s.filling[i]) * s.self_weight * s.volume
        c_bar = c_part + self_weight * a_bar[i]
        kappa, B_bar, D_bar = curvature_back(now.B[i], now.D[i], w[i] * c_bar)
        x_bar[i] = x_bar[i] + x_part
        w_bar[i] = w_bar[i] + w_part + self_weight * b_bar[i] + kappa * c_bar
        bar.B[i] = B_bar
        bar.D[i] = D_bar

    @wp.kernel(module=module, enable_backward=False)
    def bend_adjoint(
        s: neighbourhood,
        spacing: real,
        now: bent,
        bar: matrices,
        q: wp.array(dtype=vector),
        z: wp.array(dtype=real),
        w_bar: wp.array(dtype=real),
        q_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
        # out
        r: wp.array(dtype=vector),
        z_bar: wp.array(dtype=real),
    ):
        """From the adjoints of B, D, w and q to those of V sum W_ij g_j, which r is, and of z."""
        i = s.first + wp.tid() // LANES
        e_bar, w_part, x_part = bend_back(i, now.x, now.e, now.w, bar.B, bar.D, s)
        if lane() > 0:
            return
        r_i = (q_bar[i] + normal_back(q[i], spacing, w_bar[i] + w_part, e_bar)) / z[i]
        x_bar[i] = x_bar[i] + x_part
        r[i] = r_i
        z_bar[i] = -wp.dot(q[i], r_i)

    @wp.kernel(module=module, enable_backward=False)
    def normal_adjoint(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        g: wp.array(dtype=vector),
        r: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
        # out
        g_bar: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        g_part, x_part = average_back(i, x, g, r, s)
        if lane() > 0:
            return
        g_bar[i] = g_part + (real(1 - s.filling[i]) * s.self_weight * s.volume) * r[i]
        x_bar[i] = x_bar[i] + x_part

    @wp.kernel(module=module, enable_backward=False)
    def colour_adjoint(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        g_bar: wp.array(dtype=vector),
        z_bar: wp.array(dtype=real),
        # in and out
        x_bar: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        x_part = colour_back(i, x, g_bar, z_bar, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_part

    return colour_adjoint, normal_adjoint, bend_adjoint, (force_adjoint, mean_adjoint)
