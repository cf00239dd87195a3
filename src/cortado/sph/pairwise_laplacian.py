"""The one sum over neighbours that diffusion is made of, B of `cortado.sph.diffusion`, and its derivatives."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.particles.by_hand import adjoint_of, tangent_of
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import fluid_sum


@dataclass(frozen=True)
class PairwiseLaplacian:
    """The pairwise Laplacian as a function of Warp, with its derivatives."""

    spread: Any
    spread_tangent: Any
    spread_adjoint: Any


@cache
def pairwise_laplacian_functions(discretisation: Discretisation, phases: int) -> PairwiseLaplacian:
    """Raw sums of B / V over the neighbours: ``spread``, ``spread_tangent``, ``spread_adjoint``."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    fractions = discretisation.precision.fractions(phases)
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    factor, factor_gradient = pair.factor, pair.factor_gradient

    @fluid_sum(discretisation)
    def spread(
        x_ij: vector, n_i: real, n_j: real, w_i: real, w_j: real, u_ij: fractions, s: neighbourhood
    ) -> fractions:
        return ((w_i / n_j + w_j / n_i) * factor(x_ij, s)) * u_ij

    @tangent_of(spread)
    @fluid_sum(discretisation, ahead=False)
    def spread_tangent(
        x_ij: vector,
        x_dot_ij: vector,
        n_i: real,
        n_j: real,
        n_dot_i: real,
        n_dot_j: real,
        w_i: real,
        w_j: real,
        w_dot_i: real,
        w_dot_j: real,
        u_ij: fractions,
        u_dot_ij: fractions,
        s: neighbourhood,
    ) -> fractions:
        weight = w_i / n_j + w_j / n_i
        weight_dot = (w_dot_i - w_i * n_dot_j / n_j) / n_j + (w_dot_j - w_j * n_dot_i / n_i) / n_i
        f = factor(x_ij, s)
        f_dot = wp.dot(factor_gradient(x_ij, s), x_dot_ij)
        return (weight_dot * f + weight * f_dot) * u_ij + (weight * f) * u_dot_ij

    @adjoint_of(spread)
    @fluid_sum(discretisation)
    def spread_adjoint(
        x_ij: vector,
        n_i: real,
        n_j: real,
        w_i: real,
        w_j: real,
        u_ij: fractions,
        y_i: fractions,
        y_ij: fractions,
        s: neighbourhood,
    ) -> tuple[vector, real, real, fractions, real]:
        """For an adjoint y of the sums: what it gives those of x_i, n_i, w_i and u_i, and y_i times the sum itself."""
        f = factor(x_ij, s)
        weight = w_i / n_j + w_j / n_i
        work = wp.dot(u_ij, y_ij)
        x_bar = (weight * work) * factor_gradient(x_ij, s)
        n_bar = -w_j * f * work / (n_i * n_i)
        return x_bar, n_bar, f * work / n_j, (weight * f) * y_ij, weight * f * wp.dot(u_ij, y_i)

    return PairwiseLaplacian(spread=spread, spread_tangent=spread_tangent, spread_adjoint=spread_adjoint)
