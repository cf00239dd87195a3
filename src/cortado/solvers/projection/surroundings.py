"""What a particle's neighbourhood lets the projection do, from the moments of its neighbours.

With the moments M, Q and g of `cortado.solvers.projection.sums`, gamma and nu of `cortado.solvers.projection.beside`,
the fullness H of `cortado.sph.moment_functions`, S(a, b) a smoothstep of H from a to b, and B = 1 / (1 +
(nu / 0.05)^4), which is 0 beside walls:

    sigma = S(0.1, 0.5) B    how much tension is let through,
    f = S(0.1, 0.5) of H + nu   how full it is: how much of the last step's pressure is taken on,
    u = S(0.5, 0.8)          how much it is shifted,
    r = S(0.8, 0.95) B       how much of a low density is repaired,
    L = I + c (B (K - I) + (1 - B) (t P - (1 + t) C)), c = S(0.2, 0.5),   which corrects gradients,
    K = J + 0.033 S(0.8, 0.95) J (J - I), J = 1.05 (M + 0.05 I)^-1,
    C = 1.05 (P M N + N M P) / (M : N + 0.05), N = gamma gamma^T / (gamma^2 + 0.01 a_0 / 20), P = I - N,
    t = 0.2 (1.05 / (M : P / (d - 1) + 0.05) - 1), in d dimensions,
    a = |L g + gamma|^2 / m + tr(L Q L) + 0.05 a_0 / m         the diagonal of the projection's matrix.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.bundles import bundle
from cortado.device.kernels import Kernels
from cortado.device.lanes import lane_functions
from cortado.device.precision import Precision
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.solvers.projection.beside import DIRECTION, beside_sums, edge_functions
from cortado.solvers.projection.sums import projection_sums
from cortado.sph.moment_functions import matrix_type, moment_functions

TENSION, CORRECTED, SHIFTED, REPAIRED = (0.1, 0.5), (0.2, 0.5), (0.5, 0.8), (0.8, 0.95)
"""The fullness below which nothing, and above which all is done."""
WALLED = 0.05
"""nu at which a wall halves tension, correction and the repair of low densities."""
REGULAR = 0.05
"""What is added to the diagonal of M before it is inverted."""
NEWTON = 0.033
"""Two thirds of a step of Newton's method towards the inverse of M, J + J (I - M J) = J + 0.05 J (J - I). Inside of the
fluid, where M is nearly I, J follows its changes for 95 % only: rows that pass one another seem to be squeezed, which
holds back films on a gentle slope. With a whole step they flow 1 to 2 % too fast, and water at rest moves faster. At
surfaces, where M is far from I, it would widen jets."""
ALONG = 0.2
"""How much of what gradients along a wall lack beside it is made up. On the lattice, with Wendland C2, the first row
lacks 25 % of a pressure's gradient along the wall. With 0 water at rest sinks along upright walls, in a lasting
vortex, and with 1, where divergences are right, the second row has 6 % too much and rises."""


@cache
def weights_type(precision: Precision) -> Any:
    """The Warp type of (sigma, f, u, r)."""
    return wp.types.vector(length=4, dtype=precision.real)


def entries(precision: Precision) -> dict[str, Any]:
    """Names and types of what is kept of a particle's surroundings."""
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    own = {"M": matrix, "Q": matrix, "g": vector, "gamma": vector, "nu": real, "drift": real}
    own |= {"normal": vector, "whole": vector, "normal_drift": real, "whole_drift": real, "edge": real}
    return {**own, "L": matrix, "a": real, "weights": weights_type(precision)}


@dataclass(frozen=True)
class SurroundingFunctions:
    """Warp functions of one particle."""

    weights: Any
    """(sigma, f, u, r) of M and nu."""
    correction: Any
    """L of M, gamma, nu and 0.05 a_0."""
    inverse: Any
    """1.05 (M + 0.05 I)^-1"""
    diagonal: Any
    """a of L, Q, g, gamma, m and 0.05 a_0."""
    back: Any
    """The adjoints of M, Q, g, gamma, nu and m for those of L, a and the weights."""


