"""What walls are to a particle of the projection, with its derivatives: gamma = sum w_b g_ib, of each wall particle the
part along the normal of its wall, nu = V sum w_b W_ib, and gamma . v summed over walls that move, their drift."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import wall_sum
from cortado.particles.solid_shares import solid_kernel
from cortado.particles.wall_terms import WallTerm


@dataclass(frozen=True)
class BesideSums:
    """Warp functions."""

    sums: Any
    """gamma, nu and the drift."""
    tangent: Any
    back: Any
    """What their adjoints give to x."""


@cache
def normal_part(discretisation: Discretisation) -> Any:
    """The Warp function of a vector, along the normal of a wall at the ``foot`` of a particle of it."""
    vector = discretisation.precision.vector

    @wp.func
    def normal_part(a: vector, foot: vector) -> vector:
        return (wp.dot(a, foot) / wp.dot(foot, foot)) * foot

    return normal_part


@cache
def beside_sums(discretisation: Discretisation) -> BesideSums:
    """Of a discretisation."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood, pair = neighbourhood_type(discretisation.precision), pair_functions(discretisation)
    weight, gradient, hessian_product = pair.weight, pair.gradient, pair.hessian_product
    normal = normal_part(discretisation)

    @wall_sum(discretisation)
    def beside(x_ij: vector, v_j: vector, foot: vector, s: neighbourhood) -> tuple[vector, real, real]:
        push = s.volume * normal(gradient(x_ij, s), foot)
        return push, s.volume * weight(x_ij, s), wp.dot(push, v_j)

    @wall_sum(discretisation)
    def beside_tangent(
        x_ij: vector,
        x_dot_ij: vector,
        v_j: vector,
        v_dot_j: vector,
        foot: vector,
        turn_dot: vector,
        s: neighbourhood,
    ) -> tuple[vector, real, real]:
        """A wall that turns turns its push; the rest of the way changes it as it does beside one that does not."""
        G, rest = gradient(x_ij, s), x_dot_ij - wp.cross(turn_dot, x_ij)
        push = s.volume * normal(G, foot)
        change = s.volume * normal(hessian_product(x_ij, rest, s), foot) + wp.cross(turn_dot, push)
        return change, s.volume * wp.dot(G, rest), wp.dot(change, v_j) + wp.dot(push, v_dot_j)

    @wall_sum(discretisation)
    def beside_back(
        x_ij: vector,
        v_j: vector,
        gamma_bar_i: vector,
        nu_bar_i: real,
        drift_bar_i: real,
        foot: vector,
        s: neighbourhood,
    ) -> vector:
        push = hessian_product(x_ij, normal(gamma_bar_i + drift_bar_i * v_j, foot), s)
        return s.volume * (push + nu_bar_i * gradient(x_ij, s))

    return BesideSums(beside, beside_tangent, beside_back)


def beside_solid_kernel(discretisation: Discretisation) -> Any:
    """The kernel of what they give to solids (`cortado.particles.solid_shares.SolidShares.add`), for the adjoints
    ``gamma_bar``, ``nu_bar`` and ``drift_bar``."""
    return solid_kernel(discretisation, "projection", _work)


def push_term(discretisation: Discretisation) -> WallTerm:
    """gamma / V of the walls of a solid, with the adjoint ``push_bar``."""
    return WallTerm(discretisation, "projection", _push_work, "push_bar")


def _push_work(d: Discretisation) -> Any:
    real, vector, gradient, normal = d.precision.real, d.precision.vector, pair_functions(d).gradient, normal_part(d)

    def push_work(x_ij: vector, push_bar_i: vector, foot: vector, s: neighbourhood_type(d.precision)) -> real:
        return wp.dot(normal(gradient(x_ij, s), foot), push_bar_i)

    return push_work


def _work(d: Discretisation) -> Any:
    real, vector, pair = d.precision.real, d.precision.vector, pair_functions(d)
    weight, gradient, normal = pair.weight, pair.gradient, normal_part(d)

    def beside_work(
        x_ij: vector,
        v_j: vector,
        gamma_bar_i: vector,
        nu_bar_i: real,
        drift_bar_i: real,
        foot: vector,
        s: neighbourhood_type(d.precision),
    ) -> real:
        push = normal(gradient(x_ij, s), foot)
        return s.volume * (wp.dot(push, gamma_bar_i + drift_bar_i * v_j) + nu_bar_i * weight(x_ij, s))

    return beside_work
