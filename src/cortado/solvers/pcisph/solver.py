"""PCISPH as a `Solver`: its steps, forward, and their derivatives."""

from cortado.device.memory import gradient_parts
from cortado.device.state import Parameters
from cortado.solvers.pcisph.derivatives import PcisphAdjoint, PcisphTangent
from cortado.solvers.pcisph.log import IterationLog
from cortado.solvers.pcisph.steps import PcisphSteps


class Pcisph(PcisphSteps):
    """Predictive-corrective incompressible SPH; see `Solver`."""

    def differentiable(self) -> "Pcisph":
        """The same solver over the same neighbour search, with other arrays."""
        return Pcisph(
            self.discretisation,
            self.lattice,
            self.search,
            self.forces,
            self.pressure,
            self.periods,
            self.mixture.phases,
            self.emitter.nozzle if self.emitter else None,
            self.containment.walled,
            requires_grad=True,
        )

    def match(self, other: "Pcisph") -> None:
        self.resize(other.search.capacity)
        self.set_substeps(other.mixture.substeps)

    def tangent(self, parameters_dot: Parameters) -> PcisphTangent:
        return PcisphTangent(self, parameters_dot)

    def adjoint(self, steps: int, frozen_geometry: bool = False) -> PcisphAdjoint:
        return PcisphAdjoint(self, steps, frozen_geometry)

    def gradient_memory(self, log: IterationLog) -> dict[str, float]:
        iterations = int(log.diagnostics["iterations"].max(initial=0))
        return gradient_parts(self.particles, iterations, self.discretisation.precision.bytes)
