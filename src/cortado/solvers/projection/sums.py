"""Sums over neighbours in the projection, and the velocities that pressures cause, with derivatives."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from cortado.device.modules import Kernels, by_name
from cortado.device.precision import arithmetic
from cortado.particles.neighbourhood import Discretisation, pair_functions
from cortado.particles.pair_sums import fluid_sum, tangent_of
from cortado.particles.particle_kernels import over, particle_kernel
from cortado.solvers.projection.effects import image_sums
from cortado.solvers.projection.wall_sums import types_by_name
from cortado.sph.moment_functions import cross_terms_function, moment_functions, symmetric

CROWDED = 0.25
"""Greatest additional weight of close pairs in the shift (Monaghan 2000)."""
APART = 0.65
"""Distance below which the shift moves pairs apart [spacings]."""
UNEQUAL = 2.0
"""Additional weight of neighbours with a different mass in the diagonal of the pressure iteration."""


@cache
def projection_sums(discretisation: Discretisation) -> SimpleNamespace:
    """Make the sums over neighbours. A symmetric matrix is stored as its diagonal and its components yz, xz and xy.

    - ``moments``: six sums, with the spacing l and R = `CROWDED`. The kernel gradient is g_ij. The argument
      ``per_nearest`` is 1 / (V W(l)), and ``per_apart`` is 1 / (0.65 l)^2.

          M = -sum g_ij x_ij^T
          Q = sum h_ij g_ij g_ij^T / m_j,  h_ij = 1 + 2 ((m_i - m_j) / (m_i + m_j))^2
          g = sum g_ij
          sum (1 + R q / (1 + q / 4)) g_ij,  q = (W_ij / W(l))^4
          sum p_ij,  p_ij = max(1 - |x_ij|^2 / (0.65 l)^2, 0)^2 x_ij
          sum V W_ij

    - ``force``: sum_j T_j g_ij with T = k L. The adjoint returns the symmetric part of sum f_ij g_ij^T for adjoints f.
    - ``velocity_gradient``: the rows of A = sum v_ij g_ij^T; the velocity gradient is A M^-1. The adjoint of v
      lacks the term A_bar_i g_i.
    - ``divergence_back``: the adjoints of v and x for a symmetric adjoint S = d L of A, with the adjoint d of L : A.
    - ``push``: sum (c_i + c_j) g_ij. The adjoint returns sum g_ij . f_ij for adjoints f.
    """
    real, vector, neighbourhood = discretisation.types
    pair = pair_functions(discretisation)
    packed, cross_terms = symmetric(discretisation.precision), cross_terms_function(discretisation.precision)
    six, times = packed.kind, packed.times
    crowded, unequal = wp.constant(real(CROWDED)), wp.constant(real(UNEQUAL))
    reciprocal = arithmetic(discretisation.precision, discretisation.taped).reciprocal
    weight, slope, gradient, hessian_product = pair.weight, pair.slope, pair.gradient, pair.hessian_product
    typed = types_by_name(discretisation.precision)

    @wp.func
    def even_terms(a: vector, b: vector) -> vector:
        return real(0.5) * (cross_terms(a, b) + cross_terms(b, a))

    @wp.func
    def mobility(m_i: real, m_j: real) -> real:
        r = (m_i - m_j) * reciprocal(m_i + m_j)
        return (real(1.0) + unequal * r * r) * reciprocal(m_j)

    @wp.func
    def slope_of_h(m_i: real, m_j: real) -> real:
        per_both = reciprocal(m_i + m_j)
        return real(4.0) * unequal * (m_i - m_j) * m_j * per_both * per_both * per_both

    @wp.func
    def closeness(near: real) -> real:
        """Return the weight of a pair in the shift, which grows as the pair gets closer."""
        q = near * near * near * near
        return real(1.0) + crowded * q * reciprocal(real(1.0) + real(0.25) * q)

    @wp.func
    def closeness_derivative(near: real) -> real:
        q = near * near * near * near
        part = real(1.0) + real(0.25) * q
        return real(4.0) * crowded * near * near * near * reciprocal(part * part)

    @wp.func
    def nearness(x_ij: vector, per_apart: real) -> real:
        return wp.max(real(1.0) - per_apart * wp.dot(x_ij, x_ij), real(0.0))

    @wp.func
    def parted(x_ij: vector, change: vector, per_apart: real) -> vector:
        w = nearness(x_ij, per_apart)
        return w * (w * change - (real(4.0) * per_apart * wp.dot(x_ij, change)) * x_ij)

    @fluid_sum(discretisation)
    def moments(
        x_ij: vector, m_i: real, m_j: real, per_nearest: real, per_apart: real, s: neighbourhood
    ) -> tuple[vector, vector, vector, vector, vector, vector, vector, real]:
        g = s.volume * gradient(x_ij, s)
        q = mobility(m_i, m_j) * g
        near = s.volume * weight(x_ij, s)
        crowd, w = closeness(near * per_nearest) * g, nearness(x_ij, per_apart)
        push = (w * w) * x_ij
        return -wp.cw_mul(g, x_ij), -cross_terms(g, x_ij), wp.cw_mul(q, g), cross_terms(q, g), g, crowd, push, near

    @tangent_of(moments)
    @fluid_sum(discretisation, typed, ahead=False)
    def moments_tangent(
        x_ij, x_dot_ij, m_i, m_j, m_dot_i, m_dot_j, per_nearest, per_apart, s
    ) -> tuple[vector, vector, vector, vector, vector, vector, vector, real]:
        g = s.volume * gradient(x_ij, s)
        g_dot = s.volume * hessian_product(x_ij, x_dot_ij, s)
        per = mobility(m_i, m_j)
        h_dot = slope_of_h(m_i, m_j) * m_dot_i + slope_of_h(m_j, m_i) * m_dot_j
        q, q_dot = per * g, per * g_dot + ((h_dot - per * m_dot_j) / m_j) * g
        near = s.volume * weight(x_ij, s) * per_nearest
        near_dot = wp.dot(g, x_dot_ij)
        more = closeness_derivative(near) * near_dot * per_nearest
        return (
            -wp.cw_mul(g_dot, x_ij) - wp.cw_mul(g, x_dot_ij),
            -cross_terms(g_dot, x_ij) - cross_terms(g, x_dot_ij),
            wp.cw_mul(q_dot, g) + wp.cw_mul(q, g_dot),
            cross_terms(q_dot, g) + cross_terms(q, g_dot),
            g_dot,
            closeness(near) * g_dot + more * g,
            parted(x_ij, x_dot_ij, per_apart),
            near_dot,
        )

    @fluid_sum(discretisation, typed)
    def moments_back(
        x_ij, m_i, m_j, M_bar_i: six, M_bar_j: six, Q_bar_i: six, Q_bar_j: six, g_bar_ij, crowd_bar_ij, apart_bar_ij,
        n_bar_i, n_bar_j, per_nearest, per_apart, s,
    ) -> tuple[vector, real]:  # fmt: skip
        g = s.volume * gradient(x_ij, s)
        stretch = times(M_bar_i + M_bar_j, x_ij)
        from_i, from_j, per = times(Q_bar_i, g), times(Q_bar_j, g), mobility(m_j, m_i)
        both = mobility(m_i, m_j) * from_i + per * from_j
        near = s.volume * weight(x_ij, s) * per_nearest
        more = closeness_derivative(near) * wp.dot(g, crowd_bar_ij) * per_nearest + n_bar_i + n_bar_j
        bent = real(2.0) * both + g_bar_ij + closeness(near) * crowd_bar_ij - stretch
        x_part = s.volume * (hessian_product(x_ij, bent, s) - slope(x_ij, s) * stretch) + more * g
        x_part += parted(x_ij, apart_bar_ij, per_apart)
        h = slope_of_h(m_i, m_j)
        return x_part, wp.dot(g, from_i) * h * reciprocal(m_j) + wp.dot(g, from_j) * (h - per) * reciprocal(m_i)

    @fluid_sum(discretisation)
    def force(x_ij: vector, T_j: six, s: neighbourhood) -> vector:
        return times(T_j, s.volume * gradient(x_ij, s))

    @tangent_of(force)
    @fluid_sum(discretisation, ahead=False)
    def force_tangent(x_ij: vector, x_dot_ij: vector, T_j: six, T_dot_j: six, s: neighbourhood) -> vector:
        return s.volume * (times(T_dot_j, gradient(x_ij, s)) + times(T_j, hessian_product(x_ij, x_dot_ij, s)))

    @fluid_sum(discretisation)
    def force_back(x_ij: vector, T_i: six, T_j: six, f_ij: vector, s: neighbourhood) -> tuple[vector, vector, vector]:
        g = s.volume * gradient(x_ij, s)
        pulled = times(T_i + T_j, f_ij)
        return wp.cw_mul(f_ij, g), even_terms(f_ij, g), s.volume * hessian_product(x_ij, pulled, s)

    @fluid_sum(discretisation)
    def velocity_gradient(x_ij: vector, v_ij: vector, s: neighbourhood) -> tuple[vector, vector, vector]:
        g = s.volume * gradient(x_ij, s)
        return v_ij[0] * g, v_ij[1] * g, v_ij[2] * g

    @tangent_of(velocity_gradient)
    @fluid_sum(discretisation, typed, ahead=False)
    def velocity_gradient_tangent(x_ij, x_dot_ij, v_ij, v_dot_ij, s) -> tuple[vector, vector, vector]:
        g, g_dot = s.volume * gradient(x_ij, s), s.volume * hessian_product(x_ij, x_dot_ij, s)
        return (v_dot_ij[0] * g + v_ij[0] * g_dot, v_dot_ij[1] * g + v_ij[1] * g_dot, v_dot_ij[2] * g + v_ij[2] * g_dot)

    @fluid_sum(discretisation, typed)
    def velocity_gradient_back(x_ij, v_ij, A_bar_i, A_bar_j, s) -> tuple[vector, vector]:
        pulled = wp.transpose(A_bar_i + A_bar_j) * v_ij
        return A_bar_j * (s.volume * gradient(x_ij, s)), s.volume * hessian_product(x_ij, pulled, s)

    @fluid_sum(discretisation)
    def divergence_back(x_ij: vector, v_ij: vector, S_i: six, S_j: six, s: neighbourhood) -> tuple[vector, vector]:
        pulled = times(S_i + S_j, v_ij)
        return times(S_j, s.volume * gradient(x_ij, s)), s.volume * hessian_product(x_ij, pulled, s)

    @fluid_sum(discretisation)
    def push(x_ij: vector, c_i: real, c_j: real, s: neighbourhood) -> vector:
        return ((c_i + c_j) * s.volume) * gradient(x_ij, s)

    @tangent_of(push)
    @fluid_sum(discretisation, typed, ahead=False)
    def push_tangent(x_ij, x_dot_ij, c_i, c_j, c_dot_i, c_dot_j, s) -> vector:
        change = (c_dot_i + c_dot_j) * gradient(x_ij, s) + (c_i + c_j) * hessian_product(x_ij, x_dot_ij, s)
        return s.volume * change

    @fluid_sum(discretisation)
    def push_back(x_ij: vector, c_i: real, c_j: real, f_ij: vector, s: neighbourhood) -> tuple[real, vector]:
        return (s.volume * wp.dot(gradient(x_ij, s), f_ij), ((c_i + c_j) * s.volume) * hessian_product(x_ij, f_ij, s))

    return SimpleNamespace(
        moments=Kernels(moments, moments_tangent, moments_back),
        force=Kernels(force, force_tangent, force_back),
        velocity_gradient=Kernels(velocity_gradient, velocity_gradient_tangent, velocity_gradient_back),
        divergence_back=divergence_back,
        push=Kernels(push, push_tangent, push_back),
    )


@cache
def velocity_kernels(discretisation: Discretisation, dimension: int) -> SimpleNamespace:
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    sums, mirrors, packed = projection_sums(discretisation), image_sums(discretisation), symmetric(precision)
    six, pack, times = packed.kind, packed.pack, packed.times
    whole = moment_functions(precision, dimension).change
    module, tangent_module, adjoint_module = discretisation.modules(f"projection_{dimension}d")

    typed = types_by_name(precision)
    both = [over(sums.force.forward, "total"), over(mirrors.lift.forward, "lifted")]

    @particle_kernel(module, "kick u", both, typed=typed)
    def velocity(total, lifted, m_i, y_i, T_i, g_i, gamma_i, v_star_i) -> tuple[vector, vector]:
        change = -(total + lifted + times(T_i, g_i) + y_i * gamma_i) / m_i
        return change, v_star_i + change

    @particle_kernel(tangent_module, "T T_dot")
    def pull_tangent(y_i: real, y_dot_i: real, L_i: matrix, L_dot_i: matrix) -> tuple[six, six]:
        return y_i * pack(L_i), y_dot_i * pack(L_i) + y_i * pack(L_dot_i)

    both = [over(sums.force.tangent, "total"), over(mirrors.lift.tangent, "lifted")]

    @particle_kernel(tangent_module, "kick_dot u_dot", both, typed=typed)
    def velocity_tangent(
        total, lifted, m_i, m_dot_i, y_i, y_dot_i, T_i, T_dot_i, g_i, g_dot_i, gamma_i, gamma_dot_i, v_star_i,
        v_star_dot_i, u_i,
    ) -> tuple[vector, vector]:  # fmt: skip
        change = total + lifted + times(T_dot_i, g_i) + times(T_i, g_dot_i)
        change += y_dot_i * gamma_i + y_i * gamma_dot_i
        kick_dot = -(change + m_dot_i * (u_i - v_star_i)) / m_i
        return kick_dot, v_star_dot_i + kick_dot

    both = [over(sums.force.adjoint, "diagonal others x_part"), over(mirrors.lift.adjoint, "widened x_lift")]

    @particle_kernel(adjoint_module, "+y_bar +image_bar +L_bar +gamma_bar +x_bar", both, typed=typed)
    def velocity_adjoint(
        diagonal, others, x_part, widened, x_lift, y_i, L_i, gamma_i, image_i, f_i
    ) -> tuple[real, real, matrix, vector, vector]:
        A = whole(diagonal, others)
        y_part = wp.ddot(L_i, A) + wp.dot(gamma_i, f_i) + image_i * widened
        return y_part, y_i * widened, y_i * A, y_i * f_i, x_part + x_lift

    @particle_kernel(adjoint_module, "+v_bar +m_bar T f kick_bar", typed=typed)
    def own_adjoint(m_i, v_star_i, y_i, L_i, u_i, u_bar_i, kick_bar_i) -> tuple[vector, real, six, vector, vector]:
        bar = u_bar_i + kick_bar_i
        return u_bar_i, wp.dot(bar, v_star_i - u_i) / m_i, y_i * pack(L_i), -bar / m_i, vector()

    @particle_kernel(adjoint_module, "+time_step_bar")
    def time_adjoint(acceleration_i: vector, v_bar_i: vector) -> real:
        return wp.dot(v_bar_i, acceleration_i)

    velocities = Kernels(velocity, velocity_tangent, velocity_adjoint)
    return SimpleNamespace(velocity=velocities, **vars(by_name(pull_tangent, own_adjoint, time_adjoint)))
