"""The force of a smooth coarse pressure on a particle, and the divergence that the coarse pressure has to remove.

Let each particle j have the pressure c_j phi(x_j), with a linear function phi. The pressure force on particle i is then

    N_i grad phi + phi(x_i) h_i,   h = D^T c,

with the moment N and the operator D of `docs/projection_step.md`. The push h is the pressure force for phi = 1. The
code also names T = c L, with the gradient correction L. Inside the fluid and beside mirroring walls, N is the unit
matrix and h is 0, but N and h have other values beside wall particles.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, pair_functions
from cortado.particles.pair_sums import fluid_sum, image_sum, tangent_of
from cortado.particles.particle_kernels import over, particle_kernel
from cortado.solvers.projection.effects import image_sums
from cortado.solvers.projection.pressure import clamp_functions
from cortado.solvers.projection.sums import projection_sums
from cortado.solvers.projection.wall_sums import types_by_name, weights_type
from cortado.sph.moment_functions import cross_terms_function, moment_functions, symmetric


@cache
def coarse_sums(discretisation: Discretisation) -> Kernels:
    precision, (real, vector, neighbourhood) = discretisation.precision, discretisation.types
    pair = pair_functions(discretisation)
    packed, cross_terms = symmetric(precision), cross_terms_function(precision)
    six, times = packed.kind, packed.times
    gradient, hessian_product, typed = pair.gradient, pair.hessian_product, types_by_name(precision)

    @fluid_sum(discretisation)
    def push(x_ij: vector, T_j: six, s: neighbourhood) -> tuple[vector, vector, vector, vector]:
        f = times(T_j, s.volume * gradient(x_ij, s))
        return f, -f[0] * x_ij, -f[1] * x_ij, -f[2] * x_ij

    @tangent_of(push)
    @fluid_sum(discretisation, typed, ahead=False)
    def push_tangent(x_ij, x_dot_ij, T_j, T_dot_j, s) -> tuple[vector, vector, vector, vector]:
        g, g_dot = s.volume * gradient(x_ij, s), s.volume * hessian_product(x_ij, x_dot_ij, s)
        f, c = times(T_j, g), times(T_dot_j, g) + times(T_j, g_dot)
        return c, -c[0] * x_ij - f[0] * x_dot_ij, -c[1] * x_ij - f[1] * x_dot_ij, -c[2] * x_ij - f[2] * x_dot_ij

    @fluid_sum(discretisation, typed)
    def push_back(x_ij, T_i, T_j, h_bar_i, h_bar_j, N_bar_i, N_bar_j, s) -> tuple[vector, vector, vector]:
        g = s.volume * gradient(x_ij, s)
        from_i, from_j = h_bar_i - N_bar_i * x_ij, h_bar_j + N_bar_j * x_ij
        pulled = s.volume * hessian_product(x_ij, times(T_j, from_i) - times(T_i, from_j), s)
        x_part = pulled - wp.transpose(N_bar_i) * times(T_j, g) - wp.transpose(N_bar_j) * times(T_i, g)
        others = real(-0.5) * (cross_terms(from_j, g) + cross_terms(g, from_j))
        return -wp.cw_mul(from_j, g), others, x_part

    return Kernels(push, push_tangent, push_back)


@cache
def coarse_image_sums(discretisation: Discretisation) -> Kernels:
    (real, vector, _), pair = discretisation.types, pair_functions(discretisation)
    gradient, hessian_product, typed = pair.gradient, pair.hessian_product, types_by_name(discretisation.precision)

    @image_sum(discretisation, typed)
    def push(x_ij, direct, coarse_i, coarse_j, image_i, image_j, s) -> tuple[vector, vector, vector, vector]:
        g = s.volume * gradient(x_ij, s)
        f = (image_j * coarse_j) * g
        return f + (image_i * coarse_i) * g, -f[0] * direct, -f[1] * direct, -f[2] * direct

    @image_sum(discretisation, typed)
    def push_tangent(
        x_ij, x_dot_ij, direct, direct_dot, coarse_i, coarse_j, coarse_dot_i, coarse_dot_j, image_i, image_j,
        image_dot_i, image_dot_j, s,
    ) -> tuple[vector, vector, vector, vector]:  # fmt: skip
        g, g_dot = s.volume * gradient(x_ij, s), s.volume * hessian_product(x_ij, x_dot_ij, s)
        q, p, p_dot = image_i * coarse_i, image_j * coarse_j, image_dot_j * coarse_j + image_j * coarse_dot_j
        f, c = p * g, p_dot * g + p * g_dot
        total = c + (image_dot_i * coarse_i + image_i * coarse_dot_i) * g + q * g_dot
        row_x, row_y = -c[0] * direct - f[0] * direct_dot, -c[1] * direct - f[1] * direct_dot
        return total, row_x, row_y, -c[2] * direct - f[2] * direct_dot

    @image_sum(discretisation, typed)
    def push_back(
        x_ij, direct, coarse_i, coarse_j, image_i, image_j, h_bar_i, h_bar_j, N_bar_i, N_bar_j, s
    ) -> tuple[real, vector]:
        g, q, p = s.volume * gradient(x_ij, s), image_i * coarse_i, image_j * coarse_j
        from_i, from_j = h_bar_i - N_bar_i * direct, h_bar_j + N_bar_j * direct
        pulled = q * (h_bar_i - from_j) + p * (from_i - h_bar_j)
        x_part = s.volume * hessian_product(x_ij, pulled, s)
        x_part -= p * (wp.transpose(N_bar_i) * g) + q * (wp.transpose(N_bar_j) * g)
        return wp.dot(g, h_bar_i - from_j), x_part

    return Kernels(push, push_tangent, push_back)


@cache
def coarse_push_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    precision = discretisation.precision
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    sums, mirrors, packed = coarse_sums(discretisation), coarse_image_sums(discretisation), symmetric(precision)
    six, pack, times = packed.kind, packed.pack, packed.times
    whole = moment_functions(precision, dimension).change
    module, tangent_module, adjoint_module = discretisation.modules(f"projection_{dimension}d")

    @particle_kernel(module, "T")
    def pull(coarse_i: real, L_i: matrix) -> six:
        return coarse_i * pack(L_i)

    typed = types_by_name(precision)

    names = "total row_x row_y row_z", "lifted lift_x lift_y lift_z"

    def both(sums_of: Any, images_of: Any) -> list[Any]:
        return [over(sums_of, names[0]), over(images_of, names[1])]

    @particle_kernel(module, "h N", both(sums.forward, mirrors.forward), typed=typed)
    def coarse_push(
        total, row_x, row_y, row_z, lifted, lift_x, lift_y, lift_z, T_i, g_i, coarse_i, gamma_i
    ) -> tuple[vector, matrix]:
        N = wp.matrix_from_rows(row_x + lift_x, row_y + lift_y, row_z + lift_z)
        return total + lifted + times(T_i, g_i) + coarse_i * gamma_i, N

    @particle_kernel(tangent_module, "T T_dot")
    def pull_tangent(coarse_i: real, coarse_dot_i: real, L_i: matrix, L_dot_i: matrix) -> tuple[six, six]:
        return coarse_i * pack(L_i), coarse_dot_i * pack(L_i) + coarse_i * pack(L_dot_i)

    @particle_kernel(tangent_module, "h_dot N_dot", both(sums.tangent, mirrors.tangent), typed=typed)
    def coarse_push_tangent(
        total, row_x, row_y, row_z, lifted, lift_x, lift_y, lift_z, T_i, T_dot_i, g_i, g_dot_i, coarse_i, coarse_dot_i,
        gamma_i, gamma_dot_i,
    ) -> tuple[vector, matrix]:  # fmt: skip
        own_part = times(T_dot_i, g_i) + times(T_i, g_dot_i)
        own_part += coarse_dot_i * gamma_i + coarse_i * gamma_dot_i
        return total + lifted + own_part, wp.matrix_from_rows(row_x + lift_x, row_y + lift_y, row_z + lift_z)

    back = [over(sums.adjoint, "diagonal others x_part"), over(mirrors.adjoint, "widened x_lift")]

    @particle_kernel(adjoint_module, "+x_bar +L_bar +coarse_bar +image_bar +g_bar +gamma_bar", back, typed=typed)
    def coarse_push_adjoint(
        diagonal, others, x_part, widened, x_lift, L_i, T_i, g_i, coarse_i, image_i, gamma_i, h_bar_i
    ) -> tuple[vector, matrix, real, real, vector, vector]:
        T_bar = whole(diagonal, others) + real(0.5) * (wp.outer(h_bar_i, g_i) + wp.outer(g_i, h_bar_i))
        coarse_part = wp.ddot(L_i, T_bar) + wp.dot(gamma_i, h_bar_i) + image_i * widened
        g_part, gamma_part = times(T_i, h_bar_i), coarse_i * h_bar_i
        return x_part + x_lift, coarse_i * T_bar, coarse_part, coarse_i * widened, g_part, gamma_part

    return Kernels((pull, coarse_push), (pull_tangent, coarse_push_tangent), (pull, coarse_push_adjoint))


CALM = 1e-6
"""Width of the smooth transition between tension and compression [-]."""


@cache
def residual_kernels(discretisation: Discretisation, dimension: int) -> Kernels:
    precision = discretisation.precision
    real, vector, matrix, weights4 = precision.real, precision.vector, precision.matrix, weights_type(precision)
    sums = projection_sums(discretisation).velocity_gradient
    (spread, spread_tangent, _), (gradient, gradient_tangent, _) = image_sums(discretisation).spread, sums
    packed, clamp = symmetric(precision), clamp_functions(precision)
    wanted, wanted_tangent, typed = clamp.wanted, clamp.wanted_tangent, types_by_name(precision)
    six, pack, (one, width) = packed.kind, packed.pack, (wp.constant(real(value)) for value in (1.0, 2.0 * CALM))
    module, tangent_module, adjoint_module = discretisation.modules(f"projection_{dimension}d")

    @wp.func
    def counts(y: real, tension: real, q: real):
        if y > real(0.0) or tension >= one:
            return one, real(0.0)
        t = wp.clamp(real(0.5) + q / width, real(0.0), one)
        return t * t * (real(3.0) - real(2.0) * t), real(6.0) * t * (one - t) * q / width

    both = [over(gradient, "row_x row_y row_z", v="u"), over(spread, "widened")]

    @particle_kernel(module, "A d r s_value s_slope s_bent s_own", both, typed=typed)
    def residual(
        row_x, row_y, row_z, widened, time_step, n_i, L_i, gamma_i, drift_i, weights_i, image_i, coarse_i, u_i, y_i
    ) -> tuple[matrix, real, real, real, vector, vector, real]:
        A = wp.matrix_from_rows(row_x, row_y, row_z)
        D = wp.ddot(L_i, A) + wp.dot(gamma_i, u_i) - drift_i + image_i * widened
        left = D - wanted(n_i, weights_i[1], time_step)
        part, _bend = counts(y_i, weights_i[0], time_step * left)
        left *= part
        return A, D, left, coarse_i * left, vector(), vector(), real(0.0)

    both = [
        over(gradient_tangent, "row_x row_y row_z", v="u", v_dot="u_dot"),
        over(spread, "widened"),
        over(spread_tangent, "widened_dot"),
    ]

    @particle_kernel(tangent_module, "r_dot", both, typed=typed)
    def residual_tangent(
        row_x, row_y, row_z, widened, widened_dot, time_step, time_step_dot, n_i, n_dot_i, L_i, L_dot_i, gamma_i,
        gamma_dot_i, drift_dot_i, weights_i, weights_dot_i, image_i, image_dot_i, u_i, u_dot_i, A_i, d_i, y_i,
    ) -> real:  # fmt: skip
        D_dot = wp.ddot(L_i, wp.matrix_from_rows(row_x, row_y, row_z)) + wp.ddot(L_dot_i, A_i) - drift_dot_i
        D_dot += wp.dot(gamma_i, u_dot_i) + wp.dot(gamma_dot_i, u_i)
        D_dot += image_i * widened_dot + image_dot_i * widened
        full = weights_i[1]
        b = wanted(n_i, full, time_step)
        b_dot = wanted_tangent(n_i, n_dot_i, full, weights_dot_i[1], time_step, time_step_dot)
        part, bend = counts(y_i, weights_i[0], time_step * (d_i - b))
        return (part + bend) * (D_dot - b_dot) + bend * (d_i - b) * time_step_dot / time_step

    @particle_kernel(adjoint_module, "+n_bar +weights_bar +time_step_bar +drift_bar d_bar S")
    def residual_adjoint(
        time_step: real, n_i: real, L_i: matrix, weights_i: weights4, d_i: real, y_i: real, r_bar_i: real
    ) -> tuple[real, weights4, real, real, real, six]:
        no, full = real(0.0), weights_i[1]
        b = wanted(n_i, full, time_step)
        part, bend = counts(y_i, weights_i[0], time_step * (d_i - b))
        found = (part + bend) * r_bar_i
        n_part, full_part = real(0.0), real(0.0)
        if n_i < real(1.0):
            n_part = (real(1.0) - full) / time_step * found
            full_part = (real(1.0) - n_i) / time_step * found
        time_part = (b * found + bend * (d_i - b) * r_bar_i) / time_step
        return n_part, weights4(no, full_part, no, no), time_part, -found, found, found * pack(L_i)

    return Kernels(residual, residual_tangent, residual_adjoint)
