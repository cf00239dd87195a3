"""Weights and gradient corrections of a particle in the projection, and images of the fluid in flat mirroring walls.

`docs/projection_step.md` has the equations. `cortado.solvers.projection.sums` computes the moments M, Q and g, and
`cortado.solvers.projection.wall_sums` computes the sums gamma and nu. `weights` uses a smoothstep S of the fullness H:

    sigma = S(0.1, 0.5) B          the part of tension that is admitted,
    f = S(0.1, 0.5) of H + nu      the part of the previous step's pressure with which a step begins,
    u = S(0.5, 0.8)                the part of the shift that is applied,
    r = S(0.8, 0.95) B             the part of a low density that is repaired.

The projection's matrix has the diagonal a = |L g + gamma|^2 / m + tr(L Q L) + 0.05 a_0 / m, where a_0 is the diagonal
on the lattice.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import Kernels, by_name
from cortado.device.precision import Precision
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import image_sum, mirror_sum
from cortado.solvers.projection.wall_sums import DIRECTION, normal_part, types_by_name, weights_type
from cortado.sph.moment_functions import moment_functions

TENSION, CORRECTED, SHIFTED, REPAIRED = (0.1, 0.5), (0.2, 0.5), (0.5, 0.8), (0.8, 0.95)
"""Fullness at which each weight begins to grow from 0, and fullness from which the weight is 1."""
SHARED = (0.7, 0.95)
"""Fullness at which the coarse pressure's weight begins to grow from 0, and fullness from which the weight is 1."""
WALLED = 0.05
"""Wall coverage that halves the weights of tension, gradient correction and repairs."""
APART = 0.005
"""Coverage by walls without mirror images that halves the weight of images."""
MIRRORED = 9.0
"""Additional weight of mirroring walls in the wall coverage."""
REGULAR = 0.05
"""Regularisation of the moment matrix before its inversion."""
NEWTON = 0.033
"""Factor of a Newton step to the inverse moment matrix. A full step would make water at rest move faster."""
ALONG = 0.2
"""Corrected fraction of the missing gradient along a wall. With the fraction 0, water at rest sinks along upright
walls. With the fraction 1, the second layer of particles rises."""


@cache
def away_function(precision: Precision) -> Any:
    """Make the Warp function 1 / (1 + (nu / half)^4), a weight that is near 0 beside walls."""
    real = precision.real

    @wp.func
    def away(nu: real, half: real) -> real:
        ratio = nu / half
        return real(1.0) / (real(1.0) + ratio * ratio * ratio * ratio)

    return away


