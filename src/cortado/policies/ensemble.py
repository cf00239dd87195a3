"""The gradient of a smoothed loss, from forward runs alone."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cortado.errors import InputError, shown
from cortado.parameter_values import Arrays, Values
from cortado.policies.policy import Differentiable, Estimate
from cortado.rollout import Observer

MOST_NUMBERS = 64
"""Numbers that differences may be taken along: each costs two runs a sample."""


@dataclass(frozen=True)
class Smoothed:
    """Central differences, averaged over a cloud of parameters and first states: the reference beyond chaos.

    Formula: for parameters u of N numbers, each in units of its spread h,

        g = mean over samples of sum_k (L(u + r q_k) - L(u - r q_k)) / (2 r) q_k,   r = sqrt(N),

    with q_1 ... q_N an orthonormal basis, turned at random in every sample, and first positions moved at random, the
    same way on both sides of a difference. It is the gradient of the loss averaged over a ball of radius h sqrt(N), the
    size of a Gaussian cloud of standard deviation h (randomised smoothing, in antithetic and orthogonal directions).

    Bias: features of the loss narrower than the spread are lost, as they should be; noise, which `Estimate`'s
    ``standard_error`` tells. Cost: 2 N samples forward runs, so that it is for a few dozen numbers at most.
    """

    spread: float | Mapping[str, float] = 0.5
    """h of the parameters, in their units, or by name."""
    samples: int = 8
    disorder: float = 0.01
    """Standard deviation of every coordinate of the first positions [spacings]."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.samples < 2:
            raise InputError(f"samples is {shown(self.samples)}, but must be at least 2, to know how they scatter.")
        if not self.disorder >= 0.0:
            raise InputError(f"disorder is {shown(self.disorder)}, but must be at least 0, in spacings.")

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        values = {name: np.asarray(value, dtype=np.float64) for name, value in parameters.items()}
        loss, random = problem.value(values), np.random.default_rng(self.seed)
        spreads = np.concatenate([np.full(value.size, self._spread(name)) for name, value in values.items()])
        numbers = len(spreads)
        if numbers > MOST_NUMBERS:
            raise InputError(
                f"the parameters are {numbers} numbers, but must be {MOST_NUMBERS} at most, as Smoothed runs the "
                "simulation twice for each: take fewer, such as one gravity for all steps, or another policy."
            )

        def along(u: np.ndarray, disorder: np.ndarray) -> float:
            moved = _moved(values, spreads * u)
            start = moved.get("initial_positions", problem.simulation.positions)
            return problem.value({**moved, "initial_positions": start + disorder} if self.disorder else moved)

        found = np.zeros((self.samples, numbers))
        for sample in found:
            for q in _rotation(numbers, random):
                disorder = self._displacement(problem, random)
                r = np.sqrt(numbers)
                sample += (along(r * q, disorder) - along(-r * q, disorder)) / (2.0 * r) * q
        error = found.std(axis=0, ddof=1) / np.sqrt(self.samples)
        zeros = {name: np.zeros_like(value) for name, value in values.items()}
        gradient, errors = (_moved(zeros, numbers_ / spreads) for numbers_ in (found.mean(axis=0), error))
        return Estimate(loss, gradient, standard_error=errors)

    def _spread(self, name: str) -> float:
        if isinstance(self.spread, Mapping) and name not in self.spread:
            raise InputError(f"spread has nothing for {name}, but must have a number for every parameter.")
        spread = self.spread[name] if isinstance(self.spread, Mapping) else self.spread
        if not spread > 0.0:
            raise InputError(f"spread of {name} is {shown(spread)}, but must be greater than 0.")
        return float(spread)

    def _displacement(self, problem: Differentiable, random: np.random.Generator) -> np.ndarray:
        spacing = problem.simulation.scene.discretisation.spacing
        return self.disorder * spacing * random.standard_normal(problem.simulation.positions.shape)


def _moved(values: Arrays, change: np.ndarray) -> Arrays:
    """Values plus a change of all their numbers, one after another."""
    ends = np.cumsum([value.size for value in values.values()])
    parts = np.split(change, ends[:-1])
    return {name: value + part.reshape(value.shape) for (name, value), part in zip(values.items(), parts, strict=True)}


def _rotation(size: int, random: np.random.Generator) -> np.ndarray:
    """(size, size) rows of a random orthonormal basis, uniform over all of them."""
    q, r = np.linalg.qr(random.standard_normal((size, size)))
    return (q * np.sign(np.diag(r))).T
