"""PCISPH as a `Solver`: its steps, forward, and their derivatives."""

from typing import Self

from cortado.particles.state import Parameters
from cortado.solvers.pcisph.derivatives import PcisphAdjoint, PcisphTangent
from cortado.solvers.pcisph.steps import PcisphSteps
from cortado.solvers.solver import StepAdjoint, StepTangent


class Pcisph(PcisphSteps):
    """Predictive-corrective incompressible SPH; see `Solver`."""

    def differentiable(self) -> Self:
        """The same solver over the same neighbour search, with other arrays."""
        return type(self)(self.system.of_one_lane(), self.limits, requires_grad=True)

    def tangent(self, parameters_dot: Parameters) -> StepTangent:
        return PcisphTangent(self, parameters_dot)

    def adjoint(self, steps: int) -> StepAdjoint:
        return PcisphAdjoint(self, steps)
