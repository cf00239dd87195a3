"""PCISPH as a `Solver`: its steps, forward, and their derivatives."""

from typing import Self

from cortado.particles.state import Parameters
from cortado.solvers.pcisph.derivatives import FrozenPcisphAdjoint, PcisphAdjoint, PcisphTangent
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

    def frozen_adjoint(self, steps: int) -> StepAdjoint:
        """Not of a solver that is made of this one and has an adjoint of its own."""
        if type(self).adjoint is not Pcisph.adjoint:
            return super().frozen_adjoint(steps)
        return FrozenPcisphAdjoint(self, steps)
