"""Viscosity as a stress: f = -G^T (2 mu D), the force per volume of the velocity gradient's exact transpose.

With s_ij = -V a_ij of grad W = a x, so that s_ij is not negative, the sums of particle i over its neighbours are

    M_i = sum_j s_ij x_ij x_ij^T,   A_i = sum_j s_ij v_ij x_ij^T,   R_i = sum_j s_ij |x_ij|^2 / mu_j,

of which A M^-1 is the velocity gradient, corrected so that it is exact where velocities are linear (Bonet and Lok
1999), and also the one that fits the velocities of the neighbours best, with weights s_ij. What it leaves of them,
v_ij - G_i x_ij, is damped (Ganzenmueller 2015 damps it against modes that the gradient does not see):

    m_i a_i = -sum_j s_ij ((T_i + T_j) x_ij + C (mu_i + mu_j) v_ij),   T_i = 2 mu_i D_i M_i^-1 - C mu_i G_i.

That is minus half the derivative by v_i of what is dissipated, sum_i mu_i (2 D_i : D_i + C sum_j s_ij |v_ij - G_i
x_ij|^2), as the weighted sum of the remainders times x_ij is 0. So energy is never made; both parts are 0 where a body
turns as a whole, whatever the order of its particles, so that linear and angular momentum are kept. On a lattice a
shear wave of wave number k decays with mu k^2 (1 + (C / 4 - 1 / (3 m_2)) k^2 m_4 + ...), with the moments m_2 and m_4
of s_ij along k: C = 4 / (3 m_2) takes the second term out, in every direction and for every kernel.

mu_i is the harmonic mean of the viscosities between i and its neighbours (`cortado.sph.stress_functions`): it keeps the
shear stress the same on both sides of a layer.

Walls without slip: `cortado.sph.stress_forces`.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.particles.solid_shares import solid_kernel
from cortado.sph.formula import theta_of
from cortado.sph.stress_forces import stress_sums, stress_work
from cortado.sph.stress_functions import moment_sums, moments_work, stress_functions
from cortado.sph.viscosity_law import Law


@cache
def stress_kernels(discretisation: Discretisation, dimension: int, law: Law, sticks: bool) -> tuple[Kernels, Kernels]:
    """The kernels of M, A, R and what follows from them for each particle, and those of the acceleration, in 2 or 3
    dimensions, with a law of viscosity; with ``sticks`` walls have no slip. Their argument ``control`` is C, and
    ``theta`` are the parameters of the law."""
    precision = discretisation.precision
    real, vector = precision.real, precision.vector
    neighbourhood = neighbourhood_type(precision)
    name = f"viscous_stress_{law.topic}{dimension}d" + "_no_slip" * sticks
    module = discretisation.module(True, name)
    tangent_module, adjoint_module = discretisation.tangent_module(name), discretisation.module(False, name)
    own = stress_functions(precision, dimension, law, module)
    matrix, moment_of, viscosity_of, traction_of = own.matrix, own.moment, own.viscosity, own.traction
    along = stress_functions(precision, dimension, law, tangent_module)
    change_of_moment, change_of = along.moment_change, along.change
    stress_back = stress_functions(precision, dimension, law, adjoint_module).back
    theta_type = theta_of(precision, law.ranks)
    sums_of, force_of = moment_sums(discretisation, sticks), stress_sums(discretisation, sticks)
    moments, moments_tangent, moments_back = sums_of.sums, sums_of.tangent, sums_of.back
    force, force_tangent = force_of.force, force_of.tangent
    traction_back, force_back = force_of.traction_back, force_of.back
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane
    of_all, of_one = bundle(M=matrix, A=matrix, R=real, eta=real), bundle(T=matrix, eta=real)
    seen, of_particles = bundle(x=vector, v=vector, m=real), bundle(x=vector, v=vector, mu=real)

    @wp.kernel(module=module)
    def stress(
        s: neighbourhood,
        control: real,
        least: real,
        theta: wp.array(dtype=theta_type),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        mu: wp.array(dtype=real),
        # out
        M: wp.array(dtype=matrix),
        A: wp.array(dtype=matrix),
        R: wp.array(dtype=real),
        T: wp.array(dtype=matrix),
        eta: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        diagonal, others, row_x, row_y, row_z, thin = moments(i, x, v, mu, least, s)
        if lane() > 0:
            return
        M_i, A_i = moment_of(diagonal, others), wp.matrix_from_rows(row_x, row_y, row_z)
        eta_i = viscosity_of(M_i, A_i, thin, mu[i], theta[i // s.particles])
        M[i] = M_i
        A[i] = A_i
        R[i] = thin
        T[i] = traction_of(M_i, A_i, eta_i, control)
        eta[i] = eta_i

    @wp.kernel(module=module)
    def acceleration_of(
        s: neighbourhood,
        control: real,
        least: real,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        T: wp.array(dtype=matrix),
        eta: wp.array(dtype=real),
        acceleration_in: wp.array(dtype=vector),
        # out
        acceleration: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = force(i, x, v, m, T, eta, control, least, s)
        if lane() > 0:
            return
        acceleration[i] = acceleration_in[i] + total

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
        if lane() > 0:
            return
        M_dot, A_dot = change_of_moment(diagonal, others), wp.matrix_from_rows(row_x, row_y, row_z)
        b = i // s.particles
        T_i_dot, eta_i_dot = change_of(
            of.M[i],
            of.A[i],
            of.A[i],
            of.R[i],
            now.mu[i],
            theta[b],
            of.eta[i],
            control,
            M_dot,
            A_dot,
            A_dot,
            thin,
            dot.mu[i],
            theta_dot[b],
        )
        T_dot[i] = T_i_dot
        eta_dot[i] = eta_i_dot

    @wp.kernel(module=tangent_module, enable_backward=False)
    def acceleration_tangent(
        s: neighbourhood,
        control: real,
        least: real,
        now: seen,
        dot: seen,
        of: of_one,
        T_dot: wp.array(dtype=matrix),
        eta_dot: wp.array(dtype=real),
        acceleration_in_dot: wp.array(dtype=vector),
        # out
        acceleration_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = force_tangent(
            i, now.x, dot.x, now.v, dot.v, now.m, dot.m, of.T, T_dot, of.eta, eta_dot, control, least, s
        )
        if lane() > 0:
            return
        acceleration_dot[i] = acceleration_in_dot[i] + total

    @wp.kernel(module=adjoint_module, enable_backward=False)
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
        theta_bar: wp.array(dtype=theta_type),
    ):
        """From the adjoint of the acceleration to those of the sums and of the law."""
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z, eta_bar = traction_back(i, now.x, now.v, now.m, acceleration_bar, control, least, s)
        if lane() > 0:
            return
        T_bar, member = wp.matrix_from_rows(row_x, row_y, row_z), i // s.particles
        by_M, by_A, by_A_u, by_R, by_mu, by_theta = stress_back(
            of.M[i], of.A[i], of.A[i], of.R[i], mu[i], theta[member], of.eta[i], control, T_bar, eta_bar
        )
        M_bar[i] = by_M
        A_bar[i] = by_A_u + by_A
        R_bar[i] = by_R
        mu_bar[i] = mu_bar[i] + by_mu
        theta_bar[i] = by_theta

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def acceleration_adjoint(
        s: neighbourhood,
        control: real,
        least: real,
        now: seen,
        mu: wp.array(dtype=real),
        of: of_one,
        M_bar: wp.array(dtype=matrix),
        A_bar: wp.array(dtype=matrix),
        R_bar: wp.array(dtype=real),
        acceleration_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
        m_bar: wp.array(dtype=real),
        mu_bar: wp.array(dtype=real),
    ):
        """From the adjoints of the acceleration and of the sums to those of particles."""
        i = s.first + wp.tid() // LANES
        x_part, v_part, m_part = force_back(i, now.x, now.v, now.m, of.T, of.eta, acceleration_bar, control, least, s)
        x_sum, v_sum, mu_sum = moments_back(i, now.x, now.v, mu, M_bar, A_bar, R_bar, least, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_part + x_sum
        v_bar[i] = v_bar[i] + v_part + v_sum
        m_bar[i] = m_bar[i] + m_part
        mu_bar[i] = mu_bar[i] + mu_sum

    return Kernels(stress, stress_tangent, stress_adjoint), Kernels(
        acceleration_of, acceleration_tangent, acceleration_adjoint
    )


def stress_solid_kernels(discretisation: Discretisation) -> list[Callable[[], Any]]:
    """What makes the kernels of what the sums and the force give to solids without slip that move."""
    works = (moments_work, stress_work)
    return [partial(solid_kernel, discretisation, "viscous_stress", work, rubs=True) for work in works]
