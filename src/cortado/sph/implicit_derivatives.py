"""The kernels of implicit viscosity that lead to a solve and back from one: see `cortado.sph.implicit_viscosity`.

Velocities v are those at the start, of which mu is, and u = v + dt a' those at the end, of which the stress is.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.launching import bundle
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.sph.moment_functions import matrix_type
from cortado.sph.packed import theta_of
from cortado.sph.stress_forces import stress_sums
from cortado.sph.stress_functions import stress_functions
from cortado.sph.stress_moments import moment_sums
from cortado.sph.viscosity_law import Law


@dataclass(frozen=True)
class ImplicitKernels:
    """The kernels, by what they do."""

    predict: Any
    """u = v + dt a; with tangents of v and dt that of u, where a does not change."""
    stress_tangent: Any
    """The tangents of T and mu."""
    weigh: Any
    """r = a_bar / m."""
    unweigh: Any
    """r = m y."""
    stress_adjoint: Any
    """From the adjoint of the acceleration to those of the sums and of the law."""
    end_adjoint: Any
    """From the adjoint of u to those of v and dt."""
    strain_adjoint: Any
    """From the adjoint of A of the velocities at the start to those of particles."""


@cache
def implicit_kernels(discretisation: Discretisation, dimension: int, law: Law, sticks: bool) -> ImplicitKernels:
    """For the arguments of `cortado.sph.stress_kernels.stress_kernels`."""
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    neighbourhood = neighbourhood_type(precision)
    name = f"implicit_step_{law.topic}{dimension}d" + "_no_slip" * sticks
    module, tangent_module = discretisation.module(False, name), discretisation.tangent_module(name)
    along = stress_functions(precision, dimension, law, tangent_module)
    change_of_moment, change_of = along.moment_change, along.change
    stress_back = stress_functions(precision, dimension, law, module).back
    sums = moment_sums(discretisation, sticks)
    moments_tangent, moments_back = sums.tangent, sums.back
    traction_back = stress_sums(discretisation, sticks).traction_back
    theta_type = theta_of(precision, law.ranks)
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane
    of_all = bundle(M=matrix, A=matrix, R=real, eta=real, A_u=matrix)
    of_particles, seen = bundle(x=vector, v=vector, mu=real, u=vector), bundle(x=vector, v=vector, m=real)

    @wp.kernel(module=module, enable_backward=False)
    def predict(
        particles: int,
        time_step: wp.array(dtype=real),
        v: wp.array(dtype=vector),
        acceleration: wp.array(dtype=vector),
        # out
        u: wp.array(dtype=vector),
    ):
        i = wp.tid()
        u[i] = v[i] + time_step[i // particles] * acceleration[i]

    @wp.kernel(module=tangent_module, enable_backward=False)
    def stress_tangent(
        s: neighbourhood,
        control: real,
        least: real,
        theta: wp.array(dtype=theta_type),
        theta_dot: wp.array(dtype=theta_type),
        now: of_particles,
        dot: of_particles,
        of: of_all,
        # out
        T_dot: wp.array(dtype=matrix),
        eta_dot: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        diagonal, others, row_x, row_y, row_z, thin = moments_tangent(
            i, now.x, dot.x, now.v, dot.v, now.mu, dot.mu, least, s
        )
        _diagonal, _others, end_x, end_y, end_z, _thin = moments_tangent(
            i, now.x, dot.x, now.u, dot.u, now.mu, dot.mu, least, s
        )
        if lane() > 0:
            return
        M_dot, A_dot = change_of_moment(diagonal, others), wp.matrix_from_rows(row_x, row_y, row_z)
        A_u_dot, b = wp.matrix_from_rows(end_x, end_y, end_z), i // s.particles
        T_i_dot, eta_i_dot = change_of(
            of.M[i],
            of.A[i],
            of.A_u[i],
            of.R[i],
            now.mu[i],
            theta[b],
            of.eta[i],
            control,
            M_dot,
            A_dot,
            A_u_dot,
            thin,
            dot.mu[i],
            theta_dot[b],
        )
        T_dot[i] = T_i_dot
        eta_dot[i] = eta_i_dot

    @wp.kernel(module=module, enable_backward=False)
    def weigh(
        m: wp.array(dtype=real),
        acceleration_bar: wp.array(dtype=vector),
        # out
        r: wp.array(dtype=vector),
    ):
        i = wp.tid()
        r[i] = acceleration_bar[i] / m[i]

    @wp.kernel(module=module, enable_backward=False)
    def unweigh(
        m: wp.array(dtype=real),
        y: wp.array(dtype=vector),
        # out
        r: wp.array(dtype=vector),
    ):
        i = wp.tid()
        r[i] = m[i] * y[i]

    @wp.kernel(module=module, enable_backward=False)
    def stress_adjoint(
        s: neighbourhood,
        control: real,
        least: real,
        theta: wp.array(dtype=theta_type),
        now: seen,
        mu: wp.array(dtype=real),
        of: of_all,
        acceleration_bar: wp.array(dtype=vector),
        # in and out
        mu_bar: wp.array(dtype=real),
        # out
        M_bar: wp.array(dtype=matrix),
        A_bar: wp.array(dtype=matrix),
        R_bar: wp.array(dtype=real),
        A_v_bar: wp.array(dtype=matrix),
        theta_bar: wp.array(dtype=theta_type),
    ):
        """``now.v`` are velocities at the end, ``A_bar`` is of theirs, and ``A_v_bar`` of those at the start."""
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z, eta_bar = traction_back(i, now.x, now.v, now.m, acceleration_bar, control, least, s)
        if lane() > 0:
            return
        T_bar, member = wp.matrix_from_rows(row_x, row_y, row_z), i // s.particles
        by_M, by_A, by_A_u, by_R, by_mu, by_theta = stress_back(
            of.M[i], of.A[i], of.A_u[i], of.R[i], mu[i], theta[member], of.eta[i], control, T_bar, eta_bar
        )
        M_bar[i] = by_M
        A_bar[i] = by_A_u
        A_v_bar[i] = by_A
        R_bar[i] = by_R
        mu_bar[i] = mu_bar[i] + by_mu
        theta_bar[i] = by_theta

    @wp.kernel(module=module, enable_backward=False)
    def end_adjoint(
        acceleration: wp.array(dtype=vector),
        u_bar: wp.array(dtype=vector),
        # in and out
        v_bar: wp.array(dtype=vector),
        time_step_bar: wp.array(dtype=real),
    ):
        i = wp.tid()
        v_bar[i] = v_bar[i] + u_bar[i]
        time_step_bar[i] = time_step_bar[i] + wp.dot(u_bar[i], acceleration[i])

    @wp.kernel(module=module, enable_backward=False)
    def strain_adjoint(
        s: neighbourhood,
        least: real,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        mu: wp.array(dtype=real),
        M_bar: wp.array(dtype=matrix),
        A_bar: wp.array(dtype=matrix),
        R_bar: wp.array(dtype=real),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        x_sum, v_sum, _mu_sum = moments_back(i, x, v, mu, M_bar, A_bar, R_bar, least, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_sum
        v_bar[i] = v_bar[i] + v_sum

    return ImplicitKernels(predict, stress_tangent, weigh, unweigh, stress_adjoint, end_adjoint, strain_adjoint)
