"""Gradient estimators: their protocols, what they return, and a problem evaluated at many points."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, islice
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from cortado.arrays import as_numbers, as_one_number
from cortado.calls import counted, sized
from cortado.errors import DivergedError, InputError, OutOfRangeError, shown
from cortado.executors import Executor, OnResult
from cortado.particles.state import Parameters, State
from cortado.rollout.rollout import BackwardStep, Observer, Rollout
from cortado.scene.parameter_values import Arrays, Values
from cortado.solvers.solver import Counts


@dataclass(frozen=True)
class Estimate:
    """A loss and its gradient, with what the estimator knows about its accuracy."""

    loss: Any
    """Loss: a float, of a batch (batch,)."""
    gradient: Arrays
    """Gradient by parameter in its shape (float64), of a batch with a first axis for the scenes."""
    standard_error: Arrays | None = None
    """Standard error of every component of the gradient, where it is an average over samples."""
    degrees_of_freedom: float | None = None
    """Degrees of freedom of the standard error: independent samples less one; of `Guided` those of its two parts."""
    mean_loss: float | None = None
    """Mean of the loss over the ensemble that the gradient is averaged over."""
    left_out: int = 0
    """Number of an ensemble's runs left out of the average, as they or their partners diverged or are out of range."""
    diverged: Exception | None = None
    """Error for which a point of `cortado.evaluate` had no run, `DivergedError` or `OutOfRangeError`; loss and gradient
    are then NaN."""

    def interval(self, confidence: float = 0.95) -> tuple[Arrays, Arrays]:
        """Return the lower and the upper end, by parameter, of an interval for each component of the gradient.

        With this probability it contains the mean that the estimator would have over endlessly many samples: by
        Student's distribution, as the scatter is known from few samples. A bias of the estimator comes on top.

        Raises:
            InputError: the estimate is no average, or the confidence is not between 0 and 1.
        """
        if self.standard_error is None or self.degrees_of_freedom is None:
            raise InputError(
                "The estimate has no standard error, as it is no average over samples: it has no interval."
            )
        if not 0.0 < as_one_number("confidence", confidence) < 1.0:
            raise InputError(f"confidence is {confidence}, but must be between 0 and 1.")
        from scipy.stats import t as student

        reach = float(student.ppf(0.5 + 0.5 * confidence, self.degrees_of_freedom))
        errors = self.standard_error
        lower = {name: value - reach * errors[name] for name, value in self.gradient.items()}
        return lower, {name: value + reach * errors[name] for name, value in self.gradient.items()}

    def member(self, number: int, shapes: Mapping[str, tuple[int, ...]]) -> "Estimate":
        """Return the estimate of one scene of a batch, with gradients of these shapes."""
        gradient = {name: bar[number].reshape(shapes[name]) for name, bar in self.gradient.items()}
        return replace(self, loss=float(self.loss[number]), gradient=gradient)

    def __repr__(self) -> str:
        error = "" if self.standard_error is None else ", with its standard error"
        loss = f"losses {self.loss.shape}" if np.ndim(self.loss) else f"loss {self.loss:.6g}"
        out = f", {counted(self.left_out, 'run')} left out" if self.left_out else ""
        return f"Estimate({loss}, gradient of {sized(self.gradient)}{error}{out})"


class ForwardPass(Protocol):
    """Protocol of a forward run with its loss, from which reverse passes may start until the problem is run again."""

    @property
    def loss(self) -> float:
        """Loss of the run."""

    def back(self, estimator: "AdjointEstimator", observe: Observer | None = None) -> Arrays:
        """Return the gradient by an estimator; ``observe`` is called with the number and the adjoint of every state,
        from the last to the first."""


class Differentiable(Protocol):
    """Protocol of a problem as estimators need it."""

    simulation: Any

    def value(self, parameters: Values) -> float:
        """Return the loss of these parameters, by a run forward only."""

    def forward_pass(self, parameters: Values) -> ForwardPass:
        """Run forward, and return a run from which reverse passes may start."""


@runtime_checkable
class Batchable(Protocol):
    """Protocol of a problem that can be evaluated at many points in one launch."""

    def room(self, estimator: "AdjointEstimator | None" = None) -> int:
        """Return how many points `together` takes at once, for gradients by an estimator or for losses alone."""

    def together(
        self, points: Sequence[Values], estimator: "AdjointEstimator | None" = None
    ) -> list[Estimate | DivergedError]:
        """Return estimates at points with equal names and shapes of parameters, in one launch, each with the bits that
        it has alone; without an estimator of the loss alone. A lost particle's error takes the place of an estimate."""


class GradientEstimator(Protocol):
    """Protocol of an object that computes a gradient, exact or approximate."""

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """Return the loss and its gradient, calling ``observe`` with each adjoint of a state, if any."""


