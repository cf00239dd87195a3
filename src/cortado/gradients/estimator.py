"""Protocols and results of gradient estimators, and the evaluation of a problem at many points."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, islice
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from cortado.arrays import as_numbers, as_one_number, require_methods
from cortado.calls import counted, sized
from cortado.errors import DivergedError, InputError, OutOfRangeError, shown
from cortado.executors import Executor, OnResult
from cortado.particles.state import Parameters, State
from cortado.rollout.rollout import BackwardStep, Observer, Rollout
from cortado.scene.parameter_values import Arrays, Values
from cortado.solvers.solver import Counts


@dataclass(frozen=True)
class Estimate:
    """A loss and its gradient, with standard errors if the gradient is an average."""

    loss: Any
    """Loss, as a float, or as an array (batch,) for a batch."""
    gradient: Arrays
    standard_error: Arrays | None = None
    """Standard error of each component of the gradient, or None if the gradient is not an average over samples."""
    degrees_of_freedom: float | None = None
    """Number of independent samples minus one. For `Guided`, the degrees of freedom combine two errors."""
    mean_loss: float | None = None
    """Mean of the loss over the ensemble."""
    left_out: int = 0
    """Number of runs missing from the average, because the run or its antithetic partner failed."""
    diverged: Exception | None = None
    """Error of a point that failed in `cortado.evaluate`. The loss and the gradient of a failed point are NaN."""

    def interval(self, confidence: float = 0.95) -> tuple[Arrays, Arrays]:
        """Return the lower and the upper ends of confidence intervals for the gradient, by parameter name.

        With the probability ``confidence`` the interval contains the estimator's mean over infinitely many samples, by
        Student's t-distribution. The interval does not include the estimator's bias.

        Raises:
            InputError: the estimate is not an average, or the confidence is not between 0 and 1.
        """
        if self.standard_error is None or self.degrees_of_freedom is None:
            raise InputError("The estimate has no confidence interval, as the estimate is not an average over samples.")
        if not 0.0 < as_one_number("confidence", confidence) < 1.0:
            raise InputError(f"confidence is {confidence}, but must be between 0 and 1.")
        from scipy.stats import t as student

        reach = float(student.ppf(0.5 + 0.5 * confidence, self.degrees_of_freedom))
        errors = self.standard_error
        lower = {name: value - reach * errors[name] for name, value in self.gradient.items()}
        return lower, {name: value + reach * errors[name] for name, value in self.gradient.items()}

    def member(self, number: int, shapes: Mapping[str, tuple[int, ...]]) -> "Estimate":
        """Return the estimate of scene ``number`` of a batch, with gradients of the given shapes."""
        gradient = {name: bar[number].reshape(shapes[name]) for name, bar in self.gradient.items()}
        return replace(self, loss=float(self.loss[number]), gradient=gradient)

    def __repr__(self) -> str:
        error = "" if self.standard_error is None else ", with its standard error"
        loss = f"losses {self.loss.shape}" if np.ndim(self.loss) else f"loss {self.loss:.6g}"
        out = f", {counted(self.left_out, 'run')} left out" if self.left_out else ""
        return f"Estimate({loss}, gradient of {sized(self.gradient)}{error}{out})"


class ForwardPass(Protocol):
    """Protocol of a forward run and its loss. Backward passes can start from the run until the problem is run again."""

    @property
    def loss(self) -> float:
        """Loss of the run."""

    def back(self, estimator: "AdjointEstimator", observe: Observer | None = None) -> Arrays:
        """Return the gradient by an estimator. ``observe`` is called with the number and the adjoint of each state,
        from the last state to the first."""


class Differentiable(Protocol):
    """Protocol of the problems that estimators can differentiate."""

    simulation: Any

    def value(self, parameters: Values) -> float:
        """Return the loss for given parameters."""

    def forward_pass(self, parameters: Values) -> ForwardPass:
        """Run forward, and return the run for backward passes."""


@runtime_checkable
class Batchable(Protocol):
    """Protocol of a problem that can be evaluated at many points together."""

    def room(self, estimator: "AdjointEstimator | None" = None) -> int:
        """Return the greatest number of points for `together`. Without an estimator only losses are computed."""

    def together(
        self, points: Sequence[Values], estimator: "AdjointEstimator | None" = None
    ) -> list[Estimate | DivergedError]:
        """Return estimates at points with equal parameter names and shapes. Each estimate has the same bits as the
        estimate from a separate run. A point with a lost particle has its error as the result."""


class GradientEstimator(Protocol):
    """Protocol of an object that computes a gradient, exactly or approximately."""

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """Return the loss and its gradient. ``observe`` is called with the number and the adjoint of each state."""


def checked_estimator(estimator: GradientEstimator) -> GradientEstimator:
    require_methods("estimator", estimator, ("estimate",), "an object such as cortado.gradients.Exact()")
    return estimator


def checked_reverse(estimator: "AdjointEstimator") -> "AdjointEstimator":
    if not isinstance(estimator, AdjointEstimator):
        wanted = "an AdjointEstimator such as cortado.gradients.Exact()"
        raise InputError(f"estimator is {shown(estimator)}, but must be {wanted}.")
    return estimator


def checked_estimate(found: Any, parameters: Values, batch: int | None = None) -> Estimate:
    """Return an estimate in float64. A gradient of a batch has a first axis for the scenes."""
    if not isinstance(found, Estimate):
        raise InputError(f"the estimator returned a {type(found).__name__}, but must return a gradients.Estimate.")
    loss = as_one_number("the estimate's loss", found.loss) if batch is None else as_numbers("losses", found.loss)
    gradient = {}
    for name, given in parameters.items():
        if name not in found.gradient:
            raise InputError(f"the estimate has no gradient with respect to {name}, but must have one.")
        what = f"the estimate's gradient with respect to {name}"
        gradient[name] = as_numbers(what, found.gradient[name])
        wanted = np.shape(given) if batch is None else (batch, *gradient[name].shape[1:])
        if gradient[name].shape != wanted:
            raise InputError(f"{what} has shape {gradient[name].shape}, but must have the parameter's shape {wanted}.")
    return replace(found, loss=loss, gradient=gradient)


class AdjointEstimator(ABC):
    """A base class of estimators with one backward pass through a rollout."""

    @property
    def batches(self) -> bool:
        """True if the estimator never mixes the scenes of a batch. A subclass of estimators may override `batches`."""
        return False

    @abstractmethod
    def derivative(self, rollout: Rollout) -> BackwardStep:
        """Return the backward step for a rollout."""

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """Return the loss and its gradient by a forward and a backward pass. See `GradientEstimator`."""
        forward_pass = problem.forward_pass(parameters)
        return Estimate(forward_pass.loss, self.back(forward_pass, observe))

    def back(self, forward_pass: ForwardPass, observe: Observer | None = None) -> Arrays:
        """Return the gradient of a forward run's loss. See `ForwardPass.back`."""
        return forward_pass.back(self, observe)


