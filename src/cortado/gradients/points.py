"""Points of the space of parameters at which a problem is evaluated, each on its own, wherever an executor computes."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, islice
from typing import Any

import numpy as np

from cortado.errors import DivergedError, InputError, OutOfRangeError
from cortado.executors import Executor, OnResult
from cortado.gradients.estimator import (
    AdjointEstimator,
    Batchable,
    Differentiable,
    Estimate,
    GradientEstimator,
    checked_estimate,
)
from cortado.rollout.rollout import Observer
from cortado.scene.parameters.values import Values

NO_RUN: tuple[type[Exception], ...] = (DivergedError, OutOfRangeError)
"""Errors that say that there is no run at a point, which is no mistake where the point is one of many."""


@dataclass(frozen=True)
class Point:
    """Parameters, and how the gradient is computed there."""

    values: Values
    estimator: GradientEstimator | None = None
    """None for the loss alone."""

    def evaluated(self, problem: Differentiable, observe: Observer | None = None) -> Estimate:
        """The loss of a problem there, and its gradient, which is empty without an estimator."""
        found = self.found(problem, observe)
        return found if self.estimator is None else checked_estimate(found, self.values, problem.simulation.batch)

    def found(self, problem: Differentiable, observe: Observer | None = None) -> Estimate:
        """What the estimator says, unchecked."""
        if self.estimator is None:
            return Estimate(problem.value(self.values), {})
        return self.estimator.estimate(problem, self.values, observe)

    def without_a_run(self, why: Exception, loss: float = np.nan) -> Estimate:
        """The estimate where no run is possible: its gradient is no number."""
        names = self.values if self.estimator is not None else ()
        return Estimate(loss, {name: np.full(np.shape(self.values[name]), np.nan) for name in names}, diverged=why)


@dataclass(frozen=True)
class FalliblePoint(Point):
    """A point at which there may be no run, as it diverges or the scene does not allow it."""

    loss_if_diverged: float = np.nan
    errors: tuple[type[Exception], ...] = NO_RUN
    """Those after which it has this loss."""

    def evaluated(self, problem: Differentiable, observe: Observer | None = None) -> Estimate:
        try:
            return super().evaluated(problem, observe)
        except self.errors as error:
            return self.without_a_run(error, self.loss_if_diverged)


@dataclass(frozen=True)
class Sample(Point):
    """A point that an ensemble has drawn, at which there may be no run."""

    def evaluated(self, problem: Differentiable, observe: Observer | None = None) -> Estimate:
        """See `Point.found`, as a gradient with respect to perturbed first positions need not be there; an `InputError`
        says that the user did not choose this point."""
        try:
            return self.found(problem, observe)
        except NO_RUN as error:
            return self.without_a_run(error)
        except InputError as error:
            raise InputError(f"A sample of the ensemble does not fit: {error}") from error


Group = tuple[Point, ...]
"""Points that are evaluated together."""


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
        """The points in their order, as many at a time as one launch of the problem takes, shared out among the threads
        of workers that there are when a group is asked for."""
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
    """Estimates at points, in their order, computed where an executor says, as many at a time as one launch takes."""
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
    """How many of something had no run, and why, in words: "2 of 4 points diverged"."""
    diverged = sum(isinstance(error, DivergedError) for error in errors)
    why = ["diverged"] * bool(diverged) + ["cannot be run"] * (diverged < len(errors))
    return f"{len(errors)} of {of} {' or '.join(why)}"


def _kind(point: Point) -> tuple[Any, ...]:
    """Points of one kind can be evaluated in one launch."""
    return point.estimator, {name: np.shape(value) for name, value in point.values.items()}
