"""Weights and gradient corrections of a particle in the projection, and images of the fluid in flat mirroring walls.

Weights and corrections are computed from the moments of the particle's neighbours. Images replace wall particles
(`cortado.particles.neighbourhood`).

M, Q and g are the moments of `cortado.solvers.projection.sums`, and gamma and nu are the sums of
`cortado.solvers.projection.wall_sums`. H is the fullness of `cortado.sph.moment_functions`, and S(a, b) is a smoothstep
of H from a to b. The factor B = 1 / (1 + ((nu + 9 q nu_m) / 0.05)^4) is near 0 beside walls. Here nu_m is the part of
nu from mirroring walls, and q is near 0 beside walls without mirror. The projection uses:

    sigma = S(0.1, 0.5) B    the part of tension that is admitted; 1 in a shut scene (see `pressure`),
    f = S(0.1, 0.5) of H + nu   the part of the previous step's pressure with which a step begins,
    u = S(0.5, 0.8)          the part of the shift that is applied,
    r = S(0.8, 0.95) B       the part of a low density that is repaired,
    c = S(0.7, 0.95) of H + 2 nu   the share of a coarse pressure: 1 inside and beside walls, 0 at free surfaces,
    L = I + c (B (K - I) + (1 - B_o) (t P - (1 + t) C)), c = S(0.2, 0.5),   which corrects gradients,
    K = J + 0.033 S(0.8, 0.95) J (J - I), J = 1.05 (M + 0.05 I)^-1,
    B_o = 1 / (1 + ((nu - q nu_m) / 0.05)^4), 0 beside walls without mirror; C uses their gamma,
    C = 1.05 (P M N + N M P) / (M : N + 0.05), N = gamma gamma^T / (gamma^2 + 0.01 a_0 / 20), P = I - N,
    t = 0.2 (1.05 / (M : P / (d - 1) + 0.05) - 1), in d dimensions,
    a = |L g + gamma|^2 / m + tr(L Q L) + 0.05 a_0 / m,   the diagonal of the projection's matrix.

A wave stretches the layers of fluid beside a wall, so that they no longer match the layers of wall particles. The
divergence D then mistakes the fluid for compressed, which damps waves and stirs still water. Mirror images always match
the layers of fluid. Images therefore have the weight h, and particles of mirroring walls the weight 1 - h, with

    h = S(0.7, 0.9) of sum V W_i' / (nu_m + 1e-6) q,   q = 1 / (1 + ((nu - nu_m) / 0.005)^4).

The weight h is a smoothstep of the number density of images divided by nu_m, the number density of mirroring walls. The
weight is 1 if the fluid beside a wall is as dense as the wall expects. The weight is 0 in spray and beside solids,
because walls do not mirror solids. An image of particle j is at x_j' = R x_j + o, where R reflects vectors and o is an
offset. With the kernel gradient g_i' = V grad W of the separation from the image, images add

    h_i sum (v_i - R v_j) . g_i'                   to the divergence,
    sum (h_i k_i + h_j k_j) g_i'                   to its transpose, the force,
    h_i sum V W_i'                                 to the number density.

Gradients of images are not corrected: L is the unit matrix beside mirroring walls.
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
"""Two values of the fullness for each weight: the weight begins to grow from 0 at the first, and is 1 from the
second."""
SHARED = (0.7, 0.95)
"""Two values of the fullness: the weight of the coarse pressure begins to grow from 0 at the first, and is 1 from the
second."""
WALLED = 0.05
"""Wall coverage that halves the weights of tension, gradient correction and repairs."""
APART = 0.005
"""Coverage by walls without mirror images that halves the weight of images."""
MIRRORED = 9.0
"""Additional weight of mirroring walls in the wall coverage."""
REGULAR = 0.05
"""Regularisation of the moment matrix before its inversion."""
NEWTON = 0.033
"""Factor of a Newton step towards the inverse of the moment matrix. A full step would make water at rest move
faster."""
ALONG = 0.2
"""Corrected fraction of the missing gradient along a wall. With the fraction 0, water at rest sinks along upright
walls. With the fraction 1, the second layer of particles rises."""


@cache
def away_function(precision: Precision) -> Any:
    """Make the Warp function of a weight that is 1 away from walls and near 0 beside walls. ``half`` is the wall
    coverage for the weight one half."""
    real = precision.real

    @wp.func
    def away(nu: real, half: real) -> real:
        ratio = nu / half
        return real(1.0) / (real(1.0) + ratio * ratio * ratio * ratio)

    return away


@cache
def effect_functions(precision: Precision, dimension: int, module: Any) -> SimpleNamespace:
    """Make Warp functions of a particle's gradient correction, diagonal and weights, with derivatives."""
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
        """Return the gradient correction beside a wall."""
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
"""Ratios of the density of images to the density of wall particles. The weight of images is 0 below the first ratio and
1 above the second."""
LEAST = 1e-6
"""Smallest wall coverage that counts."""


@cache
def image_sums(discretisation: Discretisation) -> SimpleNamespace:
    """Make the sums over mirror images of the fluid in flat walls, and over the particles of mirroring walls.

    - ``weights``: density of images
    - ``lift``: force of pressures
    - ``echo``: adjoint of the density of images
    - ``spread``: divergence of velocities
    - ``sweep``: divergence by moving solids
    - ``walls``: sums over mirroring walls
    - ``behind``: coverage by mirroring walls
    - ``mirror_of``: number of the walls that mirror about a position
    """
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
    """Make Warp functions of the weight of images and of its derivatives."""
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
