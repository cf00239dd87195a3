"""The adjoint of the pressure force with respect to pressures alone, at frozen positions.

It is that of `cortado.solvers.pcisph.pressure` without the Hessian of the smoothing kernel, which is most of the work.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions


@cache
def frozen_force_adjoint(discretisation: Discretisation) -> Any:
    """The kernel: the exact one, but for what it adds to the adjoints of positions and densities."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    neighbour, wall_position, wall_weight = pair.neighbour, pair.wall_position, pair.wall_weight
    separation, slope, gradient = pair.separation, pair.slope, pair.gradient
    vectors, numbers = pair.vectors, pair.numbers
    LANES = discretisation.lanes
    lanes = lane_functions(discretisation.precision, LANES)
    lane, add_up = lanes.lane, lanes.add_up

    @wp.kernel(module=discretisation.module(False, "frozen_pressure"), enable_backward=False)
    def adjoint(
        s: neighbourhood,
        k: int,
        rounds: wp.array(dtype=wp.int32),
        stiffness: real,
        time_step: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        m: wp.array(dtype=real),
        rho_0: wp.array(dtype=real),
        y: wp.array(dtype=real),
        p_in: wp.array(dtype=real),
        p_out: wp.array(dtype=real),
        c: wp.array(dtype=real),
        scaled_bar: wp.array(dtype=vector),
        # in and out
        m_bar: wp.array(dtype=real),
        rho_0_bar: wp.array(dtype=real),
        y_bar: wp.array(dtype=real),
        p_bar: wp.array(dtype=real),
        time_step_bar: wp.array(dtype=real),
        # out
        r: wp.array(dtype=real),
    ):
        """From ``scaled_bar``, the adjoint of the pressure acceleration over m, to those of p and (r) of n*."""
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        if k >= rounds[member]:
            return
        x_i = x[i]
        c_i = c[i]
        scaled_bar_i = scaled_bar[i]
        divergence = real(0.0)
        work = real(0.0)
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            c_j = numbers(c, k, i, s)
            scaled_bar_j = vectors(scaled_bar, k, i, s)
            for u in range(UNROLL):
                x_ij = separation(x_i, x_j[u], s)
                a = slope(x_ij, s)
                divergence += a * wp.dot(x_ij, scaled_bar_i - scaled_bar_j[u])
                work += ((c_i + c_j[u]) * a) * wp.dot(x_ij, scaled_bar_i)
        for k in range(s.fluid_count[i] + lane(), s.count[i], LANES):
            b = neighbour(k, i, s)
            g_ib = gradient(separation(x_i, wall_position(b, s), s), s)
            wall_divergence = wall_weight(b, s) * wp.dot(g_ib, scaled_bar_i)
            divergence += wall_divergence
            work += c_i * wall_divergence
        divergence = add_up(divergence)
        work = add_up(work)
        if lane() > 0:
            return
        m_i = m[i]
        p_i = p_out[i]
        delta = y[i] * stiffness / (time_step[member] * time_step[member])
        p_bar_i = real(0.0)
        if p_i > real(0.0):
            p_bar_i = p_bar[i] - s.volume * divergence / (n[i] * n[i])
        excess_bar = delta * p_bar_i
        excess = (p_i - p_in[i]) / delta
        m_bar[i] = m_bar[i] + (s.volume * work + excess_bar * (excess + rho_0[i])) / m_i
        rho_0_bar[i] = rho_0_bar[i] - excess_bar
        y_bar[i] = y_bar[i] + excess_bar * excess / y[i]
        p_bar[i] = p_bar_i
        r[i] = m_i * excess_bar
        time_step_bar[i] = time_step_bar[i] - real(2.0) * excess_bar * excess / time_step[member]

    return adjoint
