"""One pressure iteration of PCISPH (Solenthaler and Pajarola 2009). `docs/discretisation.md` has the equations.

The iteration uses kernel gradients and neighbour lists from the start of the step. The pressure force, including the
force of walls, is the transpose of the derivative of the number density n with respect to positions. A displacement
against the pressure force therefore takes the work V sum_i c_i dn_i with c = p / n^2. The derivative of max(p, 0) is 1
if the pressure p is positive, and 0 otherwise.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import TypesByName
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import adjoint_of, pair_sum, tangent_of
from cortado.sph.density import density_sums
from cortado.sph.parts import prediction_share


@cache
def pressure_kernels(discretisation: Discretisation) -> Kernels:
    (real, vector, neighbourhood), pair_of = discretisation.types, discretisation.precision.pair
    weights, weights_tangent, weights_adjoint = density_sums(discretisation)
    values = bundle(n=real, m=real, rho_0=real, y=real, p_in=real, p_out=real)
    changes = bundle(n=real, m=real, rho_0=real, y=real, p_in=real)
    adjoin_prediction = prediction_share(discretisation.precision)
    LANES, lane = discretisation.lanes, discretisation.lane

    names = {neighbourhood: "s", wp.int32: "rounds", vector: "x v scaled", pair_of: "error"}
    typed = TypesByName(real, {**names, values: "at", changes: "dot"})

    @typed.kernel(discretisation.module(True, "pcisph"))
    def pressure(s, k: int, rounds, stiffness: real, time_step, n, m, rho_0, y, x_star, p_in, p_out, c, error):
        """``c`` becomes ``p_out`` divided by the squared number density, ``error`` the relative compression."""
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        if k >= rounds[member]:
            return
        m_i = m[i]  # all that is needed is loaded before the sum, so that the loads do not wait for it
        n_i = n[i]
        rho_0_i = rho_0[i]
        p_i = p_in[i]
        own = real(1 - s.filling[i]) * s.self_weight
        delta = y[i] * stiffness / (time_step[member] * time_step[member])
        total = weights(i, x_star, s)
        if lane() > 0:
            return
        excess = m_i * s.volume * (own + total) - rho_0_i
        p_i = p_i + delta * excess
        if p_i < real(0.0):  # not wp.max, which would turn NaN into 0 and hide it
            p_i = real(0.0)
        compression = wp.max(excess / rho_0_i, real(0.0))
        p_out[i] = p_i
        c[i] = p_i / (n_i * n_i)
        error[i] = pair_of(compression, compression)

    @typed.kernel(discretisation.tangent_module("pcisph"))
    def pressure_tangent(
        s, k: int, rounds, stiffness: real, time_step, time_step_dot, at, x_star, x_star_dot, dot, p_out_dot, c_dot
    ):
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        if k >= rounds[member]:
            return
        total = weights_tangent(i, x_star, x_star_dot, s)
        if lane() > 0:
            return
        p_i = at.p_out[i]
        p_dot_i = real(0.0)
        if p_i > real(0.0):
            delta = at.y[i] * stiffness / (time_step[member] * time_step[member])
            excess = (p_i - at.p_in[i]) / delta
            excess_dot = at.m[i] * s.volume * total + (excess + at.rho_0[i]) * dot.m[i] / at.m[i] - dot.rho_0[i]
            delta_dot = delta * (dot.y[i] / at.y[i] - real(2.0) * time_step_dot[member] / time_step[member])
            p_dot_i = dot.p_in[i] + delta * excess_dot + delta_dot * excess
        n_i = at.n[i]
        p_out_dot[i] = p_dot_i
        c_dot[i] = (p_dot_i - real(2.0) * p_i / n_i * dot.n[i]) / (n_i * n_i)

    @typed.kernel(discretisation.module(False, "pcisph"))
    def pressure_adjoint(
        s, k: int, rounds, time_step, m, v, x_star, v_star, r, x_bar, v_bar, time_step_bar, scaled_bar
    ):
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        if k >= rounds[member]:
            return
        x_star_bar = s.volume * weights_adjoint(i, x_star, r, s)
        if lane() > 0:
            return
        dt = time_step[member]
        speed_bar = dt * x_star_bar
        x_bar[i] = x_bar[i] + x_star_bar
        v_bar[i] = v_bar[i] + speed_bar
        scaled_bar[i] = (dt / m[i]) * speed_bar
        time_step_bar[i] = time_step_bar[i] + adjoin_prediction(x_star_bar, speed_bar, v[i], v_star[i], dt)

    return Kernels(pressure, pressure_tangent, pressure_adjoint)


def pressure_term(d: Discretisation) -> Any:
    real, vector, slope = d.precision.real, d.precision.vector, pair_functions(d).slope

    def pressure_work(x_ij: vector, c_i: real, scaled_bar_i: vector, s: neighbourhood_type(d.precision)) -> real:
        return -s.volume * c_i * slope(x_ij, s) * wp.dot(x_ij, scaled_bar_i)

    return pressure_work


@cache
def pressure_force_kernels(discretisation: Discretisation) -> Kernels:
    real, vector, neighbourhood = discretisation.types
    pair = pair_functions(discretisation)
    slope, slope_change = pair.slope, pair.slope_change
    gradient, hessian_product = pair.gradient, pair.hessian_product
    LANES, lane = discretisation.lanes, discretisation.lane
    moved = bundle(m=real, x=vector, v=vector, acceleration=vector, c=real)
    values = bundle(n=real, m=real, rho_0=real, y=real, p_in=real, p_out=real)
    adjoints = bundle(m=real, rho_0=real, y=real, p=real, time_step=real)

    @wp.func
    def adjoin_pressure(
        i: int, stiffness: real, dt: real, volume: real, divergence: real, work: real, at: values, bar: adjoints
    ) -> real:
        n_i = at.n[i]
        m_i = at.m[i]
        p_i = at.p_out[i]
        delta = at.y[i] * stiffness / (dt * dt)
        p_bar_i = real(0.0)
        if p_i > real(0.0):
            p_bar_i = bar.p[i] - volume * divergence / (n_i * n_i)
        excess_bar = delta * p_bar_i
        excess = (p_i - at.p_in[i]) / delta
        bar.m[i] = bar.m[i] + (volume * work + excess_bar * (excess + at.rho_0[i])) / m_i
        bar.rho_0[i] = bar.rho_0[i] - excess_bar
        bar.y[i] = bar.y[i] + excess_bar * excess / at.y[i]
        bar.p[i] = p_bar_i
        bar.time_step[i] = bar.time_step[i] - real(2.0) * excess_bar * excess / dt
        return m_i * excess_bar

    @pair_sum(discretisation)
    def force(x_ij: vector, c_i: real, c_j: real, s: neighbourhood) -> vector:
        return ((c_i + c_j) * slope(x_ij, s)) * x_ij

    @tangent_of(force)
    @pair_sum(discretisation, ahead=False, grows=force)
    def force_tangent(
        x_ij: vector, x_dot_ij: vector, c_i: real, c_j: real, c_dot_i: real, c_dot_j: real, s: neighbourhood
    ) -> vector:
        return (c_dot_i + c_dot_j) * gradient(x_ij, s) + (c_i + c_j) * hessian_product(x_ij, x_dot_ij, s)

    @adjoint_of(force)
    @pair_sum(discretisation)
    def force_adjoint(
        x_ij: vector, c_i: real, c_j: real, scaled_bar_i: vector, scaled_bar_ij: vector, s: neighbourhood
    ) -> tuple[vector, real, real]:
        a = slope(x_ij, s)
        c_ij = c_i + c_j
        change = (c_ij * a) * scaled_bar_ij + (c_ij * slope_change(x_ij, scaled_bar_ij, s)) * x_ij
        return change, a * wp.dot(x_ij, scaled_bar_ij), (c_ij * a) * wp.dot(x_ij, scaled_bar_i)

    typed = TypesByName(real, {neighbourhood: "s", wp.int32: "rounds", vector: "x v acceleration scaled"})

    @typed.kernel(discretisation.module(True, "pcisph"))
    def pressure_force(s, k: int, rounds, time_step, m, x, v, acceleration, c, x_before, v_before, x_star, v_star):
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        if k >= rounds[member]:
            if lane() == 0:
                x_star[i] = x_before[i]
                v_star[i] = v_before[i]
            return
        dt = time_step[member]  # all that is needed is loaded before the sum, so that the loads do not wait for it
        x_i = x[i]
        v_i = v[i]
        a_i = acceleration[i]
        scale = -s.volume / m[i]
        total = force(i, x, c, s)
        if lane() > 0:
            return
        velocity = v_i + dt * (a_i + scale * total)
        v_star[i] = velocity
        x_star[i] = x_i + dt * velocity

    @typed.kernel(discretisation.tangent_module("pcisph"))
    def pressure_force_tangent(
        s, k: int, rounds, time_step, time_step_dot, at: moved, dot: moved, v_star, x_star_dot, v_star_dot
    ):
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        if k >= rounds[member]:
            return
        total_dot = force_tangent(i, at.x, dot.x, at.c, dot.c, s)
        if lane() > 0:
            return
        dt = time_step[member]
        accelerated = (v_star[i] - at.v[i]) / dt
        push = accelerated - at.acceleration[i]
        push_dot = (-s.volume / at.m[i]) * total_dot - (dot.m[i] / at.m[i]) * push
        velocity_dot = dot.v[i] + dt * (dot.acceleration[i] + push_dot) + time_step_dot[member] * accelerated
        v_star_dot[i] = velocity_dot
        x_star_dot[i] = dot.x[i] + dt * velocity_dot + time_step_dot[member] * v_star[i]

    @typed.kernel(discretisation.module(False, "pcisph"))
    def pressure_force_adjoint(
        s, k: int, rounds, stiffness: real, time_step, x, at: values, c, scaled_bar, x_bar, n_bar, bar: adjoints, r
    ):
        """Compute the adjoints of ``c``, of the pressure and of the predicted number density (``r``)."""
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        if k >= rounds[member]:
            return
        hessian_products, divergence, work = force_adjoint(i, x, c, scaled_bar, s)
        if lane() > 0:
            return
        n_i = at.n[i]
        x_bar[i] = x_bar[i] - s.volume * hessian_products
        n_bar[i] = n_bar[i] + real(2.0) * c[i] / n_i * s.volume * divergence
        r[i] = adjoin_pressure(i, stiffness, time_step[member], s.volume, divergence, work, at, bar)

    return Kernels(pressure_force, pressure_force_tangent, pressure_force_adjoint)