@cache
def effect_functions(precision: Precision, dimension: int, module: Any) -> SimpleNamespace:
    real, vector, matrix = precision.real, precision.vector, precision.matrix
    own = moment_functions(precision, dimension)
    fullness, invert, smoothstep = own.fullness, own.inverse, own.smoothstep
    weights4 = weights_type(precision)
    away, typed = away_function(precision), types_by_name(precision)
    regular, newton, walled, apart = (wp.constant(real(value)) for value in (REGULAR, NEWTON, WALLED, APART))
    mirrored = wp.constant(real(MIRRORED))
    along, direction = (wp.constant(real(value)) for value in (ALONG, DIRECTION))
    besides, axes = (wp.constant(real(value)) for value in (3 - dimension, dimension - 1))
    (t_0, t_1), (c_0, c_1) = (tuple(wp.constant(real(value)) for value in ends) for ends in (TENSION, CORRECTED))
    (u_0, u_1), (r_0, r_1) = (tuple(wp.constant(real(value)) for value in ends) for ends in (SHIFTED, REPAIRED))
    s_0, s_1 = (wp.constant(real(value)) for value in SHARED)

    @wp.func
    def unit() -> matrix:
        one, no = real(1.0), real(0.0)
        return matrix(one, no, no, no, one, no, no, no, one)

    @wp.func
    def inverse(M: matrix) -> matrix:
        return (real(1.0) + regular) * invert(M + regular * unit())

    @wp.func
    def weights(M: matrix, nu: real, behind: real) -> weights4:
        H, B = fullness(M), away(nu + mirrored * away(nu - behind, apart) * behind, walled)
        full, walled_in = smoothstep(H, t_0, t_1), smoothstep(H + nu, t_0, t_1)
        return weights4(full * B, walled_in, smoothstep(H, u_0, u_1), smoothstep(H, r_0, r_1) * B)

    @wp.func
    def walled_correction(M: matrix, gamma: vector, least: real) -> matrix:
        N = wp.outer(gamma, gamma) / (wp.dot(gamma, gamma) + direction * least)
        across = M * N - N * M * N
        P, whole = unit() - N, real(1.0) + regular
        t = along * (whole / ((wp.ddot(M, P) - besides) / axes + regular) - real(1.0))
        C = whole / (wp.ddot(M, N) + regular) * (across + wp.transpose(across))
        return t * P - (real(1.0) + t) * C

    @wp.func
    def correction(M: matrix, gamma: vector, mirror: vector, nu: real, behind: real, least: real) -> matrix:
        H, J, alone = fullness(M), inverse(M), away(nu - behind, apart)
        B, B_o = away(nu + mirrored * alone * behind, walled), away(nu - alone * behind, walled)
        K = J + (newton * smoothstep(H, r_0, r_1)) * (J * (J - unit()))
        beside = (real(1.0) - B_o) * walled_correction(M, gamma - alone * mirror, least)
        return unit() + smoothstep(H, c_0, c_1) * (B * (K - unit()) + beside)

    @wp.func
    def diagonal(L: matrix, Q: matrix, g: vector, gamma: vector, m: real, least: real) -> real:
        own_part = L * g + gamma
        return (wp.dot(own_part, own_part) + least) / m + wp.ddot(L * L, Q)

    @wp.func
    def share(M: matrix, nu: real) -> real:
        return smoothstep(fullness(M) + real(2.0) * nu, s_0, s_1)

    @wp.func(module=module)
    @typed
    def work(M, Q, g, gamma, mirror, nu, behind, m, least, L_bar, a_bar, weights_bar, share_bar) -> real:
        L = correction(M, gamma, mirror, nu, behind, least)
        total = wp.ddot(L, L_bar) + wp.dot(weights(M, nu, behind), weights_bar) + share_bar * share(M, nu)
        return total + a_bar * diagonal(L, Q, g, gamma, m, least)

    @wp.func(module=module)
    @typed
    def back(M, Q, g, gamma, mirror, nu, behind, m, least, L_bar, a_bar, weights_bar, share_bar):
        by_M, by_Q, by_g, by_gamma, by_mirror, by_nu, by_behind, by_m, _least, _L, _a, _w, _c = wp.grad(work)(
            M, Q, g, gamma, mirror, nu, behind, m, least, L_bar, a_bar, weights_bar, share_bar
        )
        M_bar, Q_bar = real(0.5) * (by_M + wp.transpose(by_M)), real(0.5) * (by_Q + wp.transpose(by_Q))
        return M_bar, Q_bar, by_g, by_gamma, by_mirror, by_nu, by_behind, by_m

    return by_name(weights, correction, inverse, diagonal, share, back)


EVEN = (0.7, 0.9)
"""The weight of images grows from 0 to 1 between the two ratios of image density to wall density."""
LEAST = 1e-6
"""Smallest wall coverage that is not treated as 0."""


