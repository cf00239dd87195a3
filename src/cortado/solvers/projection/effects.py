"""What a particle's neighbourhood lets the projection do, from the moments of its neighbours, and the images of the
fluid in flat walls that mirror it (`cortado.particles.neighbourhood`), in place of wall particles.

M, Q and g are the moments of `cortado.solvers.projection.sums`, gamma and nu those of
`cortado.solvers.projection.wall_sums`, and H is the fullness of `cortado.sph.moment_functions`. S(a, b) is a smoothstep
of H from a to b. B = 1 / (1 + ((nu + 9 q nu_m) / 0.05)^4) is 0 beside walls, with nu_m of those that mirror and q,
which is 0 beside others. The projection takes:

    sigma = S(0.1, 0.5) B    how much tension is let through, 1 where a scene is shut (see `pressure`),
    f = S(0.1, 0.5) of H + nu   how full it is: how much of the last step's pressure is taken on,
    u = S(0.5, 0.8)          how much it is shifted,
    r = S(0.8, 0.95) B       how much of a low density is repaired,
    c = S(0.7, 0.95) of H + 2 nu   its share of a coarse pressure: 1 inside and beside walls, 0 at free surfaces,
    L = I + c (B (K - I) + (1 - B_o) (t P - (1 + t) C)), c = S(0.2, 0.5),   which corrects gradients,
    K = J + 0.033 S(0.8, 0.95) J (J - I), J = 1.05 (M + 0.05 I)^-1,
    B_o = 1 / (1 + ((nu - q nu_m) / 0.05)^4), beside walls that do not mirror, whose gamma C is made of,
    C = 1.05 (P M N + N M P) / (M : N + 0.05), N = gamma gamma^T / (gamma^2 + 0.01 a_0 / 20), P = I - N,
    t = 0.2 (1.05 / (M : P / (d - 1) + 0.05) - 1), in d dimensions,
    a = |L g + gamma|^2 / m + tr(L Q L) + 0.05 a_0 / m         the diagonal of the projection's matrix.

Wall particles hold what is alone, but rows that a wave draws out beside a wall are out of their order: D takes them for
compressed, which damps waves, and still water is stirred. A mirror is right wherever rows stand. So images count h
times, and the particles of walls that mirror 1 - h times, with

    h = S(0.7, 0.9) of sum V W_i' / (nu_m + 1e-6) q,   q = 1 / (1 + ((nu - nu_m) / 0.005)^4),

the part of the images in the number density over nu_m, the part of the walls. It is 1 where as much fluid is beside a
wall as the wall expects, and 0 in spray and beside solids, which walls do not mirror. With g_i' = V grad W of the
separation from an image x_j' = R x_j + o, images add

    h_i sum (v_i - R v_j) . g_i'                   to the divergence,
    sum (h_i k_i + h_j k_j) g_i'                   to its transpose, the force,
    h_i sum V W_i'                                 to the number density.

Gradients of images are not corrected: L is 1 beside walls that mirror.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import image_sum, mirror_sum
from cortado.solvers.projection.wall_sums import DIRECTION, normal_part, types_by_name, weights_type
from cortado.sph.moment_functions import matrix_type, moment_functions

TENSION, CORRECTED, SHIFTED, REPAIRED = (0.1, 0.5), (0.2, 0.5), (0.5, 0.8), (0.8, 0.95)
"""The fullness below which nothing, and above which all is done."""
SHARED = (0.7, 0.95)
"""Fullness H + 2 nu below which the share of a coarse pressure is 0, and above which it is 1."""
WALLED = 0.05
"""nu at which a wall halves tension, correction and the repair of low densities."""
APART = 0.005
"""nu of walls that do not mirror at which a particle is half as much beside a mirror, so that it is next to none of
them where it is. Mirrors do not mirror them: with images up to its foot water at rest beside a solid that stands on
the floor moves 1.4 to 2 times as fast."""
MIRRORED = 9.0
"""How many times more walls that mirror count in B. Images make up for what is missing beside them, which K would make
up for too, and a block that falls from a lid has no tension to an image of its own."""
REGULAR = 0.05
"""The number that is added to the diagonal of M before it is inverted."""
NEWTON = 0.033
"""Two thirds of a step of Newton's method towards the inverse of M, J + J (I - M J) = J + 0.05 J (J - I). Inside of the
fluid, where M is nearly I, J follows its changes for 95 % only: rows that pass one another seem to be squeezed, which
holds back films on a gentle slope. With a whole step they flow 1 to 2 % too fast, and water at rest moves faster. At
surfaces, where M is far from I, it would widen jets."""
ALONG = 0.2
"""The part of what gradients along a wall lack beside it that is made up. On the lattice, with Wendland C2, the first
row lacks 25 % of a pressure's gradient along the wall. With 0 water at rest sinks along upright walls, in a lasting
vortex, and with 1, where divergences are right, the second row has 6 % too much and rises."""


@cache
def away_function(precision: Precision) -> Any:
    """Make the Warp function 1 / (1 + (nu / half)^4) of nu and half, which is near 0 beside walls."""
    real = precision.real

    @wp.func
    def away(nu: real, half: real) -> real:
        ratio = nu / half
        return real(1.0) / (real(1.0) + ratio * ratio * ratio * ratio)

    return away


@dataclass(frozen=True)
class EffectFunctions:
    """Warp functions of the weights, the gradient correction and the diagonal of one particle in the projection."""

    weights: Any
    """(sigma, f, u, r) of M, nu and that of walls that mirror."""
    correction: Any
    """L of M, gamma, nu, the parts of both that are of walls that mirror, and 0.05 a_0."""
    inverse: Any
    """1.05 (M + 0.05 I)^-1"""
    diagonal: Any
    """a of L, Q, g, gamma, m and 0.05 a_0."""
    share: Any
    """c of M and nu."""
    back: Any
    """From adjoints of L, a, weights and c to those of M, Q, g, gamma, nu, of walls that mirror, and m."""


@cache
def effect_functions(precision: Precision, dimension: int, module: Any) -> EffectFunctions:
    """Make the functions of a particle's weights and corrections in 2 or 3 dimensions, in a Warp module."""
    real, vector, matrix = precision.real, precision.vector, matrix_type(precision)
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
        """Return the correction t P - (1 + t) C along a wall; M_zz = 1 of the plane does not count."""
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
        """Return the diagonal a of the pressure matrix; L and Q are symmetric: tr(L Q L) = (L L) : Q."""
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

    return EffectFunctions(weights, correction, inverse, diagonal, share, back)


