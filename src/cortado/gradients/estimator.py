"""Protocols and results of gradient estimators, and the evaluation of a problem at many points."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
    """A loss and its gradient, with standard errors and other accuracy figures if the estimator has them."""

    loss: Any
    """Loss: a float, or an array (batch,) for a batch."""
    gradient: Arrays
    standard_error: Arrays | None = None
    """Standard error of each component of the gradient; None if the gradient is no average over samples."""
    degrees_of_freedom: float | None = None
    """Number of independent samples minus one; `Guided` combines two errors."""
    mean_loss: float | None = None
    """Mean of the loss over the ensemble of the gradient."""
    left_out: int = 0
    """Number of an ensemble's runs that the average leaves out, because they or their partners failed."""
    diverged: Exception | None = None
    """The `DivergedError` or `OutOfRangeError` of a point of `cortado.evaluate` without a result; loss and gradient are
    then NaN."""

    def interval(self, confidence: float = 0.95) -> tuple[Arrays, Arrays]:
        """Return the lower and the upper end, by parameter, of an interval for each component of the gradient.

        With the probability ``confidence`` the interval contains the estimator's mean over infinitely many samples, by
        Student's t-distribution. The interval does not include the estimator's bias.

        Raises:
            InputError: the estimate is no average, or the confidence is not between 0 and 1.
        """
        if self.standard_error is None or self.degrees_of_freedom is None:
            raise InputError("The estimate has no confidence interval, as it is no average over samples.")
        if not 0.0 < as_one_number("confidence", confidence) < 1.0:
            raise InputError(f"confidence is {confidence}, but must be between 0 and 1.")
        from scipy.stats import t as student

        reach = float(student.ppf(0.5 + 0.5 * confidence, self.degrees_of_freedom))
        errors = self.standard_error
        lower = {name: value - reach * errors[name] for name, value in self.gradient.items()}
        return lower, {name: value + reach * errors[name] for name, value in self.gradient.items()}

    def member(self, number: int, shapes: Mapping[str, tuple[int, ...]]) -> "Estimate":
        """Return the estimate of one scene of a batch, with gradients of the given shapes."""
        gradient = {name: bar[number].reshape(shapes[name]) for name, bar in self.gradient.items()}
        return replace(self, loss=float(self.loss[number]), gradient=gradient)

    def __repr__(self) -> str:
        error = "" if self.standard_error is None else ", with its standard error"
        loss = f"losses {self.loss.shape}" if np.ndim(self.loss) else f"loss {self.loss:.6g}"
        out = f", {counted(self.left_out, 'run')} left out" if self.left_out else ""
        return f"Estimate({loss}, gradient of {sized(self.gradient)}{error}{out})"


class ForwardPass(Protocol):
    """Protocol of a forward run with its loss; backward passes can start until the problem is run again."""

    @property
    def loss(self) -> float:
        """Loss of the run."""

    def back(self, estimator: "AdjointEstimator", observe: Observer | None = None) -> Arrays:
        """Return the gradient by an estimator; ``observe`` is called with the number and the adjoint of every state,
        last to first."""


class Differentiable(Protocol):
    """Protocol of the problems that estimators can differentiate."""

    simulation: Any

    def value(self, parameters: Values) -> float:
        """Return the loss for given parameters."""

    def forward_pass(self, parameters: Values) -> ForwardPass:
        """Run forward and return the run, from which backward passes can start."""


@runtime_checkable
class Batchable(Protocol):
    """Protocol of a problem that can be evaluated at many points in one launch."""

    def room(self, estimator: "AdjointEstimator | None" = None) -> int:
        """Return how many points one call of `together` can take, for gradients by an estimator or for losses alone."""

    def together(
        self, points: Sequence[Values], estimator: "AdjointEstimator | None" = None
    ) -> list[Estimate | DivergedError]:
        """Return estimates at points with equal parameter names and shapes, computed in one launch with the bits of
        separate runs. Without an estimator estimates have the loss alone; a point with a lost particle returns its
        error."""


class GradientEstimator(Protocol):
    """Protocol of an object that computes a gradient, exact or approximate."""

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """Return the loss and its gradient; ``observe`` is called with the adjoint of each state."""


def checked_estimator(estimator: GradientEstimator) -> GradientEstimator:
    """Return the estimator; raise `InputError` for anything else, such as the class of an estimator."""
    require_methods("estimator", estimator, ("estimate",), "an object such as cortado.gradients.Exact()")
    return estimator


def checked_reverse(estimator: "AdjointEstimator") -> "AdjointEstimator":
    """Return the estimator; raise `InputError` unless it is an `AdjointEstimator`."""
    if not isinstance(estimator, AdjointEstimator):
        wanted = "an AdjointEstimator such as cortado.gradients.Exact()"
        raise InputError(f"estimator is {shown(estimator)}, but must be {wanted}.")
    return estimator


def checked_estimate(found: Any, parameters: Values, batch: int | None = None) -> Estimate:
    """Return an estimator's result in float64; raise `InputError` unless it has a gradient of every parameter in its
    shape, for a batch with a first axis for the scenes."""
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
            raise InputError(f"{what} has shape {gradient[name].shape}, but must be {wanted}, the parameter's.")
    return replace(found, loss=loss, gradient=gradient)


