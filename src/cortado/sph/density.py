"""Density by summation, wall particles of calibrated weights included, as a number density:

n_i = V (W(0) + sum_j W_ij + sum_b w_b W_ib),   rho_i = m_i n_i.

V is the rest volume on the lattice and m_i a particle's mass over V. No mass of a neighbour enters (Solenthaler and
Pajarola 2008): the density of a heavy fluid is not smeared into a light one.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.lanes import lane_functions
from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import adjoint_of, pair_sum, tangent_of
from cortado.particles.solid_shares import solid_kernel


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
    weight, slope, gradient = pair.weight, pair.slope, pair.gradient

    @pair_sum(discretisation)
    def weights(x_ij: vector, s: neighbourhood) -> real:
        return weight(x_ij, s)

    @tangent_of(weights)
    @pair_sum(discretisation, ahead=False, grows=weights)
    def weights_tangent(x_ij: vector, x_dot_ij: vector, s: neighbourhood) -> real:
        return wp.dot(gradient(x_ij, s), x_dot_ij)

    @adjoint_of(weights)
    @pair_sum(discretisation)
    def weights_adjoint(x_ij: vector, r_i: real, r_j: real, s: neighbourhood) -> vector:
        return ((r_i + r_j) * slope(x_ij, s)) * x_ij

    return DensitySums(weights=weights, weights_tangent=weights_tangent, weights_adjoint=weights_adjoint)


@cache
def density_solid_kernel(discretisation: Discretisation, topic: str = "density", looped: bool = False) -> Any:
    """The kernel of what the number density gives to solids, for its adjoints ``bar`` (`SolidShares.add`)."""
    return solid_kernel(discretisation, topic, _density_work, looped=looped)


def _density_work(d: Discretisation) -> Any:
    real, vector, weight = d.precision.real, d.precision.vector, pair_functions(d).weight

    def density_work(x_ij: vector, bar_i: real, s: neighbourhood_type(d.precision)) -> real:
        return s.volume * weight(x_ij, s) * bar_i

    return density_work


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
