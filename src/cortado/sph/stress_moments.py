"""The sums of viscosity as a stress over the neighbours of a particle, M, A and R of `cortado.sph.stress_kernels`."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.particles.by_hand import tangent_of
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import rubbing_sum
from cortado.sph.moment_functions import cross_terms_function, matrix_type
from cortado.sph.stress_functions import fluidity_function
from cortado.sph.wall_contact import contact_functions


@dataclass(frozen=True)
class MomentSums:
    """Warp functions of sums."""

    sums: Any
    """The diagonal of M, its entries yz, xz and xy, the rows of A, and R."""
    tangent: Any
    """Their tangents."""
    back: Any
    """What their adjoints, two matrices and a number for each particle, give to its x, v and mu."""


@cache
def moment_sums(discretisation: Discretisation, sticks: bool) -> MomentSums:
    """With walls without slip if it ``sticks``."""
    precision = discretisation.precision
    real, vector = precision.real, precision.vector
    neighbourhood = neighbourhood_type(precision)
    slope_gradient, contact = pair_functions(discretisation).slope_gradient, contact_functions(discretisation)
    weight, fall, fall_change = contact.weight, contact.fall, contact.fall_change
    hold, hold_gradient = contact.hold, contact.hold_gradient
    summed = rubbing_sum(discretisation, sticks)
    fluidity, matrix = fluidity_function(precision), matrix_type(precision)
    cross_terms = cross_terms_function(precision)

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
        turn_dot: vector,
        s: neighbourhood,
    ) -> tuple[vector, vector, vector, vector, vector, real]:
        """A wall that turns turns y; the rest of the way changes it as it does beside one that does not."""
        w, y, rest = hold(x_ij, foot, least, s), fall(x_ij, foot), x_dot_ij - wp.cross(turn_dot, x_ij)
        u = fall_change(x_ij, rest, foot) + wp.cross(turn_dot, y)
        w_dot, thin = wp.dot(hold_gradient(x_ij, foot, least, s), rest), fluidity(mu_i)
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
    @summed(wall_moments_tangent, ahead=False, grows=moments)
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

    return MomentSums(moments, moments_tangent, moments_back)


def moments_work(d: Discretisation) -> Any:
    """What the sums give to solids, for their adjoints ``M_bar``, ``A_bar`` and ``R_bar``, with ``least`` the first of
    the ``constants`` (`cortado.particles.solid_shares.solid_kernel`)."""
    precision, contact = d.precision, contact_functions(d)
    real, vector, matrix, pair = precision.real, precision.vector, matrix_type(precision), precision.pair
    fall, hold, fluidity = contact.fall, contact.hold, fluidity_function(precision)

    def moments_work(
        x_ij: vector,
        v_ij: vector,
        mu_i: real,
        M_bar_i: matrix,
        A_bar_i: matrix,
        R_bar_i: real,
        constants: pair,
        foot: vector,
        s: neighbourhood_type(precision),
    ) -> real:
        y = fall(x_ij, foot)
        bars = wp.dot(y, M_bar_i * y) + wp.dot(v_ij, A_bar_i * y) + R_bar_i * wp.dot(y, y) * fluidity(mu_i)
        return hold(x_ij, foot, constants[0], s) * bars

    return moments_work
