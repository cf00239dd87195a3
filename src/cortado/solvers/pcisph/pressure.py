"""One predictive-corrective iteration (Solenthaler and Pajarola 2009; report eqs. 6 and 9, put right):

    p_i  = max(p_i + delta y_i (m_i n*_i - rho_0i), 0),   delta = k / dt^2
    c_i  = p_i / n_i^2
    ap_i = -(V / m_i) (sum_j (c_i + c_j) G_ij + sum_b w_b c_i G_ib)
    v*_i = v_i + dt (a_i + ap_i),   x*_i = x_i + dt v*_i

n is the number density (`cortado.sph.density`; for fluids of different masses: Solenthaler and Pajarola 2008),
y the relaxation beside walls (`cortado.solvers.pcisph.wall_relaxation`). G is taken at x(t), n* at the predicted
positions over the neighbours of x(t). The force is the transpose of the derivative of n with respect to positions,
that of walls included: moving particles against it takes the work V sum_i c_i dn_i. After the last iteration (x*, v*)
is the new state. The clamp at 0 (no suction at a free surface) has the derivative [p > 0].
"""

from functools import cache

import warp as wp

from cortado.device.kernels import Kernels
from cortado.device.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions
from cortado.sph.density import density_sums
from cortado.sph.integration import prediction_share


@cache
def pressure_kernels(discretisation: Discretisation) -> Kernels:
    """Kernels ``forward``, ``tangent``, ``adjoint`` of the pressure from the predicted density."""
    real, vector, pair_of = (
        discretisation.precision.real,
        discretisation.precision.vector,
        discretisation.precision.pair,
    )
    neighbourhood = neighbourhood_type(discretisation.precision)
    sums = density_sums(discretisation)
    weights, weights_tangent, weights_adjoint = sums.weights, sums.weights_tangent, sums.weights_adjoint
    adjoin_prediction = prediction_share(discretisation.precision)

    @wp.kernel(module=discretisation.module(True))
    def pressure(
        s: neighbourhood,
        stiffness: real,
        time_step: wp.array(dtype=real),
        n: wp.array(dtype=real),
        m: wp.array(dtype=real),
        rho_0: wp.array(dtype=real),
        y: wp.array(dtype=real),
        x_star: wp.array(dtype=vector),
        p_in: wp.array(dtype=real),
        # out
        p_out: wp.array(dtype=real),
        c: wp.array(dtype=real),
        error: wp.array(dtype=pair_of),
    ):
        """``error``: the compression (rho* - rho_0)+ / rho_0 of a particle, twice (for a sum and a maximum)."""
        i = s.first + wp.tid()
        total = weights(i, x_star, s)
        excess = m[i] * s.volume * (real(1 - s.filling[i]) * s.self_weight + total) - rho_0[i]
        delta = y[i] * stiffness / (time_step[0] * time_step[0])
        p_i = p_in[i] + delta * excess
        if p_i < real(0.0):  # not wp.max, which would turn NaN into 0 and hide it
            p_i = real(0.0)
        compression = wp.max(excess / rho_0[i], real(0.0))
        p_out[i] = p_i
        c[i] = p_i / (n[i] * n[i])
        error[i] = pair_of(compression, compression)

    @wp.kernel(module=discretisation.module(False), enable_backward=False)
    def pressure_tangent(
        s: neighbourhood,
        stiffness: real,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        n: wp.array(dtype=real),
        n_dot: wp.array(dtype=real),
        m: wp.array(dtype=real),
        m_dot: wp.array(dtype=real),
        rho_0: wp.array(dtype=real),
        rho_0_dot: wp.array(dtype=real),
        y: wp.array(dtype=real),
        y_dot: wp.array(dtype=real),
        x_star: wp.array(dtype=vector),
        x_star_dot: wp.array(dtype=vector),
        p_in: wp.array(dtype=real),
        p_in_dot: wp.array(dtype=real),
        p_out: wp.array(dtype=real),
        # out
        p_out_dot: wp.array(dtype=real),
        c_dot: wp.array(dtype=real),
    ):
        i = s.first + wp.tid()
        total = weights_tangent(i, x_star, x_star_dot, s)
        p_i = p_out[i]
        p_dot_i = real(0.0)
        if p_i > real(0.0):
            delta = y[i] * stiffness / (time_step[0] * time_step[0])
            excess = (p_i - p_in[i]) / delta
            excess_dot = m[i] * s.volume * total + (excess + rho_0[i]) * m_dot[i] / m[i] - rho_0_dot[i]
            delta_dot = delta * (y_dot[i] / y[i] - real(2.0) * time_step_dot[0] / time_step[0])
            p_dot_i = p_in_dot[i] + delta * excess_dot + delta_dot * excess
        n_i = n[i]
        p_out_dot[i] = p_dot_i
        c_dot[i] = (p_dot_i - real(2.0) * p_i / n_i * n_dot[i]) / (n_i * n_i)

    @wp.kernel(module=discretisation.module(False), enable_backward=False)
    def pressure_adjoint(
        s: neighbourhood,
        time_step: wp.array(dtype=real),
        m: wp.array(dtype=real),
        v: wp.array(dtype=vector),
        x_star: wp.array(dtype=vector),
        v_star: wp.array(dtype=vector),
        r: wp.array(dtype=real),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
        time_step_bar: wp.array(dtype=real),
        # out
        push_bar: wp.array(dtype=vector),
    ):
        """From the adjoint r of n* to that of x*, and on to what x* was predicted from."""
        i = s.first + wp.tid()
        x_star_bar = s.volume * weights_adjoint(i, x_star, r, s)
        dt = time_step[0]
        speed_bar = dt * x_star_bar
        x_bar[i] = x_bar[i] + x_star_bar
        v_bar[i] = v_bar[i] + speed_bar
        push_bar[i] = (dt / m[i]) * speed_bar
        time_step_bar[i] = time_step_bar[i] + adjoin_prediction(x_star_bar, speed_bar, v[i], v_star[i], dt)

    return Kernels(pressure, pressure_tangent, pressure_adjoint)


