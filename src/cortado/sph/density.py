"""Density by summation over fluid and wall particles (Solenthaler and Pajarola 2008).

`docs/discretisation.md` has the equation of the number density. The density is the number density times the mass of the
particle divided by its rest volume. Masses of neighbours do not enter the sum, so that the density of a heavy fluid
does not smear into a light fluid. The pressure of a particle pushes walls in the direction of the sum of the walls'
kernel gradients.
"""

from functools import cache, cached_property, partial
from types import SimpleNamespace
from typing import Any, Protocol

import warp as wp

from cortado.device.launching import Named
from cortado.device.modules import Kernels, by_name
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions
from cortado.particles.pair_sums import adjoint_of, pair_sum, tangent_of, wall_sum
from cortado.particles.particle_kernels import over, particle_kernel, sum_kernel
from cortado.particles.state import Layout
from cortado.particles.wall_terms import WallTerm, solid_kernel
from cortado.sph.parts import Adjoints, StepContext, Tangents


@cache
def density_sums(discretisation: Discretisation) -> Kernels:
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
    return solid_kernel(discretisation, topic, _density_work, looped=looped)


def _density_work(d: Discretisation) -> Any:
    real, vector, weight = d.precision.real, d.precision.vector, pair_functions(d).weight

    def density_work(x_ij: vector, bar_i: real, s: neighbourhood_type(d.precision)) -> real:
        return s.volume * weight(x_ij, s) * bar_i

    return density_work


@cache
def density_kernels(discretisation: Discretisation, topic: str = "density") -> Kernels:
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


class DensityTangent:
    def __init__(self, density: "Density"):
        self._density: Any = density

    def measure(self, context: StepContext, dot: Tangents) -> None:
        context.launch(self._density.kernels.tangent, *dot.named)


class DensityAdjoint:
    def __init__(self, density: "Density"):
        self._density: Any = density

    def begin(self) -> None:
        """Set the adjoints to 0."""

    def measure(self, context: StepContext, bar: Adjoints) -> None:
        density = self._density
        context.launch(density.kernels.adjoint, *bar.named)
        kernel = partial(density_solid_kernel, density.discretisation, density.topic)
        bar.solids.add(context.launch, kernel, *bar.named, bar=bar.fields["n"])


class Density:
    derivatives: tuple[type[DensityTangent], type[DensityAdjoint]] = DensityTangent, DensityAdjoint

    def __init__(self, discretisation: Discretisation, topic: str, kernels: Kernels | None = None):
        self.discretisation, self.topic = discretisation, topic
        self.kernels = kernels or density_kernels(discretisation, topic)

    def measure(self, context: StepContext) -> None:
        context.launch(self.kernels.forward)

    def new_tangent(self) -> Any:
        return self.derivatives[0](self)

    def new_adjoint(self) -> Any:
        return self.derivatives[1](self)


@cache
def wall_slope_sums(discretisation: Discretisation) -> SimpleNamespace:
    _, vector, neighbourhood = discretisation.types
    pair = pair_functions(discretisation)
    gradient, hessian_product = pair.gradient, pair.hessian_product

    @wall_sum(discretisation)
    def slope(x_ij: vector, s: neighbourhood) -> vector:
        return gradient(x_ij, s)

    @wall_sum(discretisation)
    def change(x_ij: vector, along: vector, s: neighbourhood) -> vector:
        return hessian_product(x_ij, along, s)

    @wall_sum(discretisation, grows=slope)
    def tangent(x_ij: vector, x_dot_ij: vector, s: neighbourhood) -> vector:
        return hessian_product(x_ij, x_dot_ij, s)

    return by_name(slope, change, tangent)


def wall_slope_term(discretisation: Discretisation) -> WallTerm:
    return WallTerm(discretisation, "wall_slope", _work, "slope_bar")


def _work(d: Discretisation) -> Any:
    real, vector, gradient = d.precision.real, d.precision.vector, pair_functions(d).gradient

    def wall_slope_work(x_ij: vector, slope_bar_i: vector, s: neighbourhood_type(d.precision)) -> real:
        return wp.dot(gradient(x_ij, s), slope_bar_i)

    return wall_slope_work


class WallAction(Protocol):
    """Protocol of the action of walls on particles by one force. Loads on solids read the action of walls after a step.
    ``solid`` is the number of a solid, or `cortado.particles.wall_terms.ALL_WALLS`."""

    def total(self, step: StepContext, solid: int) -> wp.array:
        """Return an array (n,) of one vector for each sorted particle. A force's vectors are accelerations [m/s2]."""

    def tangent(self, step: StepContext, dot: Tangents, solid: int) -> wp.array:
        """Return an array of shape (n,) with the tangents of the action of walls. Complete forward mode of the step
        first."""

    def adjoint(self, step: StepContext, bar: Adjoints, solid: int, total_bar: wp.array, v_star_bar: wp.array) -> None:
        """Convert the adjoint ``total_bar`` of the action to adjoints of sorted particles, parameters and solids in
        ``bar``. Add to ``v_star_bar`` (n,), the adjoint of the velocities after all explicit forces."""


class WallSums:
    """A `WallAction` that sums a `WallTerm`. Each call of a method overwrites the array from the previous call."""

    def __init__(self, term: WallTerm, layout: Layout, constants: tuple[float, float] = (0.0, 0.0)):
        self.term, self._layout, self._constants = term, layout, constants

    @cached_property
    def _arrays(self) -> dict[str, wp.array]:
        vector = self._layout.precision.vector
        return self._layout.arrays(total=vector, total_dot=vector)

    def _known(self, solid: int) -> Named:
        return {"solid": solid, "constants": self._layout.precision.pair(*self._constants)}

    def total(self, step: StepContext, solid: int, *groups: Named) -> wp.array:
        found = self._arrays["total"]
        step.launch(self.term.kernels.forward, *groups, self._known(solid), total=found)
        return found

    def tangent(self, step: StepContext, dot: Tangents, solid: int, *groups: Named) -> wp.array:
        found = self._arrays["total_dot"]
        step.launch(self.term.kernels.tangent, *groups, *dot.named, self._known(solid), total_dot=found)
        return found

    def adjoint(
        self, step: StepContext, bar: Adjoints, solid: int, total_bar: wp.array, v_star_bar: wp.array, *groups: Named
    ) -> None:
        known = {self.term.bar: total_bar}, *groups, *bar.named
        step.launch(self.term.kernels.adjoint, *known, self._known(solid))
        bar.solids.add(step.launch, self.term.solid_kernel, *known, constants=self._constants, over=solid)