@cache
def surrounding_functions(precision: Precision, dimension: int, module: Any) -> SurroundingFunctions:
    """In 2 or 3 dimensions, in a Warp module."""
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
    own = moment_functions(precision, dimension)
    fullness, invert, smoothstep = own.fullness, own.inverse, own.smoothstep
    weights4 = weights_type(precision)
    regular, newton, walled = (wp.constant(real(value)) for value in (REGULAR, NEWTON, WALLED))
    along, direction = (wp.constant(real(value)) for value in (ALONG, DIRECTION))
    besides, axes = (wp.constant(real(value)) for value in (3 - dimension, dimension - 1))
    (t_0, t_1), (c_0, c_1) = (tuple(wp.constant(real(value)) for value in ends) for ends in (TENSION, CORRECTED))
    (u_0, u_1), (r_0, r_1) = (tuple(wp.constant(real(value)) for value in ends) for ends in (SHIFTED, REPAIRED))

    @wp.func
    def unit() -> matrix:
        one, no = real(1.0), real(0.0)
        return matrix(one, no, no, no, one, no, no, no, one)

    @wp.func
    def away(nu: real) -> real:
        """B"""
        ratio = nu / walled
        return real(1.0) / (real(1.0) + ratio * ratio * ratio * ratio)

    @wp.func
    def inverse(M: matrix) -> matrix:
        return (real(1.0) + regular) * invert(M + regular * unit())

    @wp.func
    def weights(M: matrix, nu: real) -> weights4:
        H, B = fullness(M), away(nu)
        full, walled_in = smoothstep(H, t_0, t_1), smoothstep(H + nu, t_0, t_1)
        return weights4(full * B, walled_in, smoothstep(H, u_0, u_1), smoothstep(H, r_0, r_1) * B)

    @wp.func
    def walled_correction(M: matrix, gamma: vector, least: real) -> matrix:
        """t P - (1 + t) C; M_zz = 1 of the plane does not count."""
        N = wp.outer(gamma, gamma) / (wp.dot(gamma, gamma) + direction * least)
        across = M * N - N * M * N
        P, whole = unit() - N, real(1.0) + regular
        t = along * (whole / ((wp.ddot(M, P) - besides) / axes + regular) - real(1.0))
        C = whole / (wp.ddot(M, N) + regular) * (across + wp.transpose(across))
        return t * P - (real(1.0) + t) * C

    @wp.func
    def correction(M: matrix, gamma: vector, nu: real, least: real) -> matrix:
        H, B, J = fullness(M), away(nu), inverse(M)
        K = J + (newton * smoothstep(H, r_0, r_1)) * (J * (J - unit()))
        beside = (real(1.0) - B) * walled_correction(M, gamma, least)
        return unit() + smoothstep(H, c_0, c_1) * (B * (K - unit()) + beside)

    @wp.func
    def diagonal(L: matrix, Q: matrix, g: vector, gamma: vector, m: real, least: real) -> real:
        """L and Q are symmetric: tr(L Q L) = (L L) : Q."""
        own_part = L * g + gamma
        return (wp.dot(own_part, own_part) + least) / m + wp.ddot(L * L, Q)

    @wp.func(module=module)
    def work(
        M: matrix,
        Q: matrix,
        g: vector,
        gamma: vector,
        nu: real,
        m: real,
        least: real,
        L_bar: matrix,
        a_bar: real,
        weights_bar: weights4,
    ) -> real:
        L = correction(M, gamma, nu, least)
        total = wp.ddot(L, L_bar) + wp.dot(weights(M, nu), weights_bar)
        return total + a_bar * diagonal(L, Q, g, gamma, m, least)

    @wp.func(module=module)
    def back(
        M: matrix,
        Q: matrix,
        g: vector,
        gamma: vector,
        nu: real,
        m: real,
        least: real,
        L_bar: matrix,
        a_bar: real,
        weights_bar: weights4,
    ):
        by_M, by_Q, by_g, by_gamma, by_nu, by_m, _least, _L, _a, _w = wp.grad(work)(
            M, Q, g, gamma, nu, m, least, L_bar, a_bar, weights_bar
        )
        M_bar, Q_bar = real(0.5) * (by_M + wp.transpose(by_M)), real(0.5) * (by_Q + wp.transpose(by_Q))
        return M_bar, Q_bar, by_g, by_gamma, by_nu, by_m

    return SurroundingFunctions(weights, correction, inverse, diagonal, back)


