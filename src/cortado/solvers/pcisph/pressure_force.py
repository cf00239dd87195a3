"""The pressure force of an iteration, and the prediction that follows it: see `cortado.solvers.pcisph.pressure`."""

from functools import cache

import warp as wp

from cortado.device.kernels import Kernels
from cortado.device.lanes import lane_functions
from cortado.device.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions


@cache
def pressure_force_kernels(discretisation: Discretisation) -> Kernels:
    """Kernels ``forward``, ``tangent``, ``adjoint`` of the pressure force and the prediction that follows it."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    neighbour, wall_position, wall_weight = pair.neighbour, pair.wall_position, pair.wall_weight
    separation, slope, slope_change = pair.separation, pair.slope, pair.slope_change
    gradient, hessian_product = pair.gradient, pair.hessian_product
    vectors, numbers = pair.vectors, pair.numbers
    LANES = discretisation.lanes
    lanes = lane_functions(discretisation.precision, LANES)
    lane, add_up, add_up_vectors = lanes.lane, lanes.add_up, lanes.add_up_vectors

    @wp.func
    def force_sum(i: int, x: wp.array(dtype=vector), c: wp.array(dtype=real), s: neighbourhood) -> vector:
        x_i = x[i]
        c_i = c[i]
        total = vector()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            c_j = numbers(c, k, i, s)
            for u in range(UNROLL):
                x_ij = separation(x_i, x_j[u], s)
                total += ((c_i + c_j[u]) * slope(x_ij, s)) * x_ij
        for k in range(s.fluid_count[i] + lane(), s.count[i], LANES):
            b = neighbour(k, i, s)
            total += (wall_weight(b, s) * c_i) * gradient(separation(x_i, wall_position(b, s), s), s)
        return add_up_vectors(total)

    @wp.func
    def force_sum_tangent(
        i: int,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        c: wp.array(dtype=real),
        c_dot: wp.array(dtype=real),
        s: neighbourhood,
    ) -> vector:
        x_i = x[i]
        x_dot_i = x_dot[i]
        c_i = c[i]
        c_dot_i = c_dot[i]
        total = vector()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            for u in range(UNROLL):
                j = neighbour(k + u, i, s)
                x_ij = separation(x_i, x[j], s)
                total += (c_dot_i + c_dot[j]) * gradient(x_ij, s)
                total += (c_i + c[j]) * hessian_product(x_ij, x_dot_i - x_dot[j], s)
        for k in range(s.fluid_count[i] + lane(), s.count[i], LANES):
            b = neighbour(k, i, s)
            x_ib = separation(x_i, wall_position(b, s), s)
            total += (wall_weight(b, s) * c_dot_i) * gradient(x_ib, s)
            total += (wall_weight(b, s) * c_i) * hessian_product(x_ib, x_dot_i, s)
        return add_up_vectors(total)

    @wp.kernel(module=discretisation.module(True, "pcisph"))
    def pressure_force(
        s: neighbourhood,
        k: int,
        rounds: wp.array(dtype=wp.int32),
        time_step: wp.array(dtype=real),
        m: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        acceleration: wp.array(dtype=vector),
        c: wp.array(dtype=real),
        x_before: wp.array(dtype=vector),
        v_before: wp.array(dtype=vector),
        # out
        x_star: wp.array(dtype=vector),
        v_star: wp.array(dtype=vector),
    ):
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
        total = force_sum(i, x, c, s)
        if lane() > 0:
            return
        velocity = v_i + dt * (a_i + scale * total)
        v_star[i] = velocity
        x_star[i] = x_i + dt * velocity

    @wp.kernel(module=discretisation.tangent_module("pcisph"), enable_backward=False)
    def pressure_force_tangent(
        s: neighbourhood,
        k: int,
        rounds: wp.array(dtype=wp.int32),
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        m: wp.array(dtype=real),
        m_dot: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        acceleration: wp.array(dtype=vector),
        acceleration_dot: wp.array(dtype=vector),
        c: wp.array(dtype=real),
        c_dot: wp.array(dtype=real),
        v_star: wp.array(dtype=vector),
        # out
        x_star_dot: wp.array(dtype=vector),
        v_star_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        if k >= rounds[member]:
            return
        total_dot = force_sum_tangent(i, x, x_dot, c, c_dot, s)
        if lane() > 0:
            return
        dt = time_step[member]
        accelerated = (v_star[i] - v[i]) / dt
        push = accelerated - acceleration[i]
        push_dot = (-s.volume / m[i]) * total_dot - (m_dot[i] / m[i]) * push
        velocity_dot = v_dot[i] + dt * (acceleration_dot[i] + push_dot) + time_step_dot[member] * accelerated
        v_star_dot[i] = velocity_dot
        x_star_dot[i] = x_dot[i] + dt * velocity_dot + time_step_dot[member] * v_star[i]

    @wp.kernel(module=discretisation.module(False, "pcisph"), enable_backward=False)
    def pressure_force_adjoint(
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
        x_bar: wp.array(dtype=vector),
        n_bar: wp.array(dtype=real),
        m_bar: wp.array(dtype=real),
        rho_0_bar: wp.array(dtype=real),
        y_bar: wp.array(dtype=real),
        p_bar: wp.array(dtype=real),
        time_step_bar: wp.array(dtype=real),
        # out
        r: wp.array(dtype=real),
    ):
        """From ``scaled_bar``, the adjoint of the pressure acceleration over m, to those of c, p and (r) of n*: every
        sum a gather."""
        i = s.first + wp.tid() // LANES
        member = i // s.particles
        if k >= rounds[member]:
            return
        x_i = x[i]
        c_i = c[i]
        scaled_bar_i = scaled_bar[i]
        divergence = real(0.0)
        hessian_products = vector()
        work = real(0.0)
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            c_j = numbers(c, k, i, s)
            scaled_bar_j = vectors(scaled_bar, k, i, s)
            for u in range(UNROLL):
                x_ij = separation(x_i, x_j[u], s)
                u_ij = scaled_bar_i - scaled_bar_j[u]
                a = slope(x_ij, s)
                c_ij = c_i + c_j[u]
                divergence += a * wp.dot(x_ij, u_ij)
                hessian_products += (c_ij * a) * u_ij + (c_ij * slope_change(x_ij, u_ij, s)) * x_ij
                work += (c_ij * a) * wp.dot(x_ij, scaled_bar_i)
        for k in range(s.fluid_count[i] + lane(), s.count[i], LANES):
            b = neighbour(k, i, s)
            x_ib = separation(x_i, wall_position(b, s), s)
            weight = wall_weight(b, s)
            wall_divergence = weight * wp.dot(gradient(x_ib, s), scaled_bar_i)
            divergence += wall_divergence
            hessian_products += (weight * c_i) * hessian_product(x_ib, scaled_bar_i, s)
            work += c_i * wall_divergence
        divergence = add_up(divergence)
        hessian_products = add_up_vectors(hessian_products)
        work = add_up(work)
        if lane() > 0:
            return
        n_i = n[i]
        m_i = m[i]
        p_i = p_out[i]
        delta = y[i] * stiffness / (time_step[member] * time_step[member])
        c_bar = -s.volume * divergence
        p_bar_i = real(0.0)
        if p_i > real(0.0):
            p_bar_i = p_bar[i] + c_bar / (n_i * n_i)
        excess_bar = delta * p_bar_i
        excess = (p_i - p_in[i]) / delta
        x_bar[i] = x_bar[i] - s.volume * hessian_products
        n_bar[i] = n_bar[i] - real(2.0) * c_i / n_i * c_bar
        m_bar[i] = m_bar[i] + (s.volume * work + excess_bar * (excess + rho_0[i])) / m_i
        rho_0_bar[i] = rho_0_bar[i] - excess_bar
        y_bar[i] = y_bar[i] + excess_bar * excess / y[i]
        p_bar[i] = p_bar_i
        r[i] = m_i * excess_bar
        time_step_bar[i] = time_step_bar[i] - real(2.0) * excess_bar * excess / time_step[member]

    return Kernels(pressure_force, pressure_force_tangent, pressure_force_adjoint)
