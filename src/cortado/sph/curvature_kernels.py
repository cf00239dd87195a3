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
`cortado.sph.curvature_constants`.

D comes as its symmetric part, which is all that the trace needs.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.sph.curvature_derivatives import curvature_adjoints, curvature_tangents
from cortado.sph.curvature_functions import curvature_functions
from cortado.sph.curvature_sums import curvature_sums
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
