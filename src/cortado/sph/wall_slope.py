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
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import wall_sum


@dataclass(frozen=True)
class WallSlope:
    """Sums over the walls around a particle, as Warp functions or kernels."""

    slope: Any
    """g."""
    change: Any
    """The sum of H with a vector of each particle."""


@cache
def wall_slope_sums(discretisation: Discretisation) -> WallSlope:
    """The Warp functions ``slope(i, x, s)`` and ``change(i, x, along, s)``, with one vector ``along``."""
    vector = discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    gradient, hessian_product = pair.gradient, pair.hessian_product

    @wall_sum(discretisation)
    def slope(x_ij: vector, s: neighbourhood) -> vector:
        return gradient(x_ij, s)

    @wall_sum(discretisation)
    def change(x_ij: vector, along: vector, s: neighbourhood) -> vector:
        return hessian_product(x_ij, along, s)

    return WallSlope(slope, change)


@cache
def wall_slope_kernels(discretisation: Discretisation) -> WallSlope:
    """The kernels of a smoothing kernel in a precision."""
    vector = discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    sums = wall_slope_sums(discretisation)
    gradients, hessian_products = sums.slope, sums.change
    LANES = discretisation.lanes
    lane = lane_functions(discretisation.precision, LANES).lane
    module = discretisation.module(False, "wall_slope")

    @wp.kernel(module=module, enable_backward=False)
    def slope(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        # out
        wall_slope: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = gradients(i, x, s)
        if lane() == 0:
            wall_slope[i] = total

    @wp.kernel(module=module, enable_backward=False)
    def change(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        along: wp.array(dtype=vector),
        # out
        wall_slope_change: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = hessian_products(i, x, along[i], s)
        if lane() == 0:
            wall_slope_change[i] = total

    return WallSlope(slope, change)