EVEN = (0.7, 0.9)
"""The images' part in the density over that of wall particles, below which images do not count, and above which they
count wholly. From 0.5 to 0.8 waves are the same, but spray that is thrown at a wall in long steps passes it."""
LEAST = 1e-6
"""Wall coverage nu below which a wall is out of reach."""


@dataclass(frozen=True)
class ImageSums:
    """Warp functions of the sums over images of the fluid in flat walls, and over the walls that mirror."""

    weights: Kernels
    """sum V W_i', without an adjoint"""
    lift: Kernels
    """sum (h_i y_i + h_j y_j) g_i', for arrays y and h. From adjoints f of it: sum g_i' . (f_i - R f_j), and what x is
    given."""
    echo: Any
    """sum (c_i + c_j) g_i'"""
    spread: Kernels
    """sum (u_i - R u_j) . g_i', without an adjoint"""
    sweep: Kernels
    """sum g_i' . (what mirrors have swept), where solids move, without an adjoint"""
    walls: Kernels
    """Sums over walls that mirror about a position: along their normals, nu, and the drift along their normals."""
    behind: Kernels
    """The wall coverage nu alone; the adjoint is its gradient."""
    mirror_of: Any
    """The number of the walls that mirror about a position."""


@cache
def image_sums(discretisation: Discretisation) -> ImageSums:
    """Make the sums over images of the fluid in flat walls, for a discretisation."""
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

    @image_sum(discretisation)
    @typed
    def lift_tangent(
        x_ij, x_dot_ij, y_i, y_j, y_dot_i, y_dot_j, image_i, image_j, image_dot_i, image_dot_j, s
    ) -> vector:
        c_dot = image_dot_i * y_i + image_i * y_dot_i + image_dot_j * y_j + image_j * y_dot_j
        bent = (image_i * y_i + image_j * y_j) * hessian_product(x_ij, x_dot_ij, s)
        return s.volume * (c_dot * gradient(x_ij, s) + bent)

    @image_sum(discretisation)
    @typed
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

    @mirror_sum(discretisation)
    @typed
    def mirror_walls(x_ij, v_j, foot, mirrors: int, s) -> tuple[vector, real, real]:
        part = s.volume * normal(gradient(x_ij, s), foot)
        return part, s.volume * weight(x_ij, s), wp.dot(part, v_j)

    @mirror_sum(discretisation, grows=mirror_walls)
    @typed
    def mirror_walls_tangent(
        x_ij, x_dot_ij, v_j, v_dot_j, foot, turn_dot, mirrors: int, s
    ) -> tuple[vector, real, real]:
        rest, g = x_dot_ij - wp.cross(turn_dot, x_ij), s.volume * gradient(x_ij, s)
        part = normal(g, foot)
        part_dot = normal(s.volume * hessian_product(x_ij, rest, s), foot) + wp.cross(turn_dot, part)
        return part_dot, wp.dot(g, rest), wp.dot(part_dot, v_j) + wp.dot(part, v_dot_j)

    @mirror_sum(discretisation)
    @typed
    def mirror_walls_back(x_ij, v_j, mirror_bar_i, behind_bar_i, sweep_bar_i, foot, mirrors: int, s) -> vector:
        """Return the adjoint of x by those of the sums; that of the drift is -``sweep_bar``."""
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

    return ImageSums(
        Kernels(image_weights, image_weights_tangent, None),
        Kernels(lift, lift_tangent, lift_back),
        echo,
        Kernels(spread, spread_tangent, None),
        Kernels(sweep, sweep_tangent, None),
        Kernels(mirror_walls, mirror_walls_tangent, mirror_walls_back),
        Kernels(behind, behind_tangent, behind_back),
        mirror_of,
    )


@cache
def image_share(precision: Precision, dimension: int, module: Any) -> tuple[Any, Any]:
    """Make two Warp functions: the share h of an image, given its part of the density and the nu of walls, and the
    derivatives of h."""
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
