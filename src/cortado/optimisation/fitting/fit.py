"""`cortado.fit`: the parameters of measured experiments, with error bars."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from cortado.arrays import require_function, require_table, whole_number
from cortado.errors import ComputationError, InputError, shown
from cortado.optimisation.fitting.coordinates import Coordinates
from cortado.optimisation.fitting.doubts import doubts
from cortado.optimisation.fitting.experiment import Experiment
from cortado.optimisation.fitting.fitted import Fit, FittedPart
from cortado.optimisation.fitting.least_squares import LeastSquares, Linearised, Weighting
from cortado.optimisation.fitting.noise import ScoreCovariance, correlation_time, independent_frames, score_covariance
from cortado.optimisation.fitting.search import least, search
from cortado.scene.parameters.parameter import Range

POSITIVE = (Range.POSITIVE, Range.NOT_NEGATIVE)
ROUGHLY = 1e-3
"""Of the sum of squares: the search of weights ends where a step lowers it by less, relative to itself."""
SINGULAR = 1e-10
"""Relative: where the Hessian has an eigenvalue below, a combination of parameters cannot be told."""


def fit(
    experiments: Experiment | Sequence[Experiment],
    start: Mapping[str, Any],
    bounds: Mapping[str, tuple[Any, Any]] | None = None,
    iterations: int = 50,
    on_trial: Callable[[], None] | None = None,
) -> Fit:
    """Fit parameters to measured experiments by least squares, and say how certain they are.

    Each residual is what a simulation predicts less what was measured. The search estimates the Jacobian by a forward
    run for each number; at its end forward-mode tangents give it. The first fit takes residuals as they are. Their
    scatter and correlation then weight the second one, from whose residuals the error bars come (see
    `cortado.optimisation.fitting.noise`).

    Args:
        experiments: one `measured.Experiment`, or several that have these parameters in common.
        start: parameters by name, as the fit starts. Positive ones, such as a viscosity, are searched by their
            logarithm. What videos calibrate is added by itself, as the cameras were aimed.
        bounds: by name, (lower, upper), each a number, an array of the parameter's shape, or None. A number whose
            bounds are the same is not searched.
        iterations: greatest number of trial points of each of the two fits.
        on_trial: called after each trial point.

    Raises:
        InputError: a start, bounds or experiments that do not fit.
        DivergedError: the run at the start diverges.
        ComputationError: what was measured does not tell some of the parameters.
    """
    each = [experiments] if isinstance(experiments, Experiment) else experiments
    if not isinstance(each, list | tuple) or not all(isinstance(one, Experiment) for one in each):
        raise InputError(f"experiments is {shown(experiments)}, but must be a cortado.measured.Experiment, or a list.")
    if not each:
        raise InputError("experiments is empty, but must have one experiment at least.")
    require_table("start", start, "{'viscosity': 1.0}")
    require_function("on_trial", on_trial)
    iterations = whole_number("iterations", iterations, 1)
    known = each[0].simulation.known
    own = {name: value for one in each for name, value in one.start.items()}
    given = {**start, **{name: value for name, value in own.items() if name not in start}}
    if not given:
        raise InputError("start is empty, but must have a parameter to fit.")
    positive = [n for n in given if (n in known and known[n].range in POSITIVE) or n.endswith(".extinction")]
    unseen = {name: mask for one in each for name, mask in one.unseen.items()}
    coordinates = Coordinates.of(given, positive, bounds, unseen)
    problem = LeastSquares(each, coordinates, on_trial)
    at = problem.estimated(coordinates.start)
    sizes = [part.observation.noise or _spread(r) or 1.0 for part, r in zip(problem.parts, at.residuals, strict=True)]
    weights = [Weighting(size) for size in sizes]
    at = search(problem, at, weights, iterations, ROUGHLY).at
    weights = _noise_of(problem, at, weights)
    return _fitted(problem, *least(problem, at, weights, iterations), weights)


def _noise_of(problem: LeastSquares, at: Linearised, weights: Sequence[Weighting]) -> list[Weighting]:
    """Weights that the residuals of a first fit ask for: correlated numbers weigh less, as they tell less."""
    inverse = _inverse(problem, _hessian(problem, at, weights))
    found = []
    for part, r, J, weight in zip(problem.parts, at.residuals, at.jacobians, weights, strict=True):
        times, size = part.observation.times, part.observation.noise or _spread(r) or weight.scale
        time = correlation_time(weight.of(J, times), weight.of(r, times), inverse, times)
        own = Weighting(size, time)
        found.append(Weighting(size * np.sqrt(_inflation(own.of(J, times), own.of(r, times))), time))
    return found


def _inflation(J: np.ndarray, r: np.ndarray) -> float:
    """By how much correlation within frames makes the variance of the score larger than a count of numbers has it."""
    counted = np.einsum("fmp,fmp->p", J, J) * np.mean(r**2)
    pooled = np.einsum("fmp,hm->fhp", J, r, optimize=True)
    has = counted > 0.0
    return float(np.mean((pooled**2).sum(axis=(0, 1))[has] / len(r) / counted[has])) if has.any() else 1.0


def _fitted(problem: LeastSquares, at: Linearised, converged: bool, weights: Sequence[Weighting]) -> Fit:
    """With the covariance, and what the residuals say of the noise and of the model."""
    coordinates = problem.coordinates
    hessian = _hessian(problem, at, weights)
    inverse = _inverse(problem, hessian)
    scores = list[ScoreCovariance]()
    parts = list[FittedPart]()
    for part, r, J, weight in zip(problem.parts, at.residuals, at.jacobians, weights, strict=True):
        times = part.observation.times
        frames = independent_frames(times, weight.correlation_time)
        white, slopes = weight.of(r, times), weight.of(J, times)
        score = score_covariance(slopes, white, inverse, frames)
        scores.append(score)
        parts.append(FittedPart(part, weight, r, _spread(r), _inflation(slopes, white), score.samples, frames))
    covariance = inverse @ sum(score.B for score in scores) @ inverse
    freedom = np.array([_freedom(scores, inverse, unit) for unit in np.eye(len(at.u))])
    squares = problem.sum_of_squares(at.residuals, weights)
    found = Fit(
        coordinates=coordinates,
        u=at.u,
        coordinate_covariance=covariance,
        naive_covariance=_counted(problem, at, weights),
        degrees_of_freedom=freedom,
        parts=tuple(parts),
        doubts=doubts(problem, at, weights, scores, coordinates.labels),
        converged=converged,
        runs=problem.runs,
        tangents=problem.tangents,
        sum_of_squares=squares,
        hessian=hessian,
        problem=problem,
        at=at,
    )
    return found


def _hessian(problem: LeastSquares, at: Linearised, weights: Sequence[Weighting]) -> np.ndarray:
    """N = J^T J of weighted Jacobians."""
    each = zip(problem.parts, at.jacobians, weights, strict=True)
    flat = (weight.of(J, part.observation.times).reshape(-1, len(at.u)) for part, J, weight in each)
    return np.asarray(sum(J.T @ J for J in flat))


def _inverse(problem: LeastSquares, hessian: np.ndarray) -> np.ndarray:
    """N^-1; raises `ComputationError` where a combination of parameters cannot be told."""
    labels, size = problem.coordinates.labels, np.sqrt(np.diag(hessian))
    if not np.isfinite(hessian).all():
        raise ComputationError("The derivatives are not finite: try fewer steps, or float64.")
    if not size.all():
        lost = [label for label, s in zip(labels, size, strict=True) if not s]
        raise ComputationError(f"What was measured does not depend on {', '.join(lost)}: leave it out of the fit.")
    eigenvalues, axes = np.linalg.eigh(hessian / np.outer(size, size))
    if eigenvalues[0] < SINGULAR:
        mixed = [label for label, a in zip(labels, axes[:, 0], strict=True) if abs(a) > 0.1]
        raise ComputationError(
            f"What was measured does not tell {' and '.join(mixed)} apart at all: leave one of them out of the fit, or "
            "measure something else besides."
        )
    return np.asarray((axes / eigenvalues) @ axes.T / np.outer(size, size))


def _counted(problem: LeastSquares, at: Linearised, weights: Sequence[Weighting]) -> np.ndarray:
    """The covariance where every number was taken for independent of all others."""
    alone = [Weighting(_spread(r) or weight.scale) for r, weight in zip(at.residuals, weights, strict=True)]
    return _inverse(problem, _hessian(problem, at, alone))


def _freedom(scores: Sequence[ScoreCovariance], inverse: np.ndarray, direction: np.ndarray) -> float:
    """Degrees of freedom of a number's variance, which is a sum over parts (Welch 1947)."""
    a = inverse @ direction
    variances = np.array([a @ score.B @ a for score in scores])
    each = np.array([score.degrees_of_freedom(inverse, direction) for score in scores])
    return float(variances.sum() ** 2 / (variances**2 / each).sum()) if variances.any() else float(each.min())


def _spread(r: np.ndarray) -> float:
    """Root mean square of the numbers that count."""
    count = np.count_nonzero(r)
    return float(np.sqrt((r**2).sum() / max(count, 1)))