def checked_estimator(estimator: GradientEstimator) -> GradientEstimator:
    """Return the estimator; raises `InputError` for anything else, such as the class of an estimator."""
    if isinstance(estimator, type) or not hasattr(estimator, "estimate"):
        raise InputError(f"estimator is {shown(estimator)}, but must be an object such as cortado.gradients.Exact().")
    return estimator


def checked_reverse(estimator: "AdjointEstimator") -> "AdjointEstimator":
    """Return the estimator; raises `InputError` for anything but one that goes back through a run."""
    if not isinstance(estimator, AdjointEstimator):
        wanted = "an AdjointEstimator such as cortado.gradients.Exact()"
        raise InputError(f"estimator is {shown(estimator)}, but must be {wanted}.")
    return estimator


def checked_estimate(found: Any, parameters: Values, batch: int | None = None) -> Estimate:
    """Return an estimator's result in float64; raises `InputError` unless it has a gradient in the shape of every given
    parameter, of a batch with a first axis for the scenes."""
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
    """An estimator that makes one reverse pass through one rollout, step by step."""

    @property
    def batches(self) -> bool:
        """True if the estimator treats each scene of a batch by itself; a user's class overrides it to say so."""
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
    """A backward step that applies another estimator's, then filters the adjoint."""

    only_launches: ClassVar[bool] = False
    """True if `filter` does nothing but launch kernels, always in equal form. Only then may a backward step be captured
    as a graph, which does not repeat the work of Python or NumPy between them."""

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
        """Change the adjoint of the state whose step the solver has replayed last."""
        raise NotImplementedError


NO_RUN: tuple[type[Exception], ...] = (DivergedError, OutOfRangeError)
"""Errors that say that a point has no run, which is no mistake where it is one of many."""


@dataclass(frozen=True)
class Point:
    """A set of parameter values, and the estimator of the gradient there."""

    values: Values
    estimator: GradientEstimator | None = None
    """Estimator of the gradient; None for the loss alone."""
    loss_if_diverged: float = np.nan
    errors: tuple[type[Exception], ...] = ()
    """Errors in place of a run that give the point its substitute loss."""

    def evaluated(self, problem: Differentiable, observe: Observer | None = None) -> Estimate:
        """Return the loss of a problem at the point, and its gradient, which is empty without an estimator."""
        try:
            found = self.found(problem, observe)
            return found if self.estimator is None else checked_estimate(found, self.values, problem.simulation.batch)
        except self.errors as error:
            return self.without_a_run(error, self.loss_if_diverged)

    def found(self, problem: Differentiable, observe: Observer | None = None) -> Estimate:
        """Return the estimator's result at the point, unchecked."""
        if self.estimator is None:
            return Estimate(problem.value(self.values), {})
        return self.estimator.estimate(problem, self.values, observe)

    def without_a_run(self, why: Exception, loss: float = np.nan) -> Estimate:
        """Return the estimate for a point without a run: its gradient is NaN."""
        names = self.values if self.estimator is not None else ()
        return Estimate(loss, {name: np.full(np.shape(self.values[name]), np.nan) for name in names}, diverged=why)


@dataclass(frozen=True)
class Sample(Point):
    """A point that an ensemble has drawn, at which there may be no run."""

    def evaluated(self, problem: Differentiable, observe: Observer | None = None) -> Estimate:
        """Return the estimate at the sample, unchecked, as perturbed first positions need no gradient; an `InputError`
        then says that the user did not choose this point."""
        try:
            return self.found(problem, observe)
        except NO_RUN as error:
            return self.without_a_run(error)
        except InputError as error:
            raise InputError(f"A sample of the ensemble does not fit: {error}") from error


Group = tuple[Point, ...]
"""A tuple of points that are evaluated together."""


@dataclass(frozen=True)
class Evaluation:
    """A problem as a function of groups of points, which a worker process keeps. An error in a point, or in
    the run there, has the sentence that it would have for the point alone."""

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
        """Yield the points in their order, in groups that fit one launch of the problem, shared out among the threads
        of present workers."""
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
    """Return estimates at points, in their order, computed by an executor, as many at once as one launch takes."""
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
    """Return in words how many of something had no run, and why: "2 of 4 points diverged"."""
    diverged = sum(isinstance(error, DivergedError) for error in errors)
    why = ["diverged"] * bool(diverged) + ["cannot be run"] * (diverged < len(errors))
    return f"{len(errors)} of {of} {' or '.join(why)}"


def _kind(point: Point) -> tuple[Any, ...]:
    """Return a key of a point; points with equal keys can be evaluated in one launch."""
    return point.estimator, {name: np.shape(value) for name, value in point.values.items()}
