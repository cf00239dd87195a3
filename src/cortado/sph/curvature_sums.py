"""The sums of surface tension by curvature over the neighbours of a particle, see `cortado.sph.curvature_kernels`."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.particles.by_hand import tangent_of
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum
from cortado.sph.moment_functions import cross_terms_function, matrix_type


@dataclass(frozen=True)
class CurvatureSums:
    """Warp functions of sums over the fluid. A symmetric matrix comes as its diagonal and its entries yz, xz and xy."""

    colour: Any
    """g and z, without W(0)."""
    colour_tangent: Any
    colour_back: Any
    """What adjoints of g and z give to x."""
    average: Any
    """V sum W_ij g_j"""
    average_tangent: Any
    average_back: Any
    """For adjoints r of it: V sum W_ij r_j, and what x is given."""
    bend: Any
    """B and the symmetric part of D."""
    bend_tangent: Any
    bend_back: Any
    """For symmetric adjoints of B and D: what e, w and x are given."""
    mean: Any
    """V sum W_ij c_j and V sum W_ij w_j"""
    mean_tangent: Any
    mean_back: Any
    """For adjoints a and b of the two: V sum W_ij a_j, V sum W_ij b_j, and what x is given."""


@cache
def curvature_sums(discretisation: Discretisation) -> CurvatureSums:
    """Of a discretisation."""
    precision = discretisation.precision
    real, vector = precision.real, precision.vector
    neighbourhood, matrix = neighbourhood_type(precision), matrix_type(precision)
    pair, cross_terms = pair_functions(discretisation), cross_terms_function(precision)
    weight, slope, gradient, hessian_product = pair.weight, pair.slope, pair.gradient, pair.hessian_product

    @wp.func
    def even_terms(a: vector, b: vector) -> vector:
        """Entries yz, xz and xy of (a b^T + b a^T) / 2."""
        return real(0.5) * (cross_terms(a, b) + cross_terms(b, a))

    @fluid_sum(discretisation)
    def colour(x_ij: vector, s: neighbourhood) -> tuple[vector, real]:
        return s.volume * gradient(x_ij, s), s.volume * weight(x_ij, s)

    @tangent_of(colour)
    @fluid_sum(discretisation, ahead=False)
    def colour_tangent(x_ij: vector, x_dot_ij: vector, s: neighbourhood) -> tuple[vector, real]:
        return s.volume * hessian_product(x_ij, x_dot_ij, s), s.volume * wp.dot(gradient(x_ij, s), x_dot_ij)

    @fluid_sum(discretisation)
    def colour_back(x_ij: vector, g_bar_ij: vector, z_bar_i: real, z_bar_j: real, s: neighbourhood) -> vector:
        return s.volume * (hessian_product(x_ij, g_bar_ij, s) + (z_bar_i + z_bar_j) * gradient(x_ij, s))

    @fluid_sum(discretisation)
    def average(x_ij: vector, g_j: vector, s: neighbourhood) -> vector:
        return (s.volume * weight(x_ij, s)) * g_j

    @tangent_of(average)
    @fluid_sum(discretisation, ahead=False)
    def average_tangent(x_ij: vector, x_dot_ij: vector, g_j: vector, g_dot_j: vector, s: neighbourhood) -> vector:
        return s.volume * (weight(x_ij, s) * g_dot_j + wp.dot(gradient(x_ij, s), x_dot_ij) * g_j)

    @fluid_sum(discretisation)
    def average_back(
        x_ij: vector, g_i: vector, g_j: vector, r_i: vector, r_j: vector, s: neighbourhood
    ) -> tuple[vector, vector]:
        both = wp.dot(r_i, g_j) + wp.dot(r_j, g_i)
        return (s.volume * weight(x_ij, s)) * r_j, (s.volume * both) * gradient(x_ij, s)

    @fluid_sum(discretisation)
    def bend(
        x_ij: vector, e_i: vector, e_j: vector, w_j: real, s: neighbourhood
    ) -> tuple[vector, vector, vector, vector]:
        g = (s.volume * w_j) * gradient(x_ij, s)
        turn = e_j - e_i
        return -wp.cw_mul(g, x_ij), -cross_terms(g, x_ij), wp.cw_mul(turn, g), even_terms(turn, g)

    @tangent_of(bend)
    @fluid_sum(discretisation, ahead=False)
    def bend_tangent(
        x_ij: vector,
        x_dot_ij: vector,
        e_i: vector,
        e_j: vector,
        e_dot_i: vector,
        e_dot_j: vector,
        w_j: real,
        w_dot_j: real,
        s: neighbourhood,
    ) -> tuple[vector, vector, vector, vector]:
        """g x^T is symmetric, and so are the two terms together that its tangent has."""
        g = (s.volume * w_j) * gradient(x_ij, s)
        g_dot = s.volume * (w_dot_j * gradient(x_ij, s) + w_j * hessian_product(x_ij, x_dot_ij, s))
        turn, turn_dot = e_j - e_i, e_dot_j - e_dot_i
        return (
            -wp.cw_mul(g_dot, x_ij) - wp.cw_mul(g, x_dot_ij),
            -cross_terms(g_dot, x_ij) - cross_terms(g, x_dot_ij),
            wp.cw_mul(turn_dot, g) + wp.cw_mul(turn, g_dot),
            even_terms(turn_dot, g) + even_terms(turn, g_dot),
        )

    @fluid_sum(discretisation)
    def bend_back(
        x_ij: vector,
        e_i: vector,
        e_j: vector,
        w_i: real,
        w_j: real,
        B_bar_i: matrix,
        B_bar_j: matrix,
        D_bar_i: matrix,
        D_bar_j: matrix,
        s: neighbourhood,
    ) -> tuple[vector, real, vector]:
        """A pair adds w_j times something to the sums of i, and w_i times the same to those of j."""
        g, turn = s.volume * gradient(x_ij, s), e_j - e_i
        moved = (w_j * B_bar_i + w_i * B_bar_j) * x_ij
        turned = w_j * D_bar_i + w_i * D_bar_j
        w_part = wp.dot(g, D_bar_j * turn - B_bar_j * x_ij)
        x_part = hessian_product(x_ij, turned * turn - moved, s) - slope(x_ij, s) * moved
        return -(turned * g), w_part, s.volume * x_part

    @fluid_sum(discretisation)
    def mean(x_ij: vector, c_j: real, w_j: real, s: neighbourhood) -> tuple[real, real]:
        W = s.volume * weight(x_ij, s)
        return W * c_j, W * w_j

    @tangent_of(mean)
    @fluid_sum(discretisation, ahead=False)
    def mean_tangent(
        x_ij: vector, x_dot_ij: vector, c_j: real, c_dot_j: real, w_j: real, w_dot_j: real, s: neighbourhood
    ) -> tuple[real, real]:
        W, W_dot = s.volume * weight(x_ij, s), s.volume * wp.dot(gradient(x_ij, s), x_dot_ij)
        return W_dot * c_j + W * c_dot_j, W_dot * w_j + W * w_dot_j

    @fluid_sum(discretisation)
    def mean_back(
        x_ij: vector,
        c_i: real,
        c_j: real,
        w_i: real,
        w_j: real,
        a_i: real,
        a_j: real,
        b_i: real,
        b_j: real,
        s: neighbourhood,
    ) -> tuple[real, real, vector]:
        W, both = s.volume * weight(x_ij, s), a_i * c_j + a_j * c_i + b_i * w_j + b_j * w_i
        return W * a_j, W * b_j, (s.volume * both) * gradient(x_ij, s)

    return CurvatureSums(
        *(colour, colour_tangent, colour_back),
        *(average, average_tangent, average_back),
        *(bend, bend_tangent, bend_back),
        *(mean, mean_tangent, mean_back),
    )
