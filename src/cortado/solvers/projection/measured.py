"""What the projection measures of a particle's neighbours, n among it, with its derivatives: see
`cortado.solvers.projection.surroundings`."""

from functools import partial

import warp as wp

from cortado.particles.neighbourhood import Discretisation
from cortado.particles.state import Layout
from cortado.solvers.density import Density, DensityAdjoint, DensityTangent
from cortado.solvers.projection.beside import beside_solid_kernel
from cortado.solvers.projection.constants import ProjectionConstants
from cortado.solvers.projection.sums import APART
from cortado.solvers.projection.surroundings import bar_entries, entries, surrounding_kernels
from cortado.sph.moment_functions import symmetric
from cortado.sph.parts import Adjoints, StepContext, Tangents


class Surroundings(Density):
    """Writes n and all of ``around``."""

    def __init__(
        self, discretisation: Discretisation, layout: Layout, topic: str, dimension: int, constants: ProjectionConstants
    ):
        super().__init__(discretisation, topic, surrounding_kernels(discretisation, dimension))
        self.layout = layout
        self.around = layout.arrays(**entries(layout.precision))
        per_nearest, per_apart = 1.0 / constants.nearest_weight, (APART * constants.spacing) ** -2
        self.constants = {"least": constants.least_diagonal, "per_nearest": per_nearest, "per_apart": per_apart}
        """As kernels call them."""
        self.surfaced = wp.zeros(layout.members, dtype=wp.int32, device=layout.device)
        """Whether scenes have a free surface: a particle without a share of the coarse pressure."""

    def measure(self, context: StepContext) -> None:
        self.surfaced.zero_()
        context.launch(self.kernels.forward, self.around, self.constants, surfaced=self.surfaced)

    def new_tangent(self) -> "SurroundingsTangent":
        return SurroundingsTangent(self)

    def new_adjoint(self) -> "SurroundingsAdjoint":
        return SurroundingsAdjoint(self)


class SurroundingsTangent(DensityTangent):
    """Forward mode."""

    _density: Surroundings

    def __init__(self, surroundings: Surroundings):
        super().__init__(surroundings)
        self.around = surroundings.layout.arrays("_dot", **entries(surroundings.layout.precision))

    def measure(self, context: StepContext, dot: Tangents) -> None:
        own = self._density
        context.launch(own.kernels.tangent, *dot.named, self.around, own.around, own.constants)


class SurroundingsAdjoint(DensityAdjoint):
    """Reverse mode."""

    _density: Surroundings

    def __init__(self, surroundings: Surroundings):
        super().__init__(surroundings)
        precision = surroundings.layout.precision
        self.around = surroundings.layout.arrays("_bar", **bar_entries(precision))
        six = symmetric(precision).kind
        self._moments = surroundings.layout.arrays("_pull", M=six, Q=six)

    def begin(self) -> None:
        for array in self.around.values():
            array.zero_()

    def measure(self, context: StepContext, bar: Adjoints) -> None:
        """From the adjoints of n and of all around to those of positions, masses and solids."""
        own, known = self._density, (*bar.named, self.around, self._density.around)
        for kernel in own.kernels.adjoint:
            context.launch(kernel, *known, self._moments, own.constants)
        bar.solids.add(context.launch, partial(beside_solid_kernel, own.discretisation), *known)
