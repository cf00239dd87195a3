"""An estimator that differentiates the pressure of a step by the implicit function theorem."""

from dataclasses import dataclass

from cortado.arrays import is_whole
from cortado.errors import InputError, shown
from cortado.gradients.estimator import AdjointEstimator
from cortado.rollout.adjoint_step import ResumingStep
from cortado.rollout.rollout import BackwardStep, Rollout
from cortado.scene.fields import as_number


@dataclass(frozen=True)
class ImplicitPressure(AdjointEstimator):
    """The adjoint of the projection with its pressure as a fixed point, instead of iteration by iteration.

    Formula: an iteration k' = Phi(k, u) of the pressure k from the inputs u, velocities and positions, has the fixed
    point k = Phi(k, u), and so the adjoint u^ = Phi_u^T l with (1 - Phi_k^T) l = k^, which conjugate gradients solve.

    Bias: none at the fixed point. After a few iterations the pressure is not there yet, and the gradient is that of a
    fluid with the same pressure that would be. The first guess of a step, the pressure of the last, has no adjoint. The
    gradient with respect to the rest density of a single phase, which the pressure cancels, is of no use then.
    Cost: it does not depend on the iterations of the solver, neither the memory nor the work.

    Only for scenes with the solver ``"projection"``. Source: implicit differentiation of fixed points (Christianson
    1994, Optimization Methods and Software 3).
    """

    tolerance: float = 0.1
    """The solve ends where its residual has fallen to this part of the first, in the norm of its diagonal; at least 0,
    where `iterations` are done in any case."""
    iterations: int = 100
    """At most, for each step."""

    batches = True

    def __post_init__(self) -> None:
        tolerance = as_number(self.tolerance)
        if tolerance is None or not 0.0 <= tolerance < 1.0:
            raise InputError(f"tolerance is {shown(self.tolerance)}, but must be a number from 0 to below 1.")
        if not is_whole(self.iterations) or self.iterations < 1:
            raise InputError(f"iterations is {shown(self.iterations)}, but must be a whole number of at least 1.")

    def derivative(self, rollout: Rollout) -> BackwardStep:
        own = rollout.steps, float(self.tolerance), int(self.iterations)
        return ResumingStep(rollout, rollout.solver.implicit_adjoint(*own))
