"""Minimise the sum of squares in few runs, by Gauss-Newton steps. The Jacobian is estimated from earlier runs.

Predictions of particle simulations are rough functions of a parameter. A derivative may be much greater than the mean
slope over one standard error. Error bars from such a derivative are too small. At the end of a search, `over_the_bars`
runs simulations two standard errors away from the minimum. If the derivatives do not predict the results of these
simulations, finite differences over two standard errors replace the derivatives.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from cortado.errors import DivergedError
from cortado.optimisation.fitting.certainty import Certainty, spread
from cortado.optimisation.fitting.least_squares import TINY, LeastSquares, Linearised, TrialPoints, Weights

GREATEST_LOGARITHM = 1.0
MOST_FAILURES = 3
"""Number of successive failed trial points before the Jacobian is estimated again."""
REACH = 2.0
"""Distance from the minimum at which the derivatives are checked [standard errors]."""


@dataclass(frozen=True)
class Searched:
    at: Linearised
    """Last point, with an estimated Jacobian."""
    next: np.ndarray
    """Next trial point (free,). No simulation was run at this point."""
    gain: float
    converged: bool


def least(problem: LeastSquares, at: Linearised, weights: Weights, trials: int) -> tuple[Linearised, bool]:
    """Return the point with the lowest sum of squares, and True if the search converged."""
    for _ in range(4):
        squares = max(problem.sum_of_squares(at.residuals, weights), TINY)
        found = search(problem, at, weights, trials, 9.0 / squares)  # a decrease of three standard errors
        try:
            exact = problem.linearised(found.next)
        except DivergedError:
            exact = problem.linearised(found.at.u)
        found = search(problem, exact, weights, trials, 0.01 / squares)  # a tenth of a standard error
        at, (J, _) = found.at, problem.stacked(exact, weights)
        is_near = bool(((J @ (found.next - exact.u)) ** 2).sum() <= 1.0)  # one standard error from the tangents' point
        if is_near or not found.converged:
            break
    if not found.converged:  # no step lowers a rough sum of squares: three tenths of a standard error suffice
        return Linearised(at.u, at.residuals, exact.jacobians), found.gain <= 0.1
    residuals = [r + J @ (found.next - at.u) for r, J in zip(at.residuals, at.jacobians, strict=True)]
    return Linearised(found.next, residuals, exact.jacobians), is_near


def search(
    problem: LeastSquares, at: Linearised, weights: Weights, trials: int, enough: float, fixed: Sequence[int] = ()
) -> Searched:
    """Reduce the sum of squares until the next step would reduce the sum by less than the fraction ``enough``.

    The coordinates ``fixed`` stay constant. Each trial point needs one forward run. If the sum of squares does not fall
    or the run diverges, the next step is damped (Levenberg 1944, Marquardt 1963).
    """
    points, base = TrialPoints(problem, weights, at), 0
    failures, damping, lowest = 0, 0.0, problem.sum_of_squares(at.residuals, weights)
    for _ in range(trials):
        point, gain = next_point(problem, at, weights, 0.0, fixed)
        if gain <= enough * lowest or np.abs(point - at.u).max() <= 1e-6 * (1e-6 + np.abs(at.u).max()):
            return Searched(at, point, gain, True)
        if damping:
            point, gain = next_point(problem, at, weights, damping, fixed)
        try:
            residuals = problem.residuals(point)
            squares = problem.sum_of_squares(residuals, weights)
        except DivergedError:
            squares = np.inf
        number = points.add(point, residuals) if np.isfinite(squares) else base
        share = (lowest - squares) / max(gain, TINY)
        if share > 0.0:
            lowest, base, failures = squares, number, 0
        else:
            failures += 1
        if failures == 2 * MOST_FAILURES:
            break
        is_stuck = failures == MOST_FAILURES
        at = problem.estimated(at.u) if is_stuck else points.linearised(base)
        if is_stuck or points.are_many:
            points, base = TrialPoints(problem, weights, at), 0
        if share < 0.25:
            damping = max(10.0 * damping, 1e-2)  # relative to the Hessian's diagonal
        elif share > 0.75:
            damping = damping / 2.0 if damping > 1e-4 else 0.0
    return Searched(at, *next_point(problem, at, weights, 0.0, fixed), False)


def next_point(
    problem: LeastSquares, at: Linearised, weights: Weights, damping: float = 0.0, fixed: Sequence[int] = ()
) -> tuple[np.ndarray, float]:
    """Return the minimum (free,) of the linear model within the bounds, and the decrease of the sum of squares."""
    from scipy.optimize import lsq_linear

    free = np.setdiff1d(np.arange(len(at.u)), fixed)
    if not len(free):
        return at.u, 0.0
    J, r = problem.stacked(at, weights)
    reduced: Any = np.linalg.qr(np.column_stack([J[:, free], r]), mode="r")
    R, q = reduced[:, :-1], reduced[:, -1]
    damped = np.vstack([R, np.diag(np.sqrt(damping) * np.linalg.norm(R, axis=0))])
    reach = np.where(problem.coordinates.by_logarithm, GREATEST_LOGARITHM, np.inf)
    lower, upper = problem.coordinates.bounds
    ends = np.maximum(lower - at.u, -reach)[free], np.minimum(upper - at.u, reach)[free]
    shift = lsq_linear(damped, np.append(-q, np.zeros(len(free))), ends, method="bvls").x
    point = at.u.copy()
    point[free] = np.clip(at.u[free] + shift, lower[free], upper[free])
    return point, float((q**2).sum() - ((R @ shift + q) ** 2).sum())


def over_the_bars(problem: LeastSquares, at: Linearised, weights: Weights) -> tuple[Linearised, bool | None]:
    """Replace wrong derivatives by finite differences over `REACH` standard errors. The second result is None without
    replacement, True if the differences converged, and False otherwise."""
    axes = _axes(problem, at, weights)
    if all(_is_straight(problem, at, weights, axis) for axis in axes.T):
        return at, None
    at = Linearised(at.u, problem.residuals(at.u), at.jacobians)  # the end of a search was not run
    for _ in range(8):
        at, tried = _differences(problem, at, weights, axes)
        point, _ = next_point(problem, at, weights)
        tried = [at, *tried, *_moved(problem, at, point - at.u)]
        ended = min(tried, key=lambda one: problem.sum_of_squares(one.residuals, weights))
        wider = _axes(problem, ended, weights)
        moved = np.abs(np.linalg.solve(wider, ended.u - at.u)).max()
        grown = np.linalg.norm(wider, axis=0) / np.linalg.norm(axes, axis=0) - 1.0
        at, axes = ended, np.where(grown < 0.0, 0.5 * (axes + wider), wider)  # else they alternate
        if max(moved, np.abs(grown).max()) <= 0.3:
            return at, True
    return at, False


def _axes(problem: LeastSquares, at: Linearised, weights: Weights) -> np.ndarray:
    """Return a matrix (free, free) whose columns are uncorrelated displacements of `REACH` standard errors."""
    covariance = Certainty.of(problem, at, weights).covariance
    axes = REACH * np.linalg.cholesky(covariance + (1e-12 * np.trace(covariance) + TINY) * np.eye(len(covariance)))
    longest = np.abs(axes[problem.coordinates.by_logarithm]).max(axis=0, initial=TINY)
    return np.asarray(axes * np.minimum(1.0, GREATEST_LOGARITHM / longest))


def _is_straight(problem: LeastSquares, at: Linearised, weights: Weights, axis: np.ndarray) -> bool:
    """Return True if the Jacobian predicts the residuals after the displacement ``axis``."""
    each = zip(problem.parts, at.jacobians, strict=True)
    if all(np.abs(J @ axis).max() <= 1e-5 * np.nanmax(np.abs(part.observation.measured)) for part, J in each):
        return True
    J, r = problem.stacked(at, weights)
    onwards = -1.0 if (problem.coordinates.start - at.u) @ axis > 0.0 else 1.0
    for way in (onwards, -onwards):
        for one in _moved(problem, at, way * axis):
            said = J @ (one.u - at.u)
            off = problem.stacked(one, weights)[1] - r - said
            return bool(np.linalg.norm(off) <= 0.3 * np.linalg.norm(said))
    return True


def _differences(
    problem: LeastSquares, at: Linearised, weights: Weights, axes: np.ndarray
) -> tuple[Linearised, list[Linearised]]:
    """Return the point with a Jacobian of finite differences along the axes, and all simulated points. The smallest of
    two one-sided differences and the central difference is used, because the point may lie on a kink."""
    tried, columns = list[Linearised](), list[list[np.ndarray]]()
    for axis in axes.T:
        ends = [*_moved(problem, at, axis), *_moved(problem, at, -axis)]
        pairs = [(a, b, float((b.u - a.u) @ axis / (axis @ axis))) for a, b in combinations([at, *ends], 2)]
        slopes = [  # derivatives of each part's residuals along the axis; points may be close because of a bound
            [(after - before) / share for before, after in zip(a.residuals, b.residuals, strict=True)]
            for a, b, share in pairs
            if abs(share) > 0.1
        ]
        slopes = slopes or [[J @ axis for J in at.jacobians]]
        columns.append(min(slopes, key=lambda one: problem.sum_of_squares(one, weights)))
        tried += ends
    inverse = np.linalg.inv(axes)
    jacobians = [np.stack(part, axis=-1) @ inverse for part in zip(*columns, strict=True)]
    return Linearised(at.u, at.residuals, jacobians), tried


def _moved(problem: LeastSquares, at: Linearised, shift: np.ndarray) -> list[Linearised]:
    """Return a list with the displaced, clipped point. The list is empty if the run diverges or the point stays."""
    point = np.clip(at.u + shift, *problem.coordinates.bounds)
    try:
        return [Linearised(point, problem.residuals(point), at.jacobians)] if (point != at.u).any() else []
    except DivergedError:
        return []


def misfit(problem: LeastSquares, residuals: list[np.ndarray]) -> float:
    """Return the mean logarithm of the residuals' size. The likelihood for Gaussian noise falls with this mean."""
    counts = [np.count_nonzero(~np.isnan(part.observation.measured)) for part in problem.parts]
    return float(np.average([np.log(max(spread(r), TINY)) for r in residuals], weights=counts))


