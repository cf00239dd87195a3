"""The true gradient: that of the smoothed loss, with its standard error, along directions.

A control of few numbers has the gradient itself for its truth, by `gradients.RandomizedSmoothing`: its directions are
the components. For thousands of numbers, it is the smoothed difference along some random directions.
"""

from dataclasses import dataclass

import numpy as np

from cortado import evaluate
from cortado.gradients import RandomizedSmoothing
from cortado.gradients.estimator import Differentiable

SAMPLES = 8
"""Independent samples of every derivative."""
DIRECTIONS = 32
"""How many random directions there are where the numbers are more than `FEW`."""
FEW = 48
"""A control of at most so many numbers has its truth component by component."""


@dataclass(frozen=True)
class Directional:
    """Derivatives of a loss along directions."""

    derivatives: np.ndarray
    """(directions,)"""
    standard_errors: np.ndarray
    """(directions,) of means of `SAMPLES` samples, so that a 95 % interval has the quantile of Student's t."""


def directions(numbers: int, seed: int) -> np.ndarray:
    """(directions, numbers) of unit length: all axes, or random directions where the numbers are many."""
    if numbers <= FEW:
        return np.eye(numbers)
    drawn = np.random.default_rng([seed, numbers]).standard_normal((DIRECTIONS, numbers))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def smoothed(problem: Differentiable, name: str, u: np.ndarray, spread: float, seed: int) -> Directional:
    """The derivatives of the smoothed loss with respect to the parameter ``name``, at u, along `directions`."""
    ensemble = RandomizedSmoothing(spread, SAMPLES, seed=seed)
    if u.size > FEW:
        return _differences(problem, ensemble, name, u, directions(u.size, seed))
    found = ensemble.estimate(problem, {name: u})
    assert found.standard_error is not None
    return Directional(found.gradient[name].ravel(), found.standard_error[name].ravel())


def _differences(
    problem: Differentiable, ensemble: RandomizedSmoothing, name: str, u: np.ndarray, along: np.ndarray
) -> Directional:
    """Central differences along directions, each over the ball of the ensemble, averaged over first positions."""
    sampler, radius = ensemble.around(problem, {name: u}), np.sqrt(u.size)
    points = []
    for q in along:
        for _ in range(ensemble.samples):
            displacement = sampler.displacement()
            points += [sampler.sample(sign * radius * q, displacement).values for sign in (1.0, -1.0)]
    losses = np.array([one.loss for one in evaluate(problem, points)]).reshape(len(along), ensemble.samples, 2)
    width = radius * float(sampler.spreads[0])
    slopes = (losses[:, :, 0] - losses[:, :, 1]) / (2.0 * width)
    return Directional(slopes.mean(axis=1), slopes.std(axis=1, ddof=1) / np.sqrt(ensemble.samples))
