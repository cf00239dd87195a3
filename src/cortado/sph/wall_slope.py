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
from cortado.particles.solid_shares import solid_kernel


@dataclass(frozen=True)
class WallSlope:
    """Sums over the walls around a particle, as Warp functions or kernels."""

    slope: Any
    """g."""
    change: Any
    """The sum of H with a vector of each particle."""
    tangent: Any
    """The tangent of g."""


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

    @wall_sum(discretisation)
    def tangent(x_ij: vector, x_dot_ij: vector, s: neighbourhood) -> vector:
        return hessian_product(x_ij, x_dot_ij, s)

    return WallSlope(slope, change, tangent)


def wall_slope_solid_kernel(discretisation: Discretisation) -> Any:
    """The kernel of what g gives to solids that move, for its adjoints ``bar``
    (`cortado.particles.solid_shares.solid_kernel`)."""
    return solid_kernel(discretisation, "wall_slope", _work)


def _work(d: Discretisation) -> Any:
    real, vector, gradient = d.precision.real, d.precision.vector, pair_functions(d).gradient

    def wall_slope_work(x_ij: vector, bar_i: vector, s: neighbourhood_type(d.precision)) -> real:
        return wp.dot(gradient(x_ij, s), bar_i)

    return wall_slope_work


@cache
def wall_slope_kernels(discretisation: Discretisation) -> WallSlope:
    """The kernels of a smoothing kernel in a precision."""
    vector = discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    sums = wall_slope_sums(discretisation)
    gradients, hessian_products, gradients_tangent = sums.slope, sums.change, sums.tangent
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

    @wp.kernel(module=discretisation.tangent_module("wall_slope"), enable_backward=False)
    def tangent(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        # out
        wall_slope_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = gradients_tangent(i, x, x_dot, s)
        if lane() == 0:
            wall_slope_dot[i] = total

    return WallSlope(slope, change, tangent)