class AdjointEstimator(ABC):
    """A base class of estimators that make one backward pass through one rollout, step by step."""

    @property
    def batches(self) -> bool:
        """True if the estimator never mixes scenes of a batch; override this property to allow batches."""
        return False

    @abstractmethod
    def derivative(self, rollout: Rollout) -> BackwardStep:
        """Return the backward step for one rollout."""

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """Return the loss and its gradient by a forward and a reverse pass; see `GradientEstimator`."""
        forward_pass = problem.forward_pass(parameters)
        return Estimate(forward_pass.loss, self.back(forward_pass, observe))

    def back(self, forward_pass: ForwardPass, observe: Observer | None = None) -> Arrays:
        """Return the gradient of a forward run's loss; see `ForwardPass.back`."""
        return forward_pass.back(self, observe)


class Filtered:
    """A backward step of another estimator whose adjoint is then filtered."""

    only_launches: ClassVar[bool] = False
    """True if `filter` always launches the same kernels and nothing else; only then may a CUDA graph capture the
    backward step."""

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
        """Change the adjoint of the state from which the last replayed step starts."""
        raise NotImplementedError


NO_RUN: tuple[type[Exception], ...] = (DivergedError, OutOfRangeError)
"""Errors that mean that a point has no result; other points are still evaluated."""


@dataclass(frozen=True)
class Point:
    """Parameter values, and the estimator of the gradient there."""

    values: Values
    estimator: GradientEstimator | None = None
    """None for the loss alone."""
    loss_if_diverged: float = np.nan
    errors: tuple[type[Exception], ...] = ()
    """Errors after which the point has a substitute loss."""
    is_sample: bool = False
    """True for a random point of an ensemble, whose estimate is not checked, as perturbed first positions need no
    gradient; an `InputError` says that it is a sample."""

    def evaluated(self, problem: Differentiable, observe: Observer | None = None) -> Estimate:
        """Return the loss at the point and its gradient, which is empty without an estimator."""
        try:
            if self.estimator is None:
                return Estimate(problem.value(self.values), {})
            found = self.estimator.estimate(problem, self.values, observe)
            return found if self.is_sample else checked_estimate(found, self.values, problem.simulation.batch)
        except self.errors as error:
            return self.without_a_run(error)
        except InputError as error:
            if self.is_sample:
                raise InputError(f"A sample of the ensemble does not fit: {error}") from error
            raise

    def without_a_run(self, why: Exception) -> Estimate:
        """Return the estimate of a point whose run failed, with a gradient of NaN."""
        names = self.values if self.estimator is not None else ()
        gradient = {name: np.full(np.shape(self.values[name]), np.nan) for name in names}
        return Estimate(self.loss_if_diverged, gradient, diverged=why)


Group = tuple[Point, ...]
"""Points that are evaluated together."""


@dataclass(frozen=True)
class Evaluation:
    """A problem as a function of groups of points; errors have the same sentences as for single points."""

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
        return [
            point.evaluated(self.problem) if isinstance(one, DivergedError) else one
            for one, point in zip(found, group, strict=True)
        ]

    def groups(self, points: Iterable[Point], threads: Callable[[], int]) -> Iterator[Group]:
        """Yield the points in order, in groups that fit one launch and give every worker thread something to do."""
        for (estimator, _), alike in groupby(points, _kind):
            room = 1
            if isinstance(self.problem, Batchable) and isinstance(estimator, AdjointEstimator | None):
                room = self.problem.room(estimator)
            while group := tuple(islice(alike, max(room // max(threads(), 1), 1))):
                yield group


def evaluated(
    problem: Differentiable,
    points: Iterable[Point],
    executor: Executor,
    observe: Observer | None = None,
    on_result: OnResult | None = None,
) -> list[Estimate]:
    """Compute estimates at points by an executor, many in one launch, and return them in order."""
    evaluation, firsts = Evaluation(problem, observe), [0]

    def groups() -> Iterator[Group]:
        for group in evaluation.groups(points, executor.threads):
            firsts.append(firsts[-1] + len(group))
            yield group

    def tell(number: int, group: list[Estimate]) -> None:
        if on_result is not None:
            for k, one in enumerate(group):
                on_result(firsts[number] + k, one)

    return [one for group in executor.map(evaluation, groups(), tell) for one in group]


def without_runs(errors: Sequence[Exception], of: str) -> str:
    """Return a phrase with the number and the cause of failed runs, such as "2 of 4 points diverged"."""
    diverged = sum(isinstance(error, DivergedError) for error in errors)
    why = ["diverged"] * bool(diverged) + ["cannot be run"] * (diverged < len(errors))
    return f"{len(errors)} of {of} {' or '.join(why)}"


def _kind(point: Point) -> tuple[Any, ...]:
    """Return a key, which is equal for points that one launch can evaluate."""
    return point.estimator, {name: np.shape(value) for name, value in point.values.items()}