def other_starts(problem: LeastSquares, count: int) -> list[np.ndarray]:
    """Return at most ``count`` starts (free,) from a Sobol sequence, with the smallest `misfit` first. Positive
    parameters without bounds vary by a factor of 100 up and down. Other parameters without bounds do not vary."""
    from scipy.stats import qmc

    start, (lower, upper) = problem.coordinates.start, problem.coordinates.bounds
    reach = np.where(problem.coordinates.by_logarithm, np.log(100.0), 0.0)
    lower = np.where(np.isfinite(lower), lower, start - reach)
    upper = np.where(np.isfinite(upper), upper, start + reach)
    searched, found, chosen = upper > lower, [], list[np.ndarray]()
    if not (dimensions := int(searched.sum())):
        return []
    power = int(np.ceil(np.log2(min(8 * dimensions, 64))))
    shares = np.zeros((2**power, len(searched)))
    shares[:, searched] = qmc.Sobol(dimensions, scramble=False).random_base2(power) + 0.5 ** (power + 1)
    for point in lower + (upper - lower) * shares:
        try:
            found.append((misfit(problem, problem.residuals(point)), point))
        except DivergedError:
            continue
    for _, point in sorted(found, key=lambda one: one[0]):
        away = [np.abs(point - one) / np.maximum(upper - lower, TINY) for one in chosen]
        if len(chosen) < count and all(one.max() > 0.2 for one in away):
            chosen.append(point)
    return chosen
