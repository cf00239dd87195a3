"""Density by summation, wall particles of calibrated weights included, as a number density:

n_i = V (W(0) + sum_j W_ij + sum_b w_b W_ib),   rho_i = m_i n_i.

V is the rest volume on the lattice and m_i a particle's mass over V. No mass of a neighbour enters (Solenthaler and
Pajarola 2008): the density of a heavy fluid is not smeared into a light one.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.kernels import Kernels
from cortado.device.lanes import lane_functions
from cortado.device.neighbourhood import UNROLL, Discretisation, neighbourhood_type, pair_functions


@dataclass(frozen=True)
class DensitySums:
    """Warp functions of the sums over neighbours in the number density."""

    weights: Any
    weights_tangent: Any
    weights_adjoint: Any


@cache
def density_sums(discretisation: Discretisation) -> DensitySums:
    """Raw neighbour sums: ``weights`` (sum of W, with what fills the list up), ``weights_tangent`` and
    ``weights_adjoint`` (sum_j (r_i + r_j) G_ij + sum_b w_b r_i G_ib: the adjoint of positions for an
    adjoint r of the sum of every particle)."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    neighbour, wall_position, wall_weight = pair.neighbour, pair.wall_position, pair.wall_weight
    separation, weight, slope, gradient = pair.separation, pair.weight, pair.slope, pair.gradient
    vectors, numbers = pair.vectors, pair.numbers
    LANES = discretisation.lanes
    lanes = lane_functions(discretisation.precision, LANES)
    lane, add_up, add_up_vectors = lanes.lane, lanes.add_up, lanes.add_up_vectors

    @wp.func
    def weights(i: int, x: wp.array(dtype=vector), s: neighbourhood) -> real:
        x_i = x[i]
        total = real(0.0)
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            for u in range(UNROLL):
                total += weight(separation(x_i, x_j[u], s), s)
        for k in range(s.fluid_count[i] + lane(), s.count[i], LANES):
            b = neighbour(k, i, s)
            total += wall_weight(b, s) * weight(separation(x_i, wall_position(b, s), s), s)
        return add_up(total)

    @wp.func
    def weights_tangent(i: int, x: wp.array(dtype=vector), x_dot: wp.array(dtype=vector), s: neighbourhood) -> real:
        x_i = x[i]
        x_dot_i = x_dot[i]
        total = real(0.0)
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            for u in range(UNROLL):
                j = neighbour(k + u, i, s)
                total += wp.dot(gradient(separation(x_i, x[j], s), s), x_dot_i - x_dot[j])
        for k in range(s.fluid_count[i] + lane(), s.count[i], LANES):
            b = neighbour(k, i, s)
            g_ib = gradient(separation(x_i, wall_position(b, s), s), s)
            total += wall_weight(b, s) * wp.dot(g_ib, x_dot_i)
        return add_up(total)

    @wp.func
    def weights_adjoint(i: int, x: wp.array(dtype=vector), r: wp.array(dtype=real), s: neighbourhood) -> vector:
        x_i = x[i]
        r_i = r[i]
        total = vector()
        for k in range(lane() * UNROLL, s.fluid_count[i], UNROLL * LANES):
            x_j = vectors(x, k, i, s)
            r_j = numbers(r, k, i, s)
            for u in range(UNROLL):
                x_ij = separation(x_i, x_j[u], s)
                total += ((r_i + r_j[u]) * slope(x_ij, s)) * x_ij
        for k in range(s.fluid_count[i] + lane(), s.count[i], LANES):
            b = neighbour(k, i, s)
            total += (wall_weight(b, s) * r_i) * gradient(separation(x_i, wall_position(b, s), s), s)
        return add_up_vectors(total)

    return DensitySums(weights=weights, weights_tangent=weights_tangent, weights_adjoint=weights_adjoint)


@cache
def density_kernels(discretisation: Discretisation, topic: str = "density") -> Kernels:
    """Kernels ``forward``, ``tangent`` and ``adjoint`` of the number density at given positions, in the Warp modules of
    a topic: one that a solver has of its own saves it a module to load."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    sums = density_sums(discretisation)
    weights, weights_tangent, weights_adjoint = sums.weights, sums.weights_tangent, sums.weights_adjoint
    LANES = discretisation.lanes
    lane = lane_functions(discretisation.precision, LANES).lane

    @wp.kernel(module=discretisation.module(True, topic))
    def density(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        # out
        n: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        total = weights(i, x, s)
        if lane() > 0:
            return
        n[i] = s.volume * (real(1 - s.filling[i]) * s.self_weight + total)

    @wp.kernel(module=discretisation.tangent_module(topic), enable_backward=False)
    def density_tangent(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        # out
        n_dot: wp.array(dtype=real),
    ):
        i = s.first + wp.tid() // LANES
        total = weights_tangent(i, x, x_dot, s)
        if lane() > 0:
            return
        n_dot[i] = s.volume * total

    @wp.kernel(module=discretisation.module(False, topic), enable_backward=False)
    def density_adjoint(
        s: neighbourhood,
        x: wp.array(dtype=vector),
        n_bar: wp.array(dtype=real),
        # in and out
        x_bar: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid() // LANES
        total = weights_adjoint(i, x, n_bar, s)
        if lane() > 0:
            return
        x_bar[i] = x_bar[i] + s.volume * total

    return Kernels(density, density_tangent, density_adjoint)
