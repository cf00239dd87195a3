"""The kernels of A = sum_j v_ij g_ij^T, which the shift needs, where no iteration of the pressure has found it: with
PCISPH, and at the fixed point of the projection."""

from functools import cache

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.solvers.projection.sums import projection_sums
from cortado.sph.moment_functions import matrix_type


@cache
def velocity_gradient_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    """In 2 or 3 dimensions; that of the adjoint needs g, the sum of g_ij."""
    precision = discretisation.precision
    vector, matrix, neighbourhood = precision.vector, matrix_type(precision), neighbourhood_type(precision)
    sums, topic = projection_sums(discretisation), f"projection_{dimension}d"
    rows, rows_tangent, rows_back = sums.velocity_gradient, sums.velocity_gradient_tangent, sums.velocity_gradient_back
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane

    @wp.kernel(module=discretisation.module(True, topic))
    def velocity_gradient(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        v_flow: wp.array(dtype=vector),
        # out
        A: wp.array(dtype=matrix),
    ):
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z = rows(i, x, v_flow, s)
        if lane() > 0:
            return
        A[i] = wp.matrix_from_rows(row_x, row_y, row_z)

    @wp.kernel(module=discretisation.tangent_module(topic), enable_backward=False)
    def velocity_gradient_tangent(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v_flow: wp.array(dtype=vector),
        v_flow_dot: wp.array(dtype=vector),
        # out
        A_dot: wp.array(dtype=matrix),
    ):
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z = rows_tangent(i, x, x_dot, v_flow, v_flow_dot, s)
        if lane() > 0:
            return
        A_dot[i] = wp.matrix_from_rows(row_x, row_y, row_z)

    @wp.kernel(module=discretisation.module(False, topic), enable_backward=False)
    def velocity_gradient_adjoint(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        v_flow: wp.array(dtype=vector),
        g: wp.array(dtype=vector),
        A_bar: wp.array(dtype=matrix),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_flow_bar: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        v_part, x_part = rows_back(i, x, v_flow, A_bar, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_part
        v_flow_bar[i] = v_flow_bar[i] + v_part + A_bar[i] * g[i]

    return Kernels(velocity_gradient, velocity_gradient_tangent, velocity_gradient_adjoint)