@cache
def image_sums(discretisation: Discretisation) -> SimpleNamespace:
    """``lift`` is the force of pressures, ``echo`` the adjoint of the density of images, ``spread`` the divergence of
    velocities, ``sweep`` the divergence by moving solids, and ``behind`` the coverage by mirroring walls."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood, pair = neighbourhood_type(discretisation.precision), pair_functions(discretisation)
    weight, gradient, hessian_product = pair.weight, pair.gradient, pair.hessian_product
    normal, mirror_of, typed = normal_part(discretisation), pair.mirror_of, types_by_name(discretisation.precision)

    @image_sum(discretisation)
    def image_weights(x_ij: vector, s: neighbourhood) -> real:
        return s.volume * weight(x_ij, s)

    @image_sum(discretisation)
    def image_weights_tangent(x_ij: vector, x_dot_ij: vector, s: neighbourhood) -> real:
        return s.volume * wp.dot(gradient(x_ij, s), x_dot_ij)

    @image_sum(discretisation)
    def lift(x_ij: vector, y_i: real, y_j: real, image_i: real, image_j: real, s: neighbourhood) -> vector:
        return ((image_i * y_i + image_j * y_j) * s.volume) * gradient(x_ij, s)

    @image_sum(discretisation, typed)
    def lift_tangent(
        x_ij, x_dot_ij, y_i, y_j, y_dot_i, y_dot_j, image_i, image_j, image_dot_i, image_dot_j, s
    ) -> vector:
        c_dot = image_dot_i * y_i + image_i * y_dot_i + image_dot_j * y_j + image_j * y_dot_j
        bent = (image_i * y_i + image_j * y_j) * hessian_product(x_ij, x_dot_ij, s)
        return s.volume * (c_dot * gradient(x_ij, s) + bent)

    @image_sum(discretisation, typed)
    def lift_back(x_ij, y_i, y_j, image_i, image_j, f_ij, s) -> tuple[real, vector]:
        c = (image_i * y_i + image_j * y_j) * s.volume
        return s.volume * wp.dot(gradient(x_ij, s), f_ij), c * hessian_product(x_ij, f_ij, s)

    @image_sum(discretisation)
    def echo(x_ij: vector, c_i: real, c_j: real, s: neighbourhood) -> vector:
        return ((c_i + c_j) * s.volume) * gradient(x_ij, s)

    @image_sum(discretisation)
    def spread(x_ij: vector, u_ij: vector, s: neighbourhood) -> real:
        return s.volume * wp.dot(gradient(x_ij, s), u_ij)

    @image_sum(discretisation)
    def spread_tangent(x_ij: vector, x_dot_ij: vector, u_ij: vector, u_dot_ij: vector, s: neighbourhood) -> real:
        bent = wp.dot(hessian_product(x_ij, x_dot_ij, s), u_ij)
        return s.volume * (wp.dot(gradient(x_ij, s), u_dot_ij) + bent)

    @image_sum(discretisation)
    def sweep(x_ij: vector, swept: vector, s: neighbourhood) -> real:
        return s.volume * wp.dot(gradient(x_ij, s), swept)

    @image_sum(discretisation)
    def sweep_tangent(x_ij: vector, x_dot_ij: vector, swept: vector, swept_dot: vector, s: neighbourhood) -> real:
        bent = wp.dot(hessian_product(x_ij, x_dot_ij, s), swept)
        return s.volume * (wp.dot(gradient(x_ij, s), swept_dot) + bent)

    @mirror_sum(discretisation, typed)
    def mirror_walls(x_ij, v_j, foot, mirrors: int, s) -> tuple[vector, real, real]:
        part = s.volume * normal(gradient(x_ij, s), foot)
        return part, s.volume * weight(x_ij, s), wp.dot(part, v_j)

    @mirror_sum(discretisation, typed, grows=mirror_walls)
    def mirror_walls_tangent(
        x_ij, x_dot_ij, v_j, v_dot_j, foot, turn_dot, mirrors: int, s
    ) -> tuple[vector, real, real]:
        rest, g = x_dot_ij - wp.cross(turn_dot, x_ij), s.volume * gradient(x_ij, s)
        part = normal(g, foot)
        part_dot = normal(s.volume * hessian_product(x_ij, rest, s), foot) + wp.cross(turn_dot, part)
        return part_dot, wp.dot(g, rest), wp.dot(part_dot, v_j) + wp.dot(part, v_dot_j)

    @mirror_sum(discretisation, typed)
    def mirror_walls_back(x_ij, v_j, mirror_bar_i, behind_bar_i, sweep_bar_i, foot, mirrors: int, s) -> vector:
        bent = hessian_product(x_ij, normal(mirror_bar_i - sweep_bar_i * v_j, foot), s)
        return s.volume * (bent + behind_bar_i * gradient(x_ij, s))

    @mirror_sum(discretisation)
    def behind(x_ij: vector, mirrors: int, s: neighbourhood) -> real:
        return s.volume * weight(x_ij, s)

    @mirror_sum(discretisation, grows=behind)
    def behind_tangent(x_ij: vector, x_dot_ij: vector, mirrors: int, s: neighbourhood) -> real:
        return s.volume * wp.dot(gradient(x_ij, s), x_dot_ij)

    @mirror_sum(discretisation)
    def behind_back(x_ij: vector, mirrors: int, s: neighbourhood) -> vector:
        return s.volume * gradient(x_ij, s)

    return SimpleNamespace(
        weights=Kernels(image_weights, image_weights_tangent, None),
        lift=Kernels(lift, lift_tangent, lift_back),
        echo=echo,
        spread=Kernels(spread, spread_tangent, None),
        sweep=Kernels(sweep, sweep_tangent, None),
        walls=Kernels(mirror_walls, mirror_walls_tangent, mirror_walls_back),
        behind=Kernels(behind, behind_tangent, behind_back),
        mirror_of=mirror_of,
    )


@cache
def image_share(precision: Precision, dimension: int, module: Any) -> tuple[Any, Any]:
    real, smoothstep = precision.real, moment_functions(precision, dimension).smoothstep
    away = away_function(precision)
    first, last, least, apart = (wp.constant(real(value)) for value in (*EVEN, LEAST, APART))

    @wp.func
    def share(images: real, behind: real, nu: real) -> real:
        return smoothstep(images / (behind + least), first, last) * away(nu - behind, apart)

    @wp.func(module=module)
    def slope(images: real, behind: real, nu: real):
        by_images, by_behind, by_nu = wp.grad(share)(images, behind, nu)
        return by_images, by_behind, by_nu

    return share, slope
