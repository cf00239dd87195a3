"""The one sum over neighbours that diffusion is made of, B of `cortado.sph.diffusion`, and its derivatives."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import fraction_sum, lane_functions
from cortado.device.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions


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
    separation, factor, factor_gradient = pair.separation, pair.factor, pair.factor_gradient
    vectors, numbers = pair.vectors, pair.numbers
    LANES = discretisation.lanes
    lanes = lane_functions(discretisation.precision, LANES)
    lane, add_up, add_up_vectors = lanes.lane, lanes.add_up, lanes.add_up_vectors
    add_up_fractions = fraction_sum(discretisation.precision, phases, LANES)

    @wp.func
    def spread(
        i: int,
        x: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        w: wp.array(dtype=real),
        u: wp.array(dtype=fractions),
        s: neighbourhood,
    ) -> fractions:
        x_i = x[i]
        n_i = n[i]
        w_i = w[i]
        u_i = u[i]
        total = fractions()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            n_j = numbers(n, k, i, s)
            w_j = numbers(w, k, i, s)
            for t in range(UNROLL):
                weight = (w_i / n_j[t] + w_j[t] / n_i) * factor(separation(x_i, x_j[t], s), s)
                total += weight * (u_i - u[s.neighbours[k + t, i]])
        return add_up_fractions(total)

    @wp.func
    def spread_tangent(
        i: int,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        n_dot: wp.array(dtype=real),
        w: wp.array(dtype=real),
        w_dot: wp.array(dtype=real),
        u: wp.array(dtype=fractions),
        u_dot: wp.array(dtype=fractions),
        s: neighbourhood,
    ) -> fractions:
        x_i = x[i]
        n_i = n[i]
        w_i = w[i]
        total = fractions()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            for t in range(UNROLL):
                j = s.neighbours[k + t, i]
                x_ij = separation(x_i, x[j], s)
                n_j = n[j]
                weight = w_i / n_j + w[j] / n_i
                weight_dot = (w_dot[i] - w_i * n_dot[j] / n_j) / n_j + (w_dot[j] - w[j] * n_dot[i] / n_i) / n_i
                f = factor(x_ij, s)
                f_dot = wp.dot(factor_gradient(x_ij, s), x_dot[i] - x_dot[j])
                total += (weight_dot * f + weight * f_dot) * (u[i] - u[j])
                total += (weight * f) * (u_dot[i] - u_dot[j])
        return add_up_fractions(total)

    @wp.func
    def spread_adjoint(
        i: int,
        x: wp.array(dtype=vector),
        n: wp.array(dtype=real),
        w: wp.array(dtype=real),
        u: wp.array(dtype=fractions),
        y: wp.array(dtype=fractions),
        s: neighbourhood,
    ):
        """For an adjoint y of the sums: what it gives those of x_i, n_i, w_i and u_i, and y_i times the sum itself."""
        x_i = x[i]
        n_i = n[i]
        w_i = w[i]
        u_i = u[i]
        y_i = y[i]
        x_bar = vector()
        n_bar = real(0.0)
        w_bar = real(0.0)
        u_bar = fractions()
        own = real(0.0)
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            n_j = numbers(n, k, i, s)
            w_j = numbers(w, k, i, s)
            for t in range(UNROLL):
                j = s.neighbours[k + t, i]
                x_ij = separation(x_i, x_j[t], s)
                f = factor(x_ij, s)
                weight = w_i / n_j[t] + w_j[t] / n_i
                u_ij = u_i - u[j]
                y_ij = y_i - y[j]
                work = wp.dot(u_ij, y_ij)
                x_bar += (weight * work) * factor_gradient(x_ij, s)
                n_bar -= w_j[t] * f * work
                w_bar += f * work / n_j[t]
                u_bar += (weight * f) * y_ij
                own += weight * f * wp.dot(u_ij, y_i)
        x_bar = add_up_vectors(x_bar)
        n_bar = add_up(n_bar)
        w_bar = add_up(w_bar)
        u_bar = add_up_fractions(u_bar)
        own = add_up(own)
        return x_bar, n_bar / (n_i * n_i), w_bar, u_bar, own

    return PairwiseLaplacian(spread=spread, spread_tangent=spread_tangent, spread_adjoint=spread_adjoint)
