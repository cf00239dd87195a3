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

from cortado.device.kernels import Kernels
from cortado.device.lanes import lane_functions
from cortado.device.neighbourhood import Discretisation, neighbourhood_type, pair_functions


@cache
def wall_kernels(discretisation: Discretisation) -> Kernels:
    """Kernels ``forward``, ``tangent`` and ``adjoint`` of the pressure relaxation beside walls."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    neighbour, wall_position, wall_weight = pair.neighbour, pair.wall_position, pair.wall_weight
    separation, gradient, hessian_product = pair.separation, pair.gradient, pair.hessian_product

    LANES = discretisation.lanes
    lanes = lane_functions(discretisation.precision, LANES)
    lane, add_up_vectors = lanes.lane, lanes.add_up_vectors

    @wp.func
    def wall_gradient(i: int, x: wp.array(dtype=vector), s: neighbourhood) -> vector:
        total = vector()
        for k in range(s.fluid_count[i] + lane(), s.count[i], LANES):
            b = neighbour(k, i, s)
            total += (s.response_scale * wall_weight(b, s)) * gradient(separation(x[i], wall_position(b, s), s), s)
        return add_up_vectors(total)

    @wp.func
    def wall_hessian_product(i: int, x: wp.array(dtype=vector), u: vector, s: neighbourhood) -> vector:
        total = vector()
        for k in range(s.fluid_count[i] + lane(), s.count[i], LANES):
            b = neighbour(k, i, s)
            total += (s.response_scale * wall_weight(b, s)) * hessian_product(
                separation(x[i], wall_position(b, s), s), u, s
            )
        return add_up_vectors(total)

    @wp.kernel(module=discretisation.module(True, "pcisph"))
    def wall_relaxation(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        # out
        y: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        total = wall_gradient(i, x, s)
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
        total = wall_gradient(i, x, s)
        total_dot = wall_hessian_product(i, x, x_dot[i], s)
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
    ):
        i = s.first + wp.tid() // LANES
        total_bar = (real(-2.0) * y_bar[i] * y[i] * y[i]) * wall_gradient(i, x, s)
        change = wall_hessian_product(i, x, total_bar, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + change

    return Kernels(wall_relaxation, wall_relaxation_tangent, wall_relaxation_adjoint)
