"""Vorticity by summation over the fluid around a particle (Monaghan 1992):

c_i = V sum_j (v_i - v_j) x G_ij,   omega_i = c_i / (mu n_i).

mu = -(V / d) sum_j x_j . G_j is that of the rest lattice, on which a fluid that turns as a whole has twice its rate of
turning. Walls have no part in it.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.modules import Kernels
from cortado.particles.made_derivatives import made_adjoint, made_tangent
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum


def turns(discretisation: Discretisation) -> Callable[..., Any]:
    """The term of a pair."""
    vector, neighbourhood = discretisation.precision.vector, neighbourhood_type(discretisation.precision)
    gradient = pair_functions(discretisation).gradient

    def turning(x_ij: vector, v_ij: vector, s: neighbourhood) -> vector:
        return wp.cross(v_ij, gradient(x_ij, s))

    return turning


@cache
def circulation_kernels(discretisation: Discretisation) -> Kernels:
    """Kernels ``forward``, ``tangent`` and ``adjoint`` of the sum c."""
    vector = discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    LANES = discretisation.lanes
    lane = lane_functions(discretisation.precision, LANES).lane
    turning = fluid_sum(discretisation)(turns(discretisation))
    turning_tangent = made_tangent(discretisation, turns)
    turning_adjoint = made_adjoint(discretisation, turns)

    @wp.kernel(module=discretisation.module(False, "vorticity"), enable_backward=False)
    def circulation(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        # out
        circulation: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = turning(i, x, v, s)
        if lane() > 0:
            return
        circulation[i] = s.volume * total

    @wp.kernel(module=discretisation.tangent_module("vorticity"), enable_backward=False)
    def circulation_tangent(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        # out
        circulation_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = turning_tangent(i, x, x_dot, v, v_dot, s)
        if lane() > 0:
            return
        circulation_dot[i] = s.volume * total

    @wp.kernel(module=discretisation.module(False, "vorticity"), enable_backward=False)
    def circulation_adjoint(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        circulation_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        x_total, v_total = turning_adjoint(i, x, v, circulation_bar, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + s.volume * x_total
        v_bar[i] = v_bar[i] + s.volume * v_total

    return Kernels(circulation, circulation_tangent, circulation_adjoint)
