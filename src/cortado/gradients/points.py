"""Points of the space of parameters at which a problem is evaluated, each on its own, wherever an executor computes."""

from dataclasses import dataclass

from cortado.errors import InputError
from cortado.gradients.estimator import Differentiable, Estimate, GradientEstimator
from cortado.parameters.values import Values
from cortado.rollout import Observer


@dataclass(frozen=True)
class Point:
    """Parameters, and how the gradient is computed there."""

    values: Values
    estimator: GradientEstimator | None = None
    """None for the loss alone."""

    def evaluated(self, problem: Differentiable, observe: Observer | None = None) -> Estimate:
        """The loss of a problem there, and its gradient, which is empty without an estimator."""
        if self.estimator is None:
            return Estimate(problem.value(self.values), {})
        return self.estimator.estimate(problem, self.values, observe)


@dataclass(frozen=True)
class Sample(Point):
    """A point that an ensemble has drawn."""

    def evaluated(self, problem: Differentiable, observe: Observer | None = None) -> Estimate:
        """See `Point.evaluated`; an `InputError` says that the user did not choose this point."""
        try:
            return super().evaluated(problem, observe)
        except InputError as error:
            advice = "Take a smaller spread, or a logarithm (cortado.optimisation.transforms)."
            raise InputError(f"A sample of the ensemble does not fit: {error} {advice}") from error


@dataclass(frozen=True)
class Evaluation:
    """A problem as a function of points, which a worker process keeps."""

    problem: Differentiable
    observe: Observer | None = None

    def __call__(self, point: Point) -> Estimate:
        return point.evaluated(self.problem, self.observe)