class Filtered:
    """A backward step that filters the adjoint after the backward step of a given estimator."""

    only_launches: ClassVar[bool] = False
    """True if `filter` only ever launches the same kernels, so that a CUDA graph can capture the backward step."""

    def __init__(self, base: BackwardStep):
        self._base, self.rollout, self.solver = base, base.rollout, base.solver
        self.capturable = base.capturable and self.only_launches

    def begin(self) -> None:
        self._base.begin()

    def step(self, state: State, counts: Counts, bar: State) -> None:
        self._base.step(state, counts, bar)
        self.filter(bar)

    def parameters(self) -> Parameters:
        return self._base.parameters()

    def filter(self, bar: State) -> None:
        """Change the adjoint of the state after a backward step."""
        raise NotImplementedError


NO_RUN: tuple[type[Exception], ...] = (DivergedError, OutOfRangeError)
"""Errors of a point that has no result. The remaining points of a group are still evaluated."""


@dataclass(frozen=True)
class Point:
    """Parameter values and a gradient estimator."""

    values: Values
    estimator: GradientEstimator | None = None
    """Gradient estimator, or None to compute only the loss."""
    loss_if_diverged: float = np.nan
    errors: tuple[type[Exception], ...] = ()
    """Types of errors that are replaced by a substitute loss."""
    is_sample: bool = False
    """True for a sample of an ensemble, whose estimate is not checked."""

    def evaluated(self, problem: Differentiable, observe: Observer | None = None) -> Estimate:
        """Return the loss and the gradient. Without an estimator the gradient is empty."""
        try:
            if self.estimator is None:
                return Estimate(problem.value(self.values), {})
            found = self.estimator.estimate(problem, self.values, observe)
            return found if self.is_sample else checked_estimate(found, self.values, problem.simulation.batch)
        except self.errors as error:
            return self.without_a_run(error)
        except InputError as error:
            if self.is_sample:
                raise InputError(f"A sample of the ensemble is invalid: {error}") from error
            raise

    def without_a_run(self, why: Exception) -> Estimate:
        names = self.values if self.estimator is not None else ()
        gradient = {name: np.full(np.shape(self.values[name]), np.nan) for name in names}
        return Estimate(self.loss_if_diverged, gradient, diverged=why)


Group = tuple[Point, ...]


@dataclass(frozen=True)
class Evaluation:
    """A function that evaluates groups of points. Groups raise the same error messages as single points."""

    problem: Differentiable
    observe: Observer | None = None

    def __call__(self, group: Group) -> list[Estimate]:
        if len(group) == 1 or self.observe is not None or not isinstance(self.problem, Batchable):
            return [point.evaluated(self.problem, self.observe) for point in group]
        estimator = group[0].estimator
        assert isinstance(estimator, AdjointEstimator | None)
        try:
            found = self.problem.together([point.values for point in group], estimator)
        except InputError:
            return [point.evaluated(self.problem) for point in group]
        each = zip(found, group, strict=True)
        return [point.evaluated(self.problem) if isinstance(one, DivergedError) else one for one, point in each]


def evaluated(
    problem: Differentiable,
    points: Iterable[Point],
    executor: Executor,
    observe: Observer | None = None,
    on_result: OnResult | None = None,
) -> list[Estimate]:
    """Return estimates at points, in order. One launch evaluates many points."""
    firsts = [0]

    def kind(point: Point) -> tuple[Any, ...]:
        return point.estimator, {name: np.shape(value) for name, value in point.values.items()}

    def groups() -> Iterator[Group]:  # for one launch, small enough to keep all worker threads busy
        for (estimator, _), alike in groupby(points, kind):
            room = 1
            if isinstance(problem, Batchable) and isinstance(estimator, AdjointEstimator | None):
                room = problem.room(estimator)
            while group := tuple(islice(alike, max(room // max(executor.threads(), 1), 1))):
                firsts.append(firsts[-1] + len(group))
                yield group

    def tell(number: int, group: list[Estimate]) -> None:
        if on_result is not None:
            for k, one in enumerate(group):
                on_result(firsts[number] + k, one)

    return [one for group in executor.map(Evaluation(problem, observe), groups(), tell) for one in group]


def without_runs(errors: Sequence[Exception], of: str) -> str:
    """Return a phrase with the number and the cause of failures, such as "2 of 4 points diverged"."""
    diverged = sum(isinstance(error, DivergedError) for error in errors)
    why = ["diverged"] * bool(diverged) + ["cannot be run"] * (diverged < len(errors))
    return f"{len(errors)} of {of} {' or '.join(why)}"
