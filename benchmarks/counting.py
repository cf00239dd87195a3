"""What estimates and searches cost, in steps of one scene."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from cortado.gradients import AdjointEstimator, Estimate, ForwardPass
from cortado.rollout.rollout import BackwardStep, Observer
from cortado.scene.parameter_values import Arrays, Values

BACKWARD = 3
"""Forward steps that a step back counts as: it computes the step once more, and has twice its neighbour sums."""


@dataclass
class Steps:
    """Counts simulated steps."""

    forward: int = 0
    backward: int = 0

    @property
    def cost(self) -> int:
        """In forward steps."""
        return self.forward + BACKWARD * self.backward


class Counted:
    """A problem whose steps are counted, those of each scene of a batch by themselves."""

    def __init__(self, problem: Any, horizon: int, steps: Steps, scenes: int = 1):
        self._problem, self._each, self._steps = problem, horizon * scenes, steps
        self._horizon, self.simulation = horizon, problem.simulation

    def value(self, parameters: Values) -> Any:
        """The loss, forward only."""
        self._steps.forward += self._each
        return self._problem.value(parameters)

    def forward_pass(self, parameters: Values) -> "CountedPass":
        """A forward run that reverse passes may follow."""
        self._steps.forward += self._each
        return CountedPass(self._problem.forward_pass(parameters), self._each, self._steps)

    def room(self, estimator: AdjointEstimator | None = None) -> int:
        """See `Batchable.room`."""
        return self._problem.room(estimator)

    def together(self, points: Sequence[Values], estimator: AdjointEstimator | None = None) -> Any:
        """See `Batchable.together`."""
        if estimator is None:
            self._steps.forward += self._horizon * len(points)
            return self._problem.together(points)
        return self._problem.together(points, _Counting(estimator, self._horizon, self._steps, len(points)))


class CountedPass:
    """A forward run whose reverse passes are counted."""

    def __init__(self, forward_pass: ForwardPass, each: int, steps: Steps):
        self._pass, self._each, self._steps = forward_pass, each, steps
        self.loss = forward_pass.loss

    def back(self, estimator: AdjointEstimator, observe: Observer | None = None) -> Arrays:
        """The gradient."""
        self._steps.backward += self._each
        return self._pass.back(estimator, observe)


class _Counting(AdjointEstimator):
    """An estimator that is given batches whose steps are counted."""

    def __init__(self, estimator: AdjointEstimator, horizon: int, steps: Steps, scenes: int):
        self._estimator, self._counted = estimator, (horizon, steps, scenes)

    @property
    def batches(self) -> bool:
        return self._estimator.batches

    def derivative(self, rollout: Any) -> BackwardStep:
        return self._estimator.derivative(rollout)

    def estimate(self, problem: Any, parameters: Values, observe: Observer | None = None) -> Estimate:
        return self._estimator.estimate(Counted(problem, *self._counted), parameters, observe)
