"""What walls push a particle with, and its derivative:

g_i = sum_b w_b G_ib,   g_i' = sum_b w_b H_ib x_i'.

A particle with the pressure p_i pushes the walls around it with the force V^2 p_i / n_i^2 g_i. H is symmetric: the sum
of forward mode is that of reverse mode too.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.neighbourhood import Discretisation, neighbourhood_type, pair_functions


@dataclass(frozen=True)
class WallSlope:
    """Kernels of the sums over the walls around a particle."""

    slope: Any
    """g."""
    change: Any
    """The sum of H with a vector of each particle."""


@cache
def wall_slope_kernels(discretisation: Discretisation) -> WallSlope:
    """The kernels of a smoothing kernel in a precision."""
    vector = discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    neighbour, wall_position, wall_weight = pair.neighbour, pair.wall_position, pair.wall_weight
    separation, gradient, hessian_product = pair.separation, pair.gradient, pair.hessian_product
    LANES = discretisation.lanes
    lanes = lane_functions(discretisation.precision, LANES)
    lane, add_up_vectors = lanes.lane, lanes.add_up_vectors

    @wp.kernel(module=discretisation.module(False, "wall_slope"), enable_backward=False)
    def slope(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        # out
        wall_slope: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = vector()
        for k in range(s.fluid_count[i] + lane(), s.count[i], LANES):
            b = neighbour(k, i, s)
            total += wall_weight(b, s) * gradient(separation(x[i], wall_position(b, s), s), s)
        total = add_up_vectors(total)
        if lane() == 0:
            wall_slope[i] = total

    @wp.kernel(module=discretisation.module(False, "wall_slope"), enable_backward=False)
    def change(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        along: wp.array(dtype=vector),
        # out
        wall_slope_change: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = vector()
        for k in range(s.fluid_count[i] + lane(), s.count[i], LANES):
            b = neighbour(k, i, s)
            x_ib = separation(x[i], wall_position(b, s), s)
            total += wall_weight(b, s) * hessian_product(x_ib, along[i], s)
        total = add_up_vectors(total)
        if lane() == 0:
            wall_slope_change[i] = total

    return WallSlope(slope, change)
