"""Density by summation, wall particles of calibrated weights included, as a number density:

n_i = V (W(0) + sum_j W_ij + sum_b w_b W_ib),   rho_i = m_i n_i.

V is the rest volume on the lattice and m_i a particle's mass over V. No mass of a neighbour enters (Solenthaler and
Pajarola 2008): the density of a heavy fluid is not smeared into a light one.

`Density` measures it in a step, with derivatives; a solver that measures more of the same neighbours at once has a
subclass of its own.
"""

from functools import cache, partial
from typing import Any

import warp as wp

from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import adjoint_of, pair_sum, tangent_of
from cortado.particles.particle_kernels import over, particle_kernel, sum_kernel
from cortado.particles.wall_terms import solid_kernel
from cortado.sph.parts import Adjoints, StepContext, Tangents


@cache
def density_sums(discretisation: Discretisation) -> Kernels:
    """Make the Warp functions of the raw neighbour sums of the density: the sum of W, with what fills the list up, and
    its derivatives. The adjoint is that of positions for an adjoint r of every particle's sum, sum_j (r_i + r_j) G_ij +
    sum_b w_b r_i G_ib."""
    real, vector, neighbourhood = discretisation.types
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

    return Kernels(weights, weights_tangent, weights_adjoint)


@cache
def density_solid_kernel(discretisation: Discretisation, topic: str = "density", looped: bool = False) -> Any:
    """Make the kernel from the adjoint ``bar`` of number densities to those of solids (`SolidShares.add`)."""
    return solid_kernel(discretisation, topic, _density_work, looped=looped)


def _density_work(d: Discretisation) -> Any:
    real, vector, weight = d.precision.real, d.precision.vector, pair_functions(d).weight

    def density_work(x_ij: vector, bar_i: real, s: neighbourhood_type(d.precision)) -> real:
        return s.volume * weight(x_ij, s) * bar_i

    return density_work


@cache
def density_kernels(discretisation: Discretisation, topic: str = "density") -> Kernels:
    """Make kernels ``forward``, ``tangent`` and ``adjoint`` of the number density, in the Warp modules of a topic; a
    topic that a solver has anyway saves it a module to load."""
    real, neighbourhood = discretisation.precision.real, neighbourhood_type(discretisation.precision)
    module, tangent_module, adjoint_module = discretisation.modules(topic)
    sums = density_sums(discretisation)

    @particle_kernel(module, "n", [over(sums.forward, "total")])
    def density(i: int, total: real, s: neighbourhood) -> real:
        return s.volume * (real(1 - s.filling[i]) * s.self_weight + total)

    return Kernels(
        density,
        sum_kernel("density_tangent", tangent_module, "n_dot", sums.tangent, times="s.volume"),
        sum_kernel("density_adjoint", adjoint_module, "+x_bar", sums.adjoint, times="s.volume", r="n_bar"),
    )


class Density:
    """The measurement of the number density n of particles, once their neighbours are listed."""

    def __init__(self, discretisation: Discretisation, topic: str, kernels: Kernels | None = None):
        """Take given ``kernels``, or make those of the density alone, in the Warp modules of a topic."""
        self.discretisation, self.topic = discretisation, topic
        self.kernels = kernels or density_kernels(discretisation, topic)

    def measure(self, context: StepContext) -> None:
        context.launch(self.kernels.forward)

    def new_tangent(self) -> "DensityTangent":
        return DensityTangent(self)

    def new_adjoint(self) -> "DensityAdjoint":
        return DensityAdjoint(self)


class DensityTangent:
    """The tangent of the measured number density, for forward mode."""

    def __init__(self, density: Density):
        self._density = density

    def measure(self, context: StepContext, dot: Tangents) -> None:
        context.launch(self._density.kernels.tangent, *dot.named)


class DensityAdjoint:
    """The adjoint of the measured number density, for reverse mode."""

    def __init__(self, density: Density):
        self._density = density

    def begin(self) -> None:
        """Forget the adjoints that an earlier step back has left."""

    def measure(self, context: StepContext, bar: Adjoints) -> None:
        """Turn the adjoint of the number density n into those of positions and of solids."""
        density = self._density
        context.launch(density.kernels.adjoint, *bar.named)
        kernel = partial(density_solid_kernel, density.discretisation, density.topic)
        bar.solids.add(context.launch, kernel, *bar.named, bar=bar.fields["n"])
