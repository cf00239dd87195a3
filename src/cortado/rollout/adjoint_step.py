"""Backward steps of a rollout by the solver's own adjoint."""

from cortado.particles.state import Parameters, State
from cortado.rollout.rollout import Rollout
from cortado.solvers.solver import Counts, ResumingAdjoint, StepAdjoint


class AdjointStep:
    """A `BackwardStep`: the step is taken once more, and the adjoint goes through it in reverse."""

    capturable = True

    def __init__(self, rollout: Rollout, adjoint: StepAdjoint):
        self.rollout, self.solver, self._parameters = rollout, rollout.solver, rollout.parameters
        self._adjoint = adjoint

    def begin(self) -> None:
        self._adjoint.begin()

    def step(self, state: State, counts: Counts, bar: State) -> None:
        self.solver.reserve(counts)
        self.solver.replay(state, self._parameters, counts)
        self._adjoint.step(counts, bar, self._parameters)

    def parameters(self) -> Parameters:
        return self._adjoint.collect()


class ResumingStep(AdjointStep):
    """The same, where the step is taken once more from what is known of its result."""

    def __init__(self, rollout: Rollout, adjoint: ResumingAdjoint):
        super().__init__(rollout, adjoint)
        self._resuming = adjoint

    def begin(self) -> None:
        super().begin()
        self._resuming.arrive(self.rollout.last_state())

    def step(self, state: State, counts: Counts, bar: State) -> None:
        self._resuming.replay(state, self._parameters, counts)
        self._resuming.step(counts, bar, self._parameters)