@cache
def pressure_force_kernels(discretisation: Discretisation) -> Kernels:
    """Kernels ``forward``, ``tangent``, ``adjoint`` of the pressure force and the prediction that follows it."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    separation, gradient, hessian_product = pair.separation, pair.gradient, pair.hessian_product
    vectors, numbers = pair.vectors, pair.numbers

    @wp.func
    def force_sum(i: int, x: wp.array(dtype=vector), c: wp.array(dtype=real), s: neighbourhood) -> vector:
        x_i = x[i]
        c_i = c[i]
        total = vector()
        for k in range(0, s.fluid_count[i], UNROLL):
            x_j = vectors(x, k, i, s)
            c_j = numbers(c, k, i, s)
            for u in range(UNROLL):
                total += (c_i + c_j[u]) * gradient(separation(x_i, x_j[u], s), s)
        for k in range(s.fluid_count[i], s.count[i]):
            b = s.neighbours[k, i]
            total += (s.wall_weights[b] * c_i) * gradient(separation(x_i, s.wall_positions[b], s), s)
        return total

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
        for k in range(0, s.fluid_count[i], UNROLL):
            for u in range(UNROLL):
                j = s.neighbours[k + u, i]
                x_ij = separation(x_i, x[j], s)
                total += (c_dot_i + c_dot[j]) * gradient(x_ij, s)
                total += (c_i + c[j]) * hessian_product(x_ij, x_dot_i - x_dot[j], s)
        for k in range(s.fluid_count[i], s.count[i]):
            b = s.neighbours[k, i]
            x_ib = separation(x_i, s.wall_positions[b], s)
            total += (s.wall_weights[b] * c_dot_i) * gradient(x_ib, s)
            total += (s.wall_weights[b] * c_i) * hessian_product(x_ib, x_dot_i, s)
        return total

    @wp.kernel(module=discretisation.module(True))
    def pressure_force(
        s: neighbourhood,
        time_step: wp.array(dtype=real),
        m: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        acceleration: wp.array(dtype=vector),
        c: wp.array(dtype=real),
        # out
        x_star: wp.array(dtype=vector),
        v_star: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        total = force_sum(i, x, c, s)
        dt = time_step[0]
        push = (-s.volume / m[i]) * total
        velocity = v[i] + dt * (acceleration[i] + push)
        v_star[i] = velocity
        x_star[i] = x[i] + dt * velocity

    @wp.kernel(module=discretisation.module(False), enable_backward=False)
    def pressure_force_tangent(
        s: neighbourhood,
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
        i = s.first + wp.tid()
        total_dot = force_sum_tangent(i, x, x_dot, c, c_dot, s)
        dt = time_step[0]
        accelerated = (v_star[i] - v[i]) / dt
        push = accelerated - acceleration[i]
        push_dot = (-s.volume / m[i]) * total_dot - (m_dot[i] / m[i]) * push
        velocity_dot = v_dot[i] + dt * (acceleration_dot[i] + push_dot) + time_step_dot[0] * accelerated
        v_star_dot[i] = velocity_dot
        x_star_dot[i] = x_dot[i] + dt * velocity_dot + time_step_dot[0] * v_star[i]

    @wp.kernel(module=discretisation.module(False), enable_backward=False)
    def pressure_force_adjoint(
        s: neighbourhood,
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
        push_bar: wp.array(dtype=vector),
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
        """From ``push_bar``, the adjoint of the pressure acceleration over m, to those of c, p and (r) of n*: every
        sum a gather."""
        i = s.first + wp.tid()
        x_i = x[i]
        c_i = c[i]
        push_bar_i = push_bar[i]
        divergence = real(0.0)
        hessian_products = vector()
        work = real(0.0)
        for k in range(0, s.fluid_count[i], UNROLL):
            x_j = vectors(x, k, i, s)
            c_j = numbers(c, k, i, s)
            push_bar_j = vectors(push_bar, k, i, s)
            for u in range(UNROLL):
                x_ij = separation(x_i, x_j[u], s)
                g_ij = gradient(x_ij, s)
                u_ij = push_bar_i - push_bar_j[u]
                divergence += wp.dot(g_ij, u_ij)
                hessian_products += (c_i + c_j[u]) * hessian_product(x_ij, u_ij, s)
                work += (c_i + c_j[u]) * wp.dot(g_ij, push_bar_i)
        for k in range(s.fluid_count[i], s.count[i]):
            b = s.neighbours[k, i]
            x_ib = separation(x_i, s.wall_positions[b], s)
            weight = s.wall_weights[b]
            wall_divergence = weight * wp.dot(gradient(x_ib, s), push_bar_i)
            divergence += wall_divergence
            hessian_products += (weight * c_i) * hessian_product(x_ib, push_bar_i, s)
            work += c_i * wall_divergence
        n_i = n[i]
        m_i = m[i]
        p_i = p_out[i]
        delta = y[i] * stiffness / (time_step[0] * time_step[0])
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
        time_step_bar[i] = time_step_bar[i] - real(2.0) * excess_bar * excess / time_step[0]

    return Kernels(pressure_force, pressure_force_tangent, pressure_force_adjoint)
