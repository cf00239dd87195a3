"""Which gradient points the way: those of the estimators, against that of the loss smoothed over meaningful changes."""

from dataclasses import dataclass

import numpy as np

from cortado.errors import DivergedError
from cortado.gradients import AdjointViscosity, Estimate, Exact, FrozenGeometry, GradientEstimator, RandomizedSmoothing
from cortado.parameters.values import Arrays
from cortado.problem import Problem

MOST_NUMBERS = 12
"""Numbers that a smoothed gradient is taken of: each costs two runs a sample."""
SAMPLES = 2
ALIKE = 0.5
"""Cosine below which a gradient does not point the way."""
ESTIMATORS: tuple[GradientEstimator, ...] = (Exact(), AdjointViscosity(), FrozenGeometry())


@dataclass(frozen=True)
class Judged:
    """An estimator's gradient beside the smoothed one, every number in units of its meaningful change."""

    estimator: str
    """As it is written in Python, after ``gradients.``"""
    cosine: float
    size: float
    """Over that of the smoothed gradient."""

    @property
    def merit(self) -> float:
        """The cosine over how many times too large or too small the gradient is; 1 is perfect."""
        return self.cosine * min(self.size, 1.0 / self.size) if self.size > 0.0 else 0.0


@dataclass(frozen=True)
class Agreement:
    """How near gradients are to the smoothed one."""

    noise: float
    """Standard error of the smoothed gradient, relative."""
    estimators: tuple[Judged, ...]
    """`Exact` comes first."""

    @property
    def best(self) -> Judged | None:
        """The estimator, other than `Exact`, of the greatest merit among those that point the way, if any does."""
        good = [judged for judged in self.estimators[1:] if judged.cosine > ALIKE]
        return max(good, key=lambda judged: judged.merit, default=None)


def agreement(problem: Problem, values: Arrays, sizes: Arrays, exact: Arrays) -> Agreement | None:
    """Of all these parameters together; None where they are too many numbers for a smoothed gradient, or where the loss
    does not feel them."""
    if sum(value.size for value in values.values()) > MOST_NUMBERS:
        return None
    spread = {name: float(size.mean()) for name, size in sizes.items()}
    try:
        smoothed = RandomizedSmoothing(spread, SAMPLES).estimate(problem, values)
    except DivergedError:
        return None

    def numbers(gradient: Arrays) -> np.ndarray:
        return np.concatenate([spread[name] * gradient[name].ravel() for name in values])

    reference, error = numbers(smoothed.gradient), numbers(smoothed.standard_error or {})
    length = float(np.linalg.norm(reference))

    def judged(estimator: GradientEstimator) -> Judged:
        found = Estimate(0.0, exact) if estimator == Exact() else problem.estimate(values, estimator)
        gradient = numbers(found.gradient)
        size = float(np.linalg.norm(gradient))
        cosine = float(gradient @ reference) / (size * length) if 0.0 < size < np.inf else 0.0
        return Judged(_written(estimator, found), cosine, size / length)

    if not length > 0.0:
        return None
    return Agreement(float(np.linalg.norm(error)) / length, tuple(map(judged, ESTIMATORS)))


def _written(estimator: GradientEstimator, found: Estimate) -> str:
    inside = f"strength={found.strength:g}" if found.strength is not None else ""
    return f"{type(estimator).__name__}({inside})"
