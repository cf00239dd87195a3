"""The adjoint of the pressure force with respect to pressures alone, at frozen positions.

It is that of `cortado.solvers.pcisph.pressure` without the Hessian of the smoothing kernel, which is most of the work.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import pair_sum
from cortado.solvers.pcisph.pressure_force import pressure_share


@cache
def frozen_force_adjoint(discretisation: Discretisation) -> Any:
    """The kernel: the exact one, but for what it adds to the adjoints of positions and densities."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    slope = pair_functions(discretisation).slope
    LANES = discretisation.lanes
    lane = lane_functions(discretisation.precision, LANES).lane
    share = pressure_share(discretisation.precision)
    values, adjoints, adjoin_pressure = share.values, share.adjoints, share.adjoint

    @pair_sum(discretisation)
    def force_sum_adjoint(
        x_ij: vector, c_i: real, c_j: real, scaled_bar_i: vector, scaled_bar_ij: vector, s: neighbourhood
    ) -> tuple[real, real]:
        """Divergence, and work."""
        a = slope(x_ij, s)
        return a * wp.dot(x_ij, scaled_bar_ij), ((c_i + c_j) * a) * wp.dot(x_ij, scaled_bar_i)

    @wp.kernel(module=discretisation.module(False, "frozen_pressure"), enable_backward=False)
    def adjoint(
        s: neighbourhood,
        k: int,
        rounds: wp.array(dtype=wp.int32),
        stiffness: real,
        time_step: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        at: values,
        c: wp.array(dtype=real),
        scaled_bar: wp.array(dtype=vector),
        # in and out
        bar: adjoints,
        # out
        r: wp.array(dtype=real),
    ):
        """From ``scaled_bar``, the adjoint of the pressure acceleration over m, to those of p and (r) of n*."""
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        if k >= rounds[member]:
            return
        divergence, work = force_sum_adjoint(i, x, c, scaled_bar, s)
        if lane() > 0:
            return
        r[i] = adjoin_pressure(i, stiffness, time_step[member], s.volume, divergence, work, at, bar)

    return adjoint
