"""How certain the end of a search is: the covariance of the estimate, and the weights that its residuals ask for."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from cortado.errors import ComputationError
from cortado.optimisation.fitting.fitted import FittedPart
from cortado.optimisation.fitting.least_squares import Linearised, Part, Weighting
from cortado.optimisation.fitting.noise import ScoreCovariance, correlation_time, independent_frames, score_covariance

SINGULAR = 1e-10
"""Relative: where the Hessian has an eigenvalue below, a combination of parameters cannot be told."""


class Fitted(Protocol):
    """What is fitted: a `LeastSquares`, or what has these of it."""

    @property
    def parts(self) -> list[Part]:
        """The observations."""

    @property
    def labels(self) -> list[str]:
        """(free,) of the numbers."""


@dataclass(frozen=True)
class Certainty:
    """Of an estimate, from the scatter of its residuals."""

    hessian: np.ndarray
    """(free, free) N = J^T J of weighted Jacobians."""
    covariance: np.ndarray
    """(free, free) of the coordinates."""
    degrees_of_freedom: np.ndarray
    """(free,) of Student's distribution."""
    scores: tuple[ScoreCovariance, ...]
    """Of each part."""
    parts: tuple[FittedPart, ...]

    @classmethod
    def of(cls, problem: Fitted, at: Linearised, weights: Sequence[Weighting]) -> "Certainty":
        """Raises `ComputationError` where a combination of parameters cannot be told."""
        N = hessian(problem, at, weights)
        N_inverse = inverse(problem, N)
        scores, parts = list[ScoreCovariance](), list[FittedPart]()
        for part, r, J, weight in zip(problem.parts, at.residuals, at.jacobians, weights, strict=True):
            times = part.observation.times
            frames = independent_frames(times, weight.correlation_time)
            white, slopes = weight.of(r, times), weight.of(J, times)
            score = score_covariance(slopes, white, N_inverse, frames)
            scores.append(score)
            parts.append(FittedPart(part, weight, r, spread(r), _inflation(slopes, white), score.samples, frames))
        covariance: Any = N_inverse @ sum(score.B for score in scores) @ N_inverse
        freedom = np.array([_freedom(scores, N_inverse, unit) for unit in np.eye(len(at.u))])
        return cls(N, covariance, freedom, tuple(scores), tuple(parts))


def noise_of(problem: Fitted, at: Linearised, weights: Sequence[Weighting]) -> list[Weighting]:
    """Weights that the residuals of a first fit ask for: correlated numbers weigh less, as they tell less."""
    N_inverse = inverse(problem, hessian(problem, at, weights))
    found = []
    for part, r, J, weight in zip(problem.parts, at.residuals, at.jacobians, weights, strict=True):
        times, size = part.observation.times, part.observation.noise or spread(r) or weight.scale
        time = correlation_time(weight.of(J, times), weight.of(r, times), N_inverse, times)
        own = Weighting(size, time)
        found.append(Weighting(size * np.sqrt(_inflation(own.of(J, times), own.of(r, times))), time))
    return found


def counted_covariance(problem: Fitted, at: Linearised, weights: Sequence[Weighting]) -> np.ndarray:
    """The covariance where every number was taken for independent of all others."""
    alone = [Weighting(spread(r) or weight.scale) for r, weight in zip(at.residuals, weights, strict=True)]
    return inverse(problem, hessian(problem, at, alone))


def hessian(problem: Fitted, at: Linearised, weights: Sequence[Weighting]) -> np.ndarray:
    """N = J^T J of weighted Jacobians."""
    each = zip(problem.parts, at.jacobians, weights, strict=True)
    flat = (weight.of(J, part.observation.times).reshape(-1, len(at.u)) for part, J, weight in each)
    return np.asarray(sum(J.T @ J for J in flat))


def inverse(problem: Fitted, N: np.ndarray) -> np.ndarray:
    """N^-1; raises `ComputationError` where a combination of parameters cannot be told."""
    labels, size = problem.labels, np.sqrt(np.diag(N))
    if not np.isfinite(N).all():
        raise ComputationError("The derivatives are not finite: try fewer steps, or float64.")
    if not size.all():
        lost = [label for label, s in zip(labels, size, strict=True) if not s]
        raise ComputationError(f"What was measured does not depend on {', '.join(lost)}: leave it out of the fit.")
    eigenvalues, axes = np.linalg.eigh(N / np.outer(size, size))
    if eigenvalues[0] < SINGULAR:
        mixed = [label for label, a in zip(labels, axes[:, 0], strict=True) if abs(a) > 0.1]
        raise ComputationError(
            f"What was measured does not tell {' and '.join(mixed)} apart at all: leave one of them out of the fit, or "
            "measure something else besides."
        )
    return np.asarray((axes / eigenvalues) @ axes.T / np.outer(size, size))


def spread(r: np.ndarray) -> float:
    """Root mean square of the numbers that count."""
    count = np.count_nonzero(r)
    return float(np.sqrt((r**2).sum() / max(count, 1)))


def _inflation(J: np.ndarray, r: np.ndarray) -> float:
    """By how much correlation within frames makes the variance of the score larger than a count of numbers has it."""
    counted = np.einsum("fmp,fmp->p", J, J) * np.mean(r**2)
    pooled = np.einsum("fmp,hm->fhp", J, r, optimize=True)
    has = counted > 0.0
    return float(np.mean((pooled**2).sum(axis=(0, 1))[has] / len(r) / counted[has])) if has.any() else 1.0


def _freedom(scores: Sequence[ScoreCovariance], N_inverse: np.ndarray, direction: np.ndarray) -> float:
    """Degrees of freedom of a number's variance, which is a sum over parts (Welch 1947)."""
    a = N_inverse @ direction
    variances = np.array([a @ score.B @ a for score in scores])
    each = np.array([score.degrees_of_freedom(N_inverse, direction) for score in scores])
    return float(variances.sum() ** 2 / (variances**2 / each).sum()) if variances.any() else float(each.min())
