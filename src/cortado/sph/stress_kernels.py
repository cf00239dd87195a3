"""Viscosity as a stress: f = -G^T (2 mu D), the force per volume of the velocity gradient's exact transpose.

With s_ij = -V a_ij of grad W = a x, so that s_ij is not negative, the sums of particle i over its neighbours are

    M_i = sum_j s_ij x_ij x_ij^T,   A_i = sum_j s_ij v_ij x_ij^T,   R_i = sum_j s_ij |x_ij|^2 / mu_j,

of which A M^-1 is the velocity gradient, corrected so that it is exact where velocities are linear (Bonet and Lok
1999), and also the one that fits the velocities of the neighbours best, with weights s_ij. What it leaves of them,
v_ij - G_i x_ij, is damped (Ganzenmueller 2015 damps it against modes that the gradient does not see):

    m_i a_i = -sum_j s_ij ((T_i + T_j) x_ij + C (mu_i + mu_j) v_ij),   T_i = 2 mu_i D_i M_i^-1 - C mu_i G_i.

That is minus half the derivative by v_i of what is dissipated, sum_i mu_i (2 D_i : D_i + C sum_j s_ij |v_ij - G_i
x_ij|^2), as the weighted sum of the remainders times x_ij is 0. So energy is never made; both parts are 0 where a body
turns as a whole, whatever the order of its particles, so that linear and angular momentum are kept. On a lattice a shear
wave of wave number k decays with mu k^2 (1 + (C / 4 - 1 / 3) k^2 m_4 / m_2 + ...), with the moments m_2 and m_4 of
s_ij along k: C = 4 / (3 m_2) takes the second term out, in every direction and for every kernel.

mu_i is the harmonic mean of the viscosities between i and its neighbours (`cortado.sph.stress_functions`): it keeps the
shear stress the same on both sides of a layer.

A wall without slip is a neighbour at the point y of its surface below the particle, at rest: with its normal n, the
distance d of the particle from it, and a particle b of the wall that lies at x_b,

    y_ib = d n,   s_w = w_b s_ib (n . x_ib) / max(d, e),

as if velocities went on behind the wall with their sign turned (Morris, Fox and Zhu 1997). d is 0 behind the surface,
and e a quarter of a spacing, closer than which a wall pulls no harder; there the derivative has a corner.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.bundles import bundle
from cortado.device.kernels import Kernels
from cortado.device.lanes import lane_functions
from cortado.particles.by_hand import tangent_of
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum, pair_sum
from cortado.sph.stress_functions import stress_functions


@cache
def stress_kernels(
    discretisation: Discretisation, dimension: int, control: float, sticks: bool
) -> tuple[Kernels, Kernels]:
    """The kernels of M, A, R and what follows from them for each particle, and those of the acceleration, in 2 or 3
    dimensions; ``control`` is C, and with ``sticks`` walls have no slip."""
    precision = discretisation.precision
    real, vector = precision.real, precision.vector
    neighbourhood = neighbourhood_type(precision)
    pair = pair_functions(discretisation)
    slope, slope_gradient = pair.slope, pair.slope_gradient
    own = stress_functions(precision, dimension, control)
    matrix, moment_of, change_of_moment = own.matrix, own.moment, own.moment_change
    fluidity, work = own.fluidity, own.work
    viscosity_of, traction_of = own.viscosity, own.traction
    C = wp.constant(real(control))
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane
    sums, of_one = bundle(M=matrix, A=matrix, R=real), bundle(T=matrix, eta=real)
    seen, changes = bundle(x=vector, v=vector, m=real), bundle(x=vector, v=vector, mu=real)
    name = f"viscous_stress_{dimension}d" + "_no_slip" * sticks

    def summed(wall_term: Any, ahead: bool = True) -> Any:
        """The decorator of a sum over what the fluid rubs against."""
        return pair_sum(discretisation, wall_term, ahead) if sticks else fluid_sum(discretisation, ahead)

    @wp.func
    def weight(x: vector, s: neighbourhood) -> real:
        """s_ij"""
        return -s.volume * slope(x, s)

    @wp.func
    def height(x_ib: vector, foot: vector) -> real:
        """d before it is kept from falling below 0."""
        depth = wp.length(foot)
        return wp.dot(x_ib, foot) / depth - depth

    @wp.func
    def fall(x_ib: vector, foot: vector) -> vector:
        """y"""
        return (wp.max(height(x_ib, foot), real(0.0)) / wp.length(foot)) * foot

    @wp.func
    def hold(x_ib: vector, foot: vector, least: real, s: neighbourhood) -> real:
        """s_w / w_b"""
        d = height(x_ib, foot)
        return weight(x_ib, s) * (d + wp.length(foot)) / wp.max(d, least)

    @wp.func
    def fall_change(x_ib: vector, u: vector, foot: vector) -> vector:
        """The derivative of y along a change u of x, and its transpose applied to u."""
        square = wp.dot(foot, foot)
        return wp.where(height(x_ib, foot) > real(0.0), wp.dot(u, foot) / square, real(0.0)) * foot

    @wp.func
    def hold_gradient(x_ib: vector, foot: vector, least: real, s: neighbourhood) -> vector:
        """The gradient of s_w / w_b."""
        depth, d = wp.length(foot), height(x_ib, foot)
        per = real(1.0) / wp.max(d, least)
        along = weight(x_ib, s) * per * (real(1.0) - wp.where(d > least, (d + depth) * per, real(0.0)))
        return (-s.volume * (d + depth) * per) * slope_gradient(x_ib, s) + (along / depth) * foot

    # ---- the sums ------------------------------------------------------------------------------------------------

    @wp.func
    def cross_terms(a: vector, b: vector) -> vector:
        """Entries yz, xz and xy of a b^T."""
        return vector(a[1] * b[2], a[0] * b[2], a[0] * b[1])

    @wp.func
    def even_terms(a: vector, b: vector) -> vector:
        """Entries yz, xz and xy of a b^T + b a^T."""
        return cross_terms(a, b) + cross_terms(b, a)

    def wall_moments(
        x_ij: vector, v_ij: vector, mu_i: real, least: real, foot: vector, s: neighbourhood
    ) -> tuple[vector, vector, vector, vector, vector, real]:
        w, y = hold(x_ij, foot, least, s), fall(x_ij, foot)
        z = w * y
        rub = wp.dot(z, y) * fluidity(mu_i)
        return wp.cw_mul(z, y), cross_terms(z, y), v_ij[0] * z, v_ij[1] * z, v_ij[2] * z, rub

    @summed(wall_moments)
    def moments(
        x_ij: vector, v_ij: vector, mu_i: real, mu_j: real, least: real, s: neighbourhood
    ) -> tuple[vector, vector, vector, vector, vector, real]:
        """M in two parts, the rows of A, and R."""
        z = weight(x_ij, s) * x_ij
        rub = wp.dot(z, x_ij) * fluidity(mu_j)
        return wp.cw_mul(z, x_ij), cross_terms(z, x_ij), v_ij[0] * z, v_ij[1] * z, v_ij[2] * z, rub

    def wall_moments_tangent(
        x_ij: vector,
        x_dot_ij: vector,
        v_ij: vector,
        v_dot_ij: vector,
        mu_i: real,
        mu_dot_i: real,
        least: real,
        foot: vector,
        s: neighbourhood,
    ) -> tuple[vector, vector, vector, vector, vector, real]:
        w, y, u = hold(x_ij, foot, least, s), fall(x_ij, foot), fall_change(x_ij, x_dot_ij, foot)
        w_dot, thin = wp.dot(hold_gradient(x_ij, foot, least, s), x_dot_ij), fluidity(mu_i)
        z, z_dot, even = w * y, w_dot * y + w * u, w_dot * y + real(2.0) * w * u
        rub = wp.dot(even, y) * thin - wp.dot(z, y) * thin * thin * mu_dot_i
        others = w_dot * cross_terms(y, y) + w * even_terms(y, u)
        return (
            wp.cw_mul(even, y),
            others,
            v_ij[0] * z_dot + v_dot_ij[0] * z,
            v_ij[1] * z_dot + v_dot_ij[1] * z,
            v_ij[2] * z_dot + v_dot_ij[2] * z,
            rub,
        )

    @tangent_of(moments)
    @summed(wall_moments_tangent, ahead=False)
    def moments_tangent(
        x_ij: vector,
        x_dot_ij: vector,
        v_ij: vector,
        v_dot_ij: vector,
        mu_i: real,
        mu_j: real,
        mu_dot_i: real,
        mu_dot_j: real,
        least: real,
        s: neighbourhood,
    ) -> tuple[vector, vector, vector, vector, vector, real]:
        w, w_dot = weight(x_ij, s), -s.volume * wp.dot(slope_gradient(x_ij, s), x_dot_ij)
        thin = fluidity(mu_j)
        z, z_dot, even = w * x_ij, w_dot * x_ij + w * x_dot_ij, w_dot * x_ij + real(2.0) * w * x_dot_ij
        rub = wp.dot(even, x_ij) * thin - wp.dot(z, x_ij) * thin * thin * mu_dot_j
        others = w_dot * cross_terms(x_ij, x_ij) + w * even_terms(x_ij, x_dot_ij)
        return (
            wp.cw_mul(even, x_ij),
            others,
            v_ij[0] * z_dot + v_dot_ij[0] * z,
            v_ij[1] * z_dot + v_dot_ij[1] * z,
            v_ij[2] * z_dot + v_dot_ij[2] * z,
            rub,
        )

    def wall_moments_back(
        x_ij: vector,
        v_ij: vector,
        mu_i: real,
        M_bar_i: matrix,
        A_bar_i: matrix,
        R_bar_i: real,
        least: real,
        foot: vector,
        s: neighbourhood,
    ) -> tuple[vector, vector, real]:
        w, y, thin = hold(x_ij, foot, least, s), fall(x_ij, foot), fluidity(mu_i)
        turned, pulled, square = M_bar_i * y, A_bar_i * y, wp.dot(y, y)
        level = wp.dot(y, turned) + wp.dot(v_ij, pulled) + R_bar_i * square * thin
        by_y = real(2.0) * turned + wp.transpose(A_bar_i) * v_ij + (real(2.0) * R_bar_i * thin) * y
        x_part = level * hold_gradient(x_ij, foot, least, s) + w * fall_change(x_ij, by_y, foot)
        return x_part, w * pulled, -R_bar_i * w * square * thin * thin

    @summed(wall_moments_back)
    def moments_back(
        x_ij: vector,
        v_ij: vector,
        mu_i: real,
        mu_j: real,
        M_bar_i: matrix,
        M_bar_j: matrix,
        A_bar_i: matrix,
        A_bar_j: matrix,
        R_bar_i: real,
        R_bar_j: real,
        least: real,
        s: neighbourhood,
    ) -> tuple[vector, vector, real]:
        """What the pair gives to x, v and mu of i, for adjoints of M, of A and of R."""
        w, square, thin_i = weight(x_ij, s), wp.dot(x_ij, x_ij), fluidity(mu_i)
        A_bar, rub = A_bar_i + A_bar_j, R_bar_i * fluidity(mu_j) + R_bar_j * thin_i
        turned, pulled = (M_bar_i + M_bar_j) * x_ij, A_bar * x_ij
        level = wp.dot(x_ij, turned) + wp.dot(v_ij, pulled) + rub * square
        by_x = real(2.0) * turned + wp.transpose(A_bar) * v_ij + (real(2.0) * rub) * x_ij
        x_part = (-s.volume * level) * slope_gradient(x_ij, s) + w * by_x
        return x_part, w * pulled, -R_bar_j * w * square * thin_i * thin_i

    # ---- the force -----------------------------------------------------------------------------------------------

    def wall_force(
        x_ij: vector, v_ij: vector, m_i: real, T_i: matrix, mu_i: real, least: real, foot: vector, s: neighbourhood
    ) -> vector:
        return (-hold(x_ij, foot, least, s) / m_i) * (T_i * fall(x_ij, foot) + (C * mu_i) * v_ij)

    @summed(wall_force)
    def force(
        x_ij: vector,
        v_ij: vector,
        m_i: real,
        T_i: matrix,
        T_j: matrix,
        mu_i: real,
        mu_j: real,
        least: real,
        s: neighbourhood,
    ) -> vector:
        return (-weight(x_ij, s) / m_i) * ((T_i + T_j) * x_ij + (C * (mu_i + mu_j)) * v_ij)

    def wall_force_tangent(
        x_ij: vector,
        x_dot_ij: vector,
        v_ij: vector,
        v_dot_ij: vector,
        m_i: real,
        m_dot_i: real,
        T_i: matrix,
        T_dot_i: matrix,
        mu_i: real,
        mu_dot_i: real,
        least: real,
        foot: vector,
        s: neighbourhood,
    ) -> vector:
        w, y, u = hold(x_ij, foot, least, s), fall(x_ij, foot), fall_change(x_ij, x_dot_ij, foot)
        w_dot = wp.dot(hold_gradient(x_ij, foot, least, s), x_dot_ij) - w * m_dot_i / m_i
        pull = T_i * y + (C * mu_i) * v_ij
        change = T_dot_i * y + T_i * u + C * (mu_dot_i * v_ij + mu_i * v_dot_ij)
        return (real(-1.0) / m_i) * (w_dot * pull + w * change)

    @tangent_of(force)
    @summed(wall_force_tangent, ahead=False)
    def force_tangent(
        x_ij: vector,
        x_dot_ij: vector,
        v_ij: vector,
        v_dot_ij: vector,
        m_i: real,
        m_dot_i: real,
        T_i: matrix,
        T_j: matrix,
        T_dot_i: matrix,
        T_dot_j: matrix,
        mu_i: real,
        mu_j: real,
        mu_dot_i: real,
        mu_dot_j: real,
        least: real,
        s: neighbourhood,
    ) -> vector:
        w = weight(x_ij, s)
        w_dot = -s.volume * wp.dot(slope_gradient(x_ij, s), x_dot_ij) - w * m_dot_i / m_i
        T, mu = T_i + T_j, C * (mu_i + mu_j)
        pull = T * x_ij + mu * v_ij
        change = (T_dot_i + T_dot_j) * x_ij + T * x_dot_ij + (C * (mu_dot_i + mu_dot_j)) * v_ij + mu * v_dot_ij
        return (real(-1.0) / m_i) * (w_dot * pull + w * change)

    def wall_traction_back(
        x_ij: vector, v_ij: vector, m_i: real, bar_i: vector, least: real, foot: vector, s: neighbourhood
    ) -> tuple[vector, vector, vector, real]:
        z = (-hold(x_ij, foot, least, s) / m_i) * bar_i
        y = fall(x_ij, foot)
        return z[0] * y, z[1] * y, z[2] * y, C * wp.dot(z, v_ij)

    @summed(wall_traction_back)
    def traction_back(
        x_ij: vector, v_ij: vector, m_i: real, m_j: real, bar_i: vector, bar_j: vector, least: real, s: neighbourhood
    ) -> tuple[vector, vector, vector, real]:
        """What it gives to the rows of T and to mu."""
        z = -weight(x_ij, s) * (bar_i / m_i - bar_j / m_j)
        return z[0] * x_ij, z[1] * x_ij, z[2] * x_ij, C * wp.dot(z, v_ij)

    def wall_force_back(
        x_ij: vector,
        v_ij: vector,
        m_i: real,
        T_i: matrix,
        mu_i: real,
        bar_i: vector,
        least: real,
        foot: vector,
        s: neighbourhood,
    ) -> tuple[vector, vector, real]:
        w, y, u = hold(x_ij, foot, least, s), fall(x_ij, foot), bar_i / m_i
        level = -wp.dot(u, T_i * y + (C * mu_i) * v_ij)
        x_part = level * hold_gradient(x_ij, foot, least, s) - w * fall_change(x_ij, wp.transpose(T_i) * u, foot)
        return x_part, (-w * C * mu_i) * u, -level * w / m_i

    @summed(wall_force_back)
    def force_back(
        x_ij: vector,
        v_ij: vector,
        m_i: real,
        m_j: real,
        T_i: matrix,
        T_j: matrix,
        mu_i: real,
        mu_j: real,
        bar_i: vector,
        bar_j: vector,
        least: real,
        s: neighbourhood,
    ) -> tuple[vector, vector, real]:
        """What the pair gives to x, v and m of i, for an adjoint of the acceleration."""
        w, T, mu, own_u = weight(x_ij, s), T_i + T_j, C * (mu_i + mu_j), bar_i / m_i
        u, pull = own_u - bar_j / m_j, T * x_ij + mu * v_ij
        x_part = (s.volume * wp.dot(u, pull)) * slope_gradient(x_ij, s) - w * (wp.transpose(T) * u)
        return x_part, (-w * mu) * u, w * wp.dot(own_u, pull) / m_i

    # ---- kernels -------------------------------------------------------------------------------------------------

    @wp.kernel(module=discretisation.module(True, name))
    def stress(
        s: neighbourhood,
        least: real,
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
        eta_i = viscosity_of(M_i, thin, mu[i])
        M[i] = M_i
        A[i] = A_i
        R[i] = thin
        T[i] = traction_of(M_i, A_i, eta_i)
        eta[i] = eta_i

    @wp.kernel(module=discretisation.module(True, name))
    def acceleration_of(
        s: neighbourhood,
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
        total = force(i, x, v, m, T, eta, least, s)
        if lane() > 0:
            return
        acceleration[i] = acceleration_in[i] + total

    @wp.kernel(module=discretisation.tangent_module(name), enable_backward=False)
    def stress_tangent(
        s: neighbourhood,
        least: real,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        mu: wp.array(dtype=real),
        dot: changes,
        M: wp.array(dtype=matrix),
        A: wp.array(dtype=matrix),
        R: wp.array(dtype=real),
        # out
        T_dot: wp.array(dtype=matrix),
        eta_dot: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        diagonal, others, row_x, row_y, row_z, thin = moments_tangent(i, x, dot.x, v, dot.v, mu, dot.mu, least, s)
        if lane() > 0:
            return
        M_dot, A_dot = change_of_moment(diagonal, others), wp.matrix_from_rows(row_x, row_y, row_z)
        change = matrix()
        for k in range(10):  # of each entry of T and of mu
            T_bar, eta_bar = matrix(), real(0.0)
            if k < 9:
                T_bar[k // 3, k % 3] = real(1.0)
            else:
                eta_bar = real(1.0)
            by_M, by_A, by_R, by_mu, _by_T, _by_eta = wp.grad(work)(M[i], A[i], R[i], mu[i], T_bar, eta_bar)
            slope_k = wp.ddot(by_M, M_dot) + wp.ddot(by_A, A_dot) + by_R * thin + by_mu * dot.mu[i]
            if k < 9:
                change[k // 3, k % 3] = slope_k
            else:
                eta_dot[i] = slope_k
        T_dot[i] = change

    @wp.kernel(module=discretisation.tangent_module(name), enable_backward=False)
    def acceleration_tangent(
        s: neighbourhood,
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
            i, now.x, dot.x, now.v, dot.v, now.m, dot.m, of.T, T_dot, of.eta, eta_dot, least, s
        )
        if lane() > 0:
            return
        acceleration_dot[i] = acceleration_in_dot[i] + total

    @wp.kernel(module=discretisation.module(False, name), enable_backward=False)
    def stress_adjoint(
        s: neighbourhood,
        least: real,
        now: seen,
        mu: wp.array(dtype=real),
        of: sums,
        acceleration_bar: wp.array(dtype=vector),
        # in and out
        mu_bar: wp.array(dtype=real),
        # out
        M_bar: wp.array(dtype=matrix),
        A_bar: wp.array(dtype=matrix),
        R_bar: wp.array(dtype=real),
    ):
        """From the adjoint of the acceleration to those of the sums."""
        i = s.first + wp.tid() // LANES
        row_x, row_y, row_z, eta_bar = traction_back(i, now.x, now.v, now.m, acceleration_bar, least, s)
        if lane() > 0:
            return
        T_bar = wp.matrix_from_rows(row_x, row_y, row_z)
        by_M, by_A, by_R, by_mu, _by_T, _by_eta = wp.grad(work)(of.M[i], of.A[i], of.R[i], mu[i], T_bar, eta_bar)
        M_bar[i] = real(0.5) * (by_M + wp.transpose(by_M))
        A_bar[i] = by_A
        R_bar[i] = by_R
        mu_bar[i] = mu_bar[i] + by_mu

    @wp.kernel(module=discretisation.module(False, name), enable_backward=False)
    def acceleration_adjoint(
        s: neighbourhood,
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
        x_part, v_part, m_part = force_back(i, now.x, now.v, now.m, of.T, of.eta, acceleration_bar, least, s)
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
