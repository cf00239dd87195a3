"""What walls push a particle with, and its derivative:

g_i = sum_b w_b G_ib,   g_i' = sum_b w_b H_ib x_ib' + w_b' G_ib.

A particle with the pressure p_i pushes the walls around it with the force V^2 p_i / n_i^2 g_i. H is symmetric: its sum
of forward mode is that of reverse mode too.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import wall_sum
from cortado.particles.wall_terms import WallTerm


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

    @wall_sum(discretisation, grows=slope)
    def tangent(x_ij: vector, x_dot_ij: vector, s: neighbourhood) -> vector:
        return hessian_product(x_ij, x_dot_ij, s)

    return WallSlope(slope, change, tangent)


def wall_slope_term(discretisation: Discretisation) -> WallTerm:
    """g as the sum over the walls of a solid, with the adjoint ``slope_bar``."""
    return WallTerm(discretisation, "wall_slope", _work, "slope_bar")


def _work(d: Discretisation) -> Any:
    real, vector, gradient = d.precision.real, d.precision.vector, pair_functions(d).gradient

    def wall_slope_work(x_ij: vector, slope_bar_i: vector, s: neighbourhood_type(d.precision)) -> real:
        return wp.dot(gradient(x_ij, s), slope_bar_i)

    return wall_slope_work
