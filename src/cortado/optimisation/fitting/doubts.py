"""What residuals say against the model: sentences about where it is wrong, by more than the noise."""

from collections.abc import Sequence

import numpy as np

from cortado.optimisation.fitting.causes import cheap_causes
from cortado.optimisation.fitting.certainty import Certainty
from cortado.optimisation.fitting.least_squares import LeastSquares, Linearised, Weighting
from cortado.optimisation.fitting.noise import ScoreCovariance

TOO_LARGE = 1.3
"""Residuals over the noise that was given."""
STILL = 0.01
"""Of the greatest change over the frames: numbers that the model says change by less stay as they are."""
FEW_STILL = 20
"""Numbers that stay as they are; of fewer nothing is said."""
TOO_LARGE_IN_MOTION = 2.0
"""Residuals of the numbers that change over those of the numbers that stay as they are."""
EXACT = 1e-4
"""Of the largest number measured: residuals that are smaller are those of a simulation, of which nothing is said."""
ROUNDING = 0.002
"""Of the largest number measured: half a step of 8 bits, below which residuals say nothing."""
TOO_SLOW = 0.35
"""Correlation time of residuals, over the length of the record."""
VAGUE = 1.0
"""Standard error of a logarithm."""
GREATEST = 20.0
"""Of these logarithms, in a sentence."""
AT_BOUND = 1e-6
"""Of a coordinate, or of 1 if that is more: an estimate that is nearer to a bound is at it."""
TOO_FAR = 3.0
"""Distance between what two halves of a record say, over its error."""


def doubts_of(
    problem: LeastSquares,
    at: Linearised,
    weights: Sequence[Weighting],
    certainty: Certainty,
) -> tuple[str, ...]:
    """None where the residuals look like noise, and tell the parameters."""
    found, is_exact = list[str](), True
    for part, r, weight in zip(problem.parts, at.residuals, weights, strict=True):
        times, noise = part.observation.times, part.observation.noise
        size = float(np.sqrt((r**2).sum() / max(np.count_nonzero(r), 1)))
        if size <= EXACT * np.nanmax(np.abs(part.observation.measured)):
            continue
        is_exact = False
        if noise is not None and size > TOO_LARGE * noise:
            found.append(
                f"The residuals of {part.label} are {size / noise:.2g} times the noise that was given "
                f"({size:.2g} against {noise:.2g} {part.observation.unit}): the model is wrong by that much."
            )
        still, moving = still_and_moving(part.observation.measured, r)
        if moving > TOO_LARGE_IN_MOTION * still:
            found.append(
                f"The residuals of {part.label} are {moving / still:.2g} times as large where the model changes as "
                f"where it stays as it is ({moving:.2g} against {still:.2g} {part.observation.unit}): there it is "
                "wrong by that much, and the error bars are too small."
            )
        length = times[-1] - times[0]
        if weight.correlation_time > TOO_SLOW * length:
            found.append(
                f"The residuals of {part.label} hardly change from frame to frame: they are correlated over "
                f"{weight.correlation_time:.2g} s of a record of {length:.2g} s, which noise seldom is. The model is "
                f"probably wrong by about {size:.2g} {part.observation.unit}, and the error bars are too small."
            )
    if not is_exact:
        found += _halves(problem, at, weights, certainty.scores) + cheap_causes(problem, at, weights)
    return (*found, *_at_bounds(problem, at), *_vague(problem, at, certainty))


def still_and_moving(measured: np.ndarray, r: np.ndarray) -> tuple[float, float]:
    """Root mean squares of the residuals (frames, m) of the numbers that the model says stay as they are, such as the
    background of a video, which show the noise alone, and of the others; infinite and 0 where few stay."""
    change = np.ptp(measured + r, axis=0)
    counted = ~np.isnan(change)
    still = counted & (change <= STILL * np.max(change[counted], initial=0.0))
    if still.sum() < FEW_STILL or not (counted & ~still).any():
        return np.inf, 0.0
    quiet, moving = (float(np.sqrt(np.mean(r[:, chosen] ** 2))) for chosen in (still, counted & ~still))
    return max(quiet, ROUNDING * float(np.nanmax(np.abs(measured)))), moving


def _at_bounds(problem: LeastSquares, at: Linearised) -> list[str]:
    """Of numbers that the bounds hold."""
    found = []
    for which, ends in zip(("lower", "upper"), problem.coordinates.bounds, strict=True):
        for label, u, end, value in zip(problem.labels, at.u, ends, problem.coordinates.numbers(at.u), strict=True):
            if np.isfinite(end) and abs(u - end) <= AT_BOUND * max(abs(end), 1.0):
                found.append(
                    f"{label} is {value:.4g}, its {which} bound: what was measured asks for a value beyond it, and its "
                    "error bar tells nothing."
                )
    return found


def _vague(problem: LeastSquares, at: Linearised, certainty: Certainty) -> list[str]:
    """Of positive numbers that may as well be many times as large."""
    coordinates = problem.coordinates
    bars = np.where(coordinates.logarithmic[coordinates.free], np.sqrt(np.diag(certainty.covariance)), 0.0)
    return [
        f"What was measured hardly tells {label}: one standard error is a factor of {np.exp(min(bar, GREATEST)):.2g}."
        for label, bar in zip(coordinates.labels, bars, strict=True)
        if bar > VAGUE
    ]


def _halves(
    problem: LeastSquares,
    at: Linearised,
    weights: Sequence[Weighting],
    scores: Sequence[ScoreCovariance],
) -> list[str]:
    """Where the first and the second half of the frames say different things: one step of Gauss and Newton for each."""
    size = len(at.u)
    steps, variances = [], []
    for half in (0, 1):
        N, s, B = np.zeros((size, size)), np.zeros(size), np.zeros((size, size))
        for part, r, J, weight, score in zip(problem.parts, at.residuals, at.jacobians, weights, scores, strict=True):
            times = part.observation.times
            chosen = np.array_split(np.arange(len(times)), 2)[half]
            slopes, white = weight.of(J, times)[chosen], weight.of(r, times)[chosen]
            N += np.einsum("fmp,fmq->pq", slopes, slopes, optimize=True)
            s += np.einsum("fmp,fm->p", slopes, white, optimize=True)
            B += score.products.S[chosen, chosen].sum(axis=0) / (1.0 - score.lost)
        if np.linalg.cond(N) > 1e10:
            return []
        inverse = np.linalg.inv(N)
        steps.append(-inverse @ s)
        variances.append(np.diag(inverse @ B @ inverse))
    away = np.abs(steps[0] - steps[1]) / np.sqrt(variances[0] + variances[1] + 1e-300)
    return [
        f"The first half of the frames and the second one say different things of {label}: by {off:.2g} times the "
        "error of the difference. The model is wrong, in a way that changes over time."
        for label, off in zip(problem.coordinates.labels, away, strict=True)
        if off > TOO_FAR
    ]
