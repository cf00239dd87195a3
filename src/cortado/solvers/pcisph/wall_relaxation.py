"""The pressure relaxation beside walls: a factor on the pressure correction of one iteration.

delta is made for a particle with a filled neighbourhood. Beside a wall the same pressure moves a particle's own
density further, by |S_i|^2 / (2 sum_j G_j . G_j of the prototype) with S_i = sum_b w_b G_ib, and where that is above 2
the iteration overshoots and kicks it away. A particle that nears a wall within the step meets a steeper one than at the
step's start, where S_i is taken, so that the answer counts twice. delta is multiplied by the pressure relaxation

    y_i = 1 / (1 + |S_i|^2 / response),   response = sum_j G_j . G_j,

which is 1 away from walls, and smooth. It changes how fast the iteration converges, not what it converges to. Sums are
multiplied with the response scale, response^(-1/2), before they are squared: in float32 the square of a gradient
overflows where spacings are small.
"""

from functools import cache

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.sph.wall_slope import wall_slope_sums


@cache
def wall_kernels(discretisation: Discretisation) -> Kernels:
    """Kernels ``forward``, ``tangent`` and ``adjoint`` of the pressure relaxation beside walls."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    sums = wall_slope_sums(discretisation)
    slope, change, slope_tangent = sums.slope, sums.change, sums.tangent
    LANES = discretisation.lanes
    lane = lane_functions(discretisation.precision, LANES).lane

    @wp.kernel(module=discretisation.module(True, "pcisph"))
    def wall_relaxation(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        # out
        y: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        total = s.response_scale * slope(i, x, s)
        if lane() > 0:
            return
        y[i] = real(1.0) / (real(1.0) + wp.dot(total, total))

    @wp.kernel(module=discretisation.tangent_module("pcisph"), enable_backward=False)
    def wall_relaxation_tangent(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        y: wp.array(dtype=real),
        # out
        y_dot: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        total = s.response_scale * slope(i, x, s)
        total_dot = s.response_scale * slope_tangent(i, x, x_dot, s)
        if lane() > 0:
            return
        y_dot[i] = real(-2.0) * y[i] * y[i] * wp.dot(total, total_dot)

    @wp.kernel(module=discretisation.module(False, "pcisph"), enable_backward=False)
    def wall_relaxation_adjoint(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        y: wp.array(dtype=real),
        y_bar: wp.array(dtype=real),
        # in and out
        x_bar: wp.array(dtype=vector),
        # out
        slope_bar: wp.array(dtype=vector),
    ):
        """``slope_bar`` is the adjoint of S."""
        i = s.first + wp.tid() // LANES
        total = s.response_scale * slope(i, x, s)
        along = (real(-2.0) * y_bar[i] * y[i] * y[i] * s.response_scale) * total
        x_sum = change(i, x, along, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_sum
        slope_bar[i] = along

    return Kernels(wall_relaxation, wall_relaxation_tangent, wall_relaxation_adjoint)
