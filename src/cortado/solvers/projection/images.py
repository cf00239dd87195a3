"""Images of the fluid in flat walls that mirror it (`cortado.particles.neighbourhood`), in place of wall particles.

Wall particles hold what is alone, but rows that a wave draws out beside a wall are out of their order: D takes them for
compressed, which damps waves, and still water is stirred. A mirror is right wherever rows stand. So images count h
times, and the particles of walls that mirror 1 - h times, with

    h = S(0.7, 0.9) of sum V W_i' / (nu_m + 1e-6) q,   q = 1 / (1 + ((nu - nu_m) / 0.005)^4),

the images' part in the number density over nu_m, that of the walls: 1 where as much fluid is beside a wall as it
expects, and 0 in spray and beside solids, which walls do not mirror. With g_i' = V grad W of the separation from an
image x_j' = R x_j + o, images add

    h_i sum (v_i - R v_j) . g_i'                   to the divergence,
    sum (h_i k_i + h_j k_j) g_i'                   to its transpose, the force,
    h_i sum V W_i'                                 to the number density.

Gradients of images are not corrected: L is 1 beside walls that mirror.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import image_sum, solid_sum
from cortado.solvers.projection.effects import APART, away_function
from cortado.solvers.projection.walls import normal_part
from cortado.sph.moment_functions import moment_functions

CONTAINER = -1
"""Number of the container in place of a solid's."""
NOTHING = -(2**31)
"""A number that no solid has."""
EVEN = (0.7, 0.9)
"""The images' part in the density over that of wall particles, below which images do not count, and above which they
count wholly. From 0.5 to 0.8 waves are the same, but spray that is thrown at a wall in long steps passes it."""
LEAST = 1e-6
"""Wall coverage nu below which a wall is out of reach."""


@dataclass(frozen=True)
class ImageSums:
    """Warp functions of the sums over images of the fluid in flat walls, and over the walls that mirror."""

    weights: Any
    """sum V W_i'"""
    weights_tangent: Any
    lift: Any
    """sum (h_i y_i + h_j y_j) g_i', for arrays y and h."""
    lift_tangent: Any
    lift_back: Any
    """For adjoints f of the lift: sum g_i' . (f_i - R f_j), and what x is given."""
    echo: Any
    """sum (c_i + c_j) g_i'"""
    spread: Any
    """sum (u_i - R u_j) . g_i'"""
    spread_tangent: Any
    walls: Any
    """Sums over the walls of the solid ``mirror_of`` a position, which mirror: along their normals, and nu."""
    walls_tangent: Any
    walls_back: Any
    """The adjoint of x from those of both sums over mirroring walls."""
    behind: Any
    """The wall coverage nu alone."""
    behind_tangent: Any
    behind_back: Any
    """The gradient of nu."""
    mirror_of: Any
    """The number of the container, or of nothing where no wall mirrors."""


@cache
def image_sums(discretisation: Discretisation) -> ImageSums:
    """Make the sums over images of the fluid in flat walls, for a discretisation."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood, pair = neighbourhood_type(discretisation.precision), pair_functions(discretisation)
    weight, gradient, hessian_product = pair.weight, pair.gradient, pair.hessian_product
    normal, near_mirrors = normal_part(discretisation), pair.near_mirrors

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
    def lift_tangent(
        x_ij: vector,
        x_dot_ij: vector,
        y_i: real,
        y_j: real,
        y_dot_i: real,
        y_dot_j: real,
        image_i: real,
        image_j: real,
        image_dot_i: real,
        image_dot_j: real,
        s: neighbourhood,
    ) -> vector:
        c_dot = image_dot_i * y_i + image_i * y_dot_i + image_dot_j * y_j + image_j * y_dot_j
        bent = (image_i * y_i + image_j * y_j) * hessian_product(x_ij, x_dot_ij, s)
        return s.volume * (c_dot * gradient(x_ij, s) + bent)

    @image_sum(discretisation)
    def lift_back(
        x_ij: vector, y_i: real, y_j: real, image_i: real, image_j: real, f_ij: vector, s: neighbourhood
    ) -> tuple[real, vector]:
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

    @solid_sum(discretisation)
    def mirror_walls(x_ij: vector, foot: vector, solid: int, s: neighbourhood) -> tuple[vector, real]:
        return s.volume * normal(gradient(x_ij, s), foot), s.volume * weight(x_ij, s)

    @solid_sum(discretisation)
    def mirror_walls_tangent(
        x_ij: vector, x_dot_i: vector, foot: vector, solid: int, s: neighbourhood
    ) -> tuple[vector, real]:
        """Return the tangent of the sums over mirroring walls, which are at rest."""
        bent = normal(hessian_product(x_ij, x_dot_i, s), foot)
        return s.volume * bent, s.volume * wp.dot(gradient(x_ij, s), x_dot_i)

    @solid_sum(discretisation)
    def mirror_walls_back(
        x_ij: vector, mirror_bar_i: vector, behind_bar_i: real, foot: vector, solid: int, s: neighbourhood
    ) -> vector:
        bent = hessian_product(x_ij, normal(mirror_bar_i, foot), s)
        return s.volume * (bent + behind_bar_i * gradient(x_ij, s))

    @solid_sum(discretisation)
    def behind(x_ij: vector, solid: int, s: neighbourhood) -> real:
        return s.volume * weight(x_ij, s)

    @solid_sum(discretisation)
    def behind_tangent(x_ij: vector, x_dot_i: vector, solid: int, s: neighbourhood) -> real:
        return s.volume * wp.dot(gradient(x_ij, s), x_dot_i)

    @solid_sum(discretisation)
    def behind_back(x_ij: vector, solid: int, s: neighbourhood) -> vector:
        return s.volume * gradient(x_ij, s)

    @wp.func
    def mirror_of(x: vector, s: neighbourhood) -> int:
        return wp.where(near_mirrors(x, s) > 0, CONTAINER, NOTHING)

    return ImageSums(
        *(image_weights, image_weights_tangent, lift, lift_tangent, lift_back, echo, spread, spread_tangent),
        *(mirror_walls, mirror_walls_tangent, mirror_walls_back, behind, behind_tangent, behind_back, mirror_of),
    )


@cache
def image_share(precision: Precision, dimension: int, module: Any) -> tuple[Any, Any]:
    """Make the Warp functions of an image's share h, by its part in the density and nu of walls, and of its slope."""
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
