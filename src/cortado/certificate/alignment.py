"""How well each estimator's gradient is aligned with that of the loss smoothed over meaningful perturbations."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from cortado.gradients import (
    AdjointViscosity,
    EnsembleMean,
    Exact,
    GradientEstimator,
    Guided,
    RandomizedSmoothing,
)
from cortado.gradients.points import NO_RUN
from cortado.problem import Problem
from cortado.scene.parameters.values import Arrays

MOST_NUMBERS = 12
"""Components that a smoothed gradient is computed for at most: each costs two runs a sample."""
SAMPLES = 2
LEAST_COSINE = 0.5
"""An estimator is advised only where the cosine of its gradient with the smoothed one is greater."""
GOOD_COSINE = 0.95
"""Where no estimator of one run has this cosine, averages over an ensemble are tried, which cost some ten times as
much."""
ESTIMATORS: tuple[GradientEstimator, ...] = (Exact(), AdjointViscosity())
"""Of one run."""
AVERAGES: dict[str, Callable[[dict[str, float]], GradientEstimator]] = {
    "EnsembleMean(spread)": lambda spread: EnsembleMean(spread, seed=1, estimator=AdjointViscosity()),
    "Guided(spread)": lambda spread: Guided(spread, seed=1),
}
"""The best ones of the table in `docs/gradients.md`, with other random numbers than the smoothed gradient."""


@dataclass(frozen=True)
class Judged:
    """An estimator's gradient beside the smoothed one, each component in units of its meaningful perturbation."""

    estimator: str
    """As it is written in Python, after ``gradients.``"""
    cosine: float
    size: float
    """Its norm over that of the smoothed gradient."""

    @property
    def merit(self) -> float:
        """The cosine over how many times too large or too small the gradient is; 1 is perfect."""
        return self.cosine * min(self.size, 1.0 / self.size) if self.size > 0.0 else 0.0


@dataclass(frozen=True)
class Alignment:
    """How well the gradients of several estimators are aligned with the smoothed one."""

    noise: float
    """Standard error of the smoothed gradient, relative."""
    estimators: tuple[Judged, ...]
    """`Exact` comes first."""
    spread: Mapping[str, float] = field(default_factory=dict)
    """By parameter, of the smoothed gradient and of averages."""

    @property
    def best(self) -> Judged | None:
        """The estimator other than `Exact` that has the greatest merit; None where no cosine is large enough."""
        good = [judged for judged in self.estimators[1:] if judged.cosine > LEAST_COSINE]
        return max(good, key=lambda judged: judged.merit, default=None)


def alignment(problem: Problem, values: Arrays, sizes: Arrays, exact: Arrays) -> Alignment | None:
    """The alignment for all these parameters together.

    None where they have too many components for a smoothed gradient, where it has no run, and where the loss
    does not depend on them.
    """
    if sum(value.size for value in values.values()) > MOST_NUMBERS:
        return None
    spread = {name: float(size.mean()) for name, size in sizes.items()}
    try:
        smoothed = RandomizedSmoothing(spread, SAMPLES).estimate(problem, values)
    except NO_RUN:
        return None

    def numbers(gradient: Arrays) -> np.ndarray:
        return np.concatenate([spread[name] * gradient[name].ravel() for name in values])

    reference, error = numbers(smoothed.gradient), numbers(smoothed.standard_error or {})
    length = float(np.linalg.norm(reference))

    def judged(name: str, estimator: GradientEstimator) -> Judged:
        gradient = numbers(exact if estimator == Exact() else problem.estimate(values, estimator).gradient)
        size = float(np.linalg.norm(gradient))
        cosine = float(gradient @ reference) / (size * length) if 0.0 < size < np.inf else 0.0
        return Judged(name, cosine, size / length)

    if not length > 0.0:
        return None
    found = [judged(f"{type(estimator).__name__}()", estimator) for estimator in ESTIMATORS]
    if max(one.cosine for one in found) < GOOD_COSINE:
        with suppress(*NO_RUN):
            found += [judged(name, make(spread)) for name, make in AVERAGES.items()]
    return Alignment(float(np.linalg.norm(error)) / length, tuple(found), spread)
