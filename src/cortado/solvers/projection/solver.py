"""The velocity projection as a `Solver`: its steps, forward, and their derivatives."""

from cortado.errors import MissingDerivativeError
from cortado.particles.state import Parameters
from cortado.solvers.projection.derivatives import ProjectionAdjoint, ProjectionTangent
from cortado.solvers.projection.fixed_point import FixedPointAdjoint
from cortado.solvers.projection.steps import ProjectionSteps
from cortado.solvers.solver import ResumingAdjoint, StepAdjoint, StepTangent


class Projection(ProjectionSteps):
    """Incompressible SPH by a projection that pushes and pulls; see `Solver`."""

    def tangent(self, parameters_dot: Parameters) -> StepTangent:
        return ProjectionTangent(self, parameters_dot)

    def adjoint(self, steps: int) -> StepAdjoint:
        return ProjectionAdjoint(self, steps)

    def implicit_adjoint(self, steps: int, tolerance: float, iterations: int) -> ResumingAdjoint:
        if self.bodies is not None:
            raise MissingDerivativeError("bodies that are free have no implicit adjoint: try gradients.Exact.")
        return FixedPointAdjoint(self, steps, tolerance, iterations)