@cache
def surrounding_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    """The kernels of the moments of neighbours, and of L, a and the weights that follow from them."""
    precision = discretisation.precision
    real, vector, matrix, weights4 = precision.real, precision.vector, matrix_type(precision), weights_type(precision)
    neighbourhood, sums = neighbourhood_type(precision), projection_sums(discretisation)
    moments, moments_tangent, moments_back = sums.moments, sums.moments_tangent, sums.moments_back
    walls = beside_sums(discretisation)
    beside, beside_tangent, beside_back = walls.sums, walls.tangent, walls.back
    topic = f"projection_{dimension}d"
    module, tangent_module = discretisation.module(True, topic), discretisation.tangent_module(topic)
    adjoint_module = discretisation.module(False, topic)
    own = moment_functions(precision, dimension)
    whole, change = own.whole, own.change
    here = surrounding_functions(precision, dimension, module)
    weights_of, correction_of, diagonal_of = here.weights, here.correction, here.diagonal
    along = surrounding_functions(precision, dimension, tangent_module).back
    back = surrounding_functions(precision, dimension, adjoint_module).back
    edge = edge_functions(precision, dimension, module).edge
    edge_along = edge_functions(precision, dimension, tangent_module).back
    edge_back = edge_functions(precision, dimension, adjoint_module).back
    around = bundle(**entries(precision))
    LANES = discretisation.lanes
    lane = lane_functions(precision, LANES).lane

    @wp.kernel(module=module)
    def surroundings(
        s: neighbourhood,
        least: real,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        # out
        of: around,
    ):
        i = s.first + wp.tid() // LANES
        diagonal, others, square, mixed, g = moments(i, x, m, s)
        normal, entire, nu, normal_drift, whole_drift = beside(i, x, v, s)
        if lane() > 0:
            return
        e = edge(normal, entire, least)
        gamma = normal + e * (entire - normal)
        M, Q = whole(diagonal, others), change(square, mixed)
        L = correction_of(M, gamma, nu, least)
        of.M[i] = M
        of.Q[i] = Q
        of.g[i] = g
        of.gamma[i] = gamma
        of.nu[i] = nu
        of.drift[i] = normal_drift + e * (whole_drift - normal_drift)
        of.normal[i] = normal
        of.whole[i] = entire
        of.normal_drift[i] = normal_drift
        of.whole_drift[i] = whole_drift
        of.edge[i] = e
        of.L[i] = L
        of.a[i] = diagonal_of(L, Q, g, gamma, m[i], least)
        of.weights[i] = weights_of(M, nu)

    @wp.kernel(module=tangent_module, enable_backward=False)
    def surroundings_tangent(
        s: neighbourhood,
        least: real,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        m_dot: wp.array(dtype=real),
        of: around,
        # out
        dot: around,
    ):
        """Put together of the gradients of each entry."""
        i = s.first + wp.tid() // LANES
        diagonal, others, square, mixed, g_i_dot = moments_tangent(i, x, x_dot, m, m_dot, s)
        normal_dot, whole_dot, nu_i_dot, normal_drift_dot, whole_drift_dot = beside_tangent(i, x, x_dot, v, v_dot, s)
        if lane() > 0:
            return
        e, off = of.edge[i], of.whole[i] - of.normal[i]
        by_normal, by_whole = edge_along(of.normal[i], of.whole[i], least, real(1.0))
        e_dot = wp.dot(by_normal, normal_dot) + wp.dot(by_whole, whole_dot)
        gamma_i_dot = normal_dot + e * (whole_dot - normal_dot) + e_dot * off
        drift_i_dot = normal_drift_dot + e * (whole_drift_dot - normal_drift_dot)
        drift_i_dot += e_dot * (of.whole_drift[i] - of.normal_drift[i])
        M_i_dot, Q_i_dot = change(diagonal, others), change(square, mixed)
        M, Q, g, gamma, nu, m_i = of.M[i], of.Q[i], of.g[i], of.gamma[i], of.nu[i], m[i]
        L_dot, weights_dot, a_dot = matrix(), weights4(), real(0.0)
        count = int(14)  # not a number: Warp would write the gradient out for each
        for k in range(count):
            L_unit, a_unit, weights_unit = matrix(), real(0.0), weights4()
            if k < 9:
                L_unit[k // 3, k % 3] = real(1.0)
            elif k < 13:
                weights_unit[k - 9] = real(1.0)
            else:
                a_unit = real(1.0)
            by_M, by_Q, by_g, by_gamma, by_nu, by_m = along(
                M, Q, g, gamma, nu, m_i, least, L_unit, a_unit, weights_unit
            )
            entry = wp.ddot(by_M, M_i_dot) + wp.ddot(by_Q, Q_i_dot) + wp.dot(by_g, g_i_dot)
            entry += wp.dot(by_gamma, gamma_i_dot) + by_nu * nu_i_dot + by_m * m_dot[i]
            if k < 9:
                L_dot[k // 3, k % 3] = entry
            elif k < 13:
                weights_dot[k - 9] = entry
            else:
                a_dot = entry
        dot.M[i] = M_i_dot
        dot.Q[i] = Q_i_dot
        dot.g[i] = g_i_dot
        dot.gamma[i] = gamma_i_dot
        dot.nu[i] = nu_i_dot
        dot.drift[i] = drift_i_dot
        dot.edge[i] = e_dot
        dot.L[i] = L_dot
        dot.a[i] = a_dot
        dot.weights[i] = weights_dot

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def own_adjoint(
        least: real,
        m: wp.array(dtype=real),
        of: around,
        # in and out
        m_bar: wp.array(dtype=real),
        bar: around,
    ):
        """Of what follows from the moments: adds to the adjoints of them."""
        i = wp.tid()
        M_bar, Q_bar, g_bar, gamma_bar, nu_bar, m_i_bar = back(
            of.M[i], of.Q[i], of.g[i], of.gamma[i], of.nu[i], m[i], least, bar.L[i], bar.a[i], bar.weights[i]
        )
        m_bar[i] = m_bar[i] + m_i_bar
        bar.M[i] = bar.M[i] + M_bar
        bar.Q[i] = bar.Q[i] + Q_bar
        bar.g[i] = bar.g[i] + g_bar
        bar.nu[i] = bar.nu[i] + nu_bar
        push_bar, drift_bar, e = bar.gamma[i] + gamma_bar, bar.drift[i], of.edge[i]
        e_bar = bar.edge[i] + wp.dot(push_bar, of.whole[i] - of.normal[i])
        e_bar += drift_bar * (of.whole_drift[i] - of.normal_drift[i])
        normal_bar, whole_bar = edge_back(of.normal[i], of.whole[i], least, e_bar)
        bar.normal[i] = (real(1.0) - e) * push_bar + normal_bar
        bar.whole[i] = e * push_bar + whole_bar
        bar.normal_drift[i] = (real(1.0) - e) * drift_bar
        bar.whole_drift[i] = e * drift_bar

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def sums_adjoint(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        m: wp.array(dtype=real),
        bar: around,
        # in and out
        x_bar: wp.array(dtype=vector),
        m_bar: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        x_part, m_part = moments_back(i, x, m, bar.M, bar.Q, bar.g, s)
        wall_part = beside_back(i, x, v, bar.normal, bar.whole, bar.nu, bar.normal_drift, bar.whole_drift, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + x_part + wall_part
        m_bar[i] = m_bar[i] + m_part

    return Kernels(surroundings, surroundings_tangent, (own_adjoint, sums_adjoint))
