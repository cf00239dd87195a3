"""One predictive-corrective iteration (Solenthaler and Pajarola 2009):

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

from cortado.device.lanes import lane_functions
from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
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
    values = bundle(n=real, m=real, rho_0=real, y=real, p_in=real, p_out=real)
    changes = bundle(n=real, m=real, rho_0=real, y=real, p_in=real)
    adjoin_prediction = prediction_share(discretisation.precision)
    LANES = discretisation.lanes
    lane = lane_functions(discretisation.precision, LANES).lane

    @wp.kernel(module=discretisation.module(True, "pcisph"))
    def pressure(
        s: neighbourhood,
        k: int,
        rounds: wp.array(dtype=wp.int32),
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

    @wp.kernel(module=discretisation.tangent_module("pcisph"), enable_backward=False)
    def pressure_tangent(
        s: neighbourhood,
        k: int,
        rounds: wp.array(dtype=wp.int32),
        stiffness: real,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        at: values,
        x_star: wp.array(dtype=vector),
        x_star_dot: wp.array(dtype=vector),
        dot: changes,
        # out
        p_out_dot: wp.array(dtype=real),
        c_dot: wp.array(dtype=real),
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

    @wp.kernel(module=discretisation.module(False, "pcisph"), enable_backward=False)
    def pressure_adjoint(
        s: neighbourhood,
        k: int,
        rounds: wp.array(dtype=wp.int32),
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
        scaled_bar: wp.array(dtype=vector),
    ):
        """From the adjoint r of n* to that of x*, and on to what x* was predicted from."""
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
