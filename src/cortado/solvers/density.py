"""The number density as a solver of particles measures it, with its derivatives.

A solver that measures more of the same neighbours at once has a subclass of its own.
"""

from functools import partial

from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation
from cortado.sph.density import density_kernels, density_solid_kernel
from cortado.sph.parts import Adjoints, StepContext, Tangents


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
