"""Other starts of a fit: where the parameters might be instead, by forward runs all over their range."""

from collections.abc import Sequence

import numpy as np

from cortado.errors import DivergedError
from cortado.optimisation.fitting.certainty import spread
from cortado.optimisation.fitting.fitted import Fit, Tried
from cortado.optimisation.fitting.least_squares import LeastSquares

REACH = np.log(100.0)
"""To both sides of the start, of positive numbers that have no bounds: two decades."""
POINTS, MOST_POINTS = 8, 64
"""That are looked at: for each number, and in all."""
APART = 0.2
"""Of the range of some number: by less no two starts differ."""
FAR = 3.0
"""Standard errors: searches that end further apart ended in different valleys."""
SAME = 1e-3
"""Of a number: ends that are nearer are the same, however small the bars are."""
NO_LESS_LIKELY = 9.0
"""Of twice the logarithm of how much likelier one of two valleys is: three standard errors."""
TINY = 1e-300


def misfit(problem: LeastSquares, residuals: list[np.ndarray]) -> float:
    """The logarithm of the size of the residuals, the mean over all numbers that were measured: of Gaussian noise whose
    size is not known, the least is the likeliest."""
    counts = [np.count_nonzero(~np.isnan(part.observation.measured)) for part in problem.parts]
    return float(np.average([np.log(max(spread(r), TINY)) for r in residuals], weights=counts))


def other_starts(problem: LeastSquares, count: int) -> list[np.ndarray]:
    """At most so many points (free,), that which explains best what was measured first: of a Sobol sequence over the
    bounds, and over two decades to both sides of positive numbers without bounds. All other numbers are those of the
    start."""
    start, (lower, upper) = problem.coordinates.start, problem.coordinates.bounds
    reach = np.where(problem.coordinates.logarithmic[problem.coordinates.free], REACH, 0.0)
    lower, upper = (
        np.where(np.isfinite(lower), lower, start - reach),
        np.where(np.isfinite(upper), upper, start + reach),
    )
    found, chosen = [], list[np.ndarray]()
    for point in lower + (upper - lower) * _sequence(upper > lower):
        try:
            found.append((misfit(problem, problem.residuals(point)), point))
        except DivergedError:
            continue
    for _, point in sorted(found, key=lambda one: one[0]):
        away = [np.abs(point - one) / np.maximum(upper - lower, TINY) for one in chosen]
        if len(chosen) < count and all(one.max() > APART for one in away):
            chosen.append(point)
    return chosen


def _sequence(searched: np.ndarray) -> np.ndarray:
    """(points, free) from 0 to 1, each number of those that are searched evenly."""
    from scipy.stats import qmc

    dimensions = int(searched.sum())
    if not dimensions:
        return np.zeros((0, len(searched)))
    power = int(np.ceil(np.log2(min(POINTS * dimensions, MOST_POINTS))))
    points = np.zeros((2**power, len(searched)))
    points[:, searched] = qmc.Sobol(dimensions, scramble=False).random_base2(power) + 0.5 ** (power + 1)
    return points


def elsewhere(found: Fit, tried: Sequence[Tried]) -> list[Tried]:
    """The searches that ended in other valleys, the lowest one first."""
    bars = np.sqrt(np.diag(found.coordinate_covariance))
    near = SAME * np.where(found.coordinates.logarithmic[found.coordinates.free], 1.0, np.abs(found.u))
    others = [one for one in tried if (np.abs(one.end - found.u) > np.maximum(FAR * bars, near)).any()]
    return sorted(others, key=lambda one: one.misfit)


def other_valleys(found: Fit, tried: Sequence[Tried]) -> list[str]:
    """A sentence about the lowest of the other valleys, if its residuals are hardly larger."""
    others, bars = elsewhere(found, tried), np.sqrt(np.diag(found.coordinate_covariance))
    if not others:
        return []
    other, least = others[0], min(one.misfit for one in tried)
    independent = sum(part.frames * part.samples for part in found.parts)
    if 2.0 * independent * (other.misfit - least) > NO_LESS_LIKELY:
        return []
    k = int(np.argmax(np.abs(other.end - found.u) / np.maximum(bars, TINY)))
    label, value = found.labels[k], found.coordinates.numbers(other.end)[k]
    return [
        f"Another search ended where {label} is {value:.3g}, with residuals {np.exp(other.misfit - least):.3g} times "
        "as large: what was measured hardly tells which of both is right."
    ]
