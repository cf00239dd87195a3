"""Minimise the sum of squares in few runs: Gauss-Newton steps with a Jacobian estimated from earlier runs.

Predictions of particles are rough functions of a parameter: a surface's height jumps slightly when particles pass each
other. The derivative at a point may be many times steeper than the change over a standard error, which makes error bars
too small. So at the end of a search a forward run for each number checks predictions two standard errors away
(`over_the_bars`). If the tangents fail this check, differences over the width of the error bars replace them, and are
repeated until the bars no longer change.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from cortado.errors import DivergedError
from cortado.optimisation.fitting.certainty import Certainty, spread
from cortado.optimisation.fitting.least_squares import TINY, LeastSquares, Linearised, TrialPoints, Weighting

NEAR = 1e-6
"""A search also ends when a step is shorter than this, relative to the size of the coordinates."""
GREATEST_LOGARITHM = 1.0
"""Greatest change of a logarithm in one step: a positive number changes by a factor of e at most."""
FIRST_DAMPING, LEAST_DAMPING = 1e-2, 1e-4
"""First and least damping, relative to the Hessian's diagonal."""
POOR, GOOD = 0.25, 0.75
"""Shares of the predicted gain. After a step that gains less than the first share, damping grows tenfold; after a step
that gains more than the second, it is halved."""
MOST_FAILURES = 3
"""Number of failed trial points in succession after which the Jacobian is estimated again; after as many further
failures the search ends."""
NEARBY = 9.0
"""When a step is predicted to lower the sum of squares by less than this [squared standard errors], tangents are
computed."""
ENOUGH = 0.01
"""The search ends when the predicted decrease is less than this [squared standard errors]: a tenth of a standard
error."""
AS_NEAR_AS_CAN_BE = 0.1
"""The same threshold if no step lowers a rough sum of squares any more: three tenths of a standard error."""
ONE_BAR = 1.0
"""Tangents are computed again if the search ended further from the point of the last ones than this [squared standard
errors]."""
MOST_JACOBIANS = 4
"""Greatest number of Jacobians computed by tangents."""
REACH = 2.0
"""Distance of the checked predictions in standard errors, which is about the end of a 95 % interval."""
STRAIGHT = 0.3
"""Greatest accepted error of the change that tangents predict up to there, relative to this change."""
ROUNDING = 1e-5
"""Error bars that change predictions by less than this part of the largest measured number are not checked."""
MOST_ROUNDS = 8
"""Greatest number of rounds of differences; each round covers the error bars of the previous one."""
SETTLED = 0.3
"""A round is the last if it moves the estimate by less than this part of that distance, and changes every bar by less
than this part of itself."""
LEAST_SHARE = 0.1
"""Points nearer than this part of that distance, for example because of a bound, are not used for differences."""
ROUND_OFF = 1e-12
"""Round-off relative to a variance."""
RANGE = np.log(100.0)
"""Range of further starts for positive numbers without bounds: two decades to both sides of the first start."""
POINTS, MOST_POINTS = 8, 64
"""Numbers of points tried as starts: for each fitted number, and at most in total."""
APART = 0.2
"""Least distance between two starts, relative to the range of some number."""


@dataclass(frozen=True)
class Searched:
    """The end of a search: its last point, the next step, and the predicted gain of this step."""

    at: Linearised
    """The last point that was run; its Jacobian is an estimate."""
    next: np.ndarray
    """End of the next step (free,), where nothing was run."""
    gain: float
    """Predicted decrease of the sum of squares by the next step."""
    converged: bool


def least(problem: LeastSquares, at: Linearised, weights: Sequence[Weighting], trials: int) -> tuple[Linearised, bool]:
    """Find the least sum of squares: search with the estimated Jacobian as long as it helps, then with tangents. Return
    the minimum with its Jacobian by tangents and True, or the lowest point and False."""
    for _ in range(MOST_JACOBIANS):
        squares = max(problem.sum_of_squares(at.residuals, weights), TINY)
        found = search(problem, at, weights, trials, NEARBY / squares)
        try:
            exact = problem.linearised(found.next)
        except DivergedError:
            exact = problem.linearised(found.at.u)
        found = search(problem, exact, weights, trials, ENOUGH / squares)
        at, (J, _) = found.at, problem.stacked(exact, weights)
        is_near = bool(((J @ (found.next - exact.u)) ** 2).sum() <= ONE_BAR)
        if is_near or not found.converged:
            break
    if not found.converged:
        return Linearised(at.u, at.residuals, exact.jacobians), found.gain <= AS_NEAR_AS_CAN_BE
    residuals = [r + J @ (found.next - at.u) for r, J in zip(at.residuals, at.jacobians, strict=True)]
    return Linearised(found.next, residuals, exact.jacobians), is_near


def search(
    problem: LeastSquares,
    at: Linearised,
    weights: Sequence[Weighting],
    trials: int,
    enough: float,
    fixed: Sequence[int] = (),
) -> Searched:
    """Lower the sum of the squared residuals, until a step is predicted to lower it by a share of at most ``enough``.
    The Jacobian at the first point may be an estimate, and the coordinates of some numbers stay ``fixed``.

    Each trial point takes one forward run, and the Jacobian is estimated from all trial points, see `TrialPoints`.
    After a point that is not lower, or whose run diverges, steps are damped (Levenberg 1944, Marquardt 1963). After
    several such points the Jacobian is estimated again.
    """
    points, base = TrialPoints(problem, weights, at), 0
    failures, damping, lowest = 0, 0.0, problem.sum_of_squares(at.residuals, weights)
    for _ in range(trials):
        point, gain = next_point(problem, at, weights, 0.0, fixed)
        if gain <= enough * lowest or np.abs(point - at.u).max() <= NEAR * (NEAR + np.abs(at.u).max()):
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
        if share < POOR:
            damping = max(10.0 * damping, FIRST_DAMPING)
        elif share > GOOD:
            damping = damping / 2.0 if damping > LEAST_DAMPING else 0.0
    return Searched(at, *next_point(problem, at, weights, 0.0, fixed), False)


def next_point(
    problem: LeastSquares,
    at: Linearised,
    weights: Sequence[Weighting],
    damping: float = 0.0,
    fixed: Sequence[int] = (),
) -> tuple[np.ndarray, float]:
    """Return the minimum of the linear model's sum of squares within the bounds, and the decrease from the present
    value."""
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


def over_the_bars(
    problem: LeastSquares, at: Linearised, weights: Sequence[Weighting]
) -> tuple[Linearised, bool | None]:
    """Return the end of a search with differences over the width of the error bars, and whether they converged. Return
    None if the tangents pass the check."""
    axes = _axes(problem, at, weights)
    if all(_is_straight(problem, at, weights, axis) for axis in axes.T):
        return at, None
    at = Linearised(at.u, problem.residuals(at.u), at.jacobians)  # the end of a search was not run
    for _ in range(MOST_ROUNDS):
        at, tried = _differences(problem, at, weights, axes)
        point, _ = next_point(problem, at, weights)
        tried = [at, *tried, *_moved(problem, at, point - at.u)]
        ended = min(tried, key=lambda one: problem.sum_of_squares(one.residuals, weights))
        wider = _axes(problem, ended, weights)
        moved = np.abs(np.linalg.solve(wider, ended.u - at.u)).max()
        grown = np.linalg.norm(wider, axis=0) / np.linalg.norm(axes, axis=0) - 1.0
        at, axes = ended, np.where(grown < 0.0, 0.5 * (axes + wider), wider)  # else they alternate
        if max(moved, np.abs(grown).max()) <= SETTLED:
            return at, True
    return at, False


def _axes(problem: LeastSquares, at: Linearised, weights: Sequence[Weighting]) -> np.ndarray:
    """Return columns (free, free) of independent moves by `REACH` standard errors, each at most as long as a search
    step."""
    covariance = Certainty.of(problem, at, weights).covariance
    axes = REACH * np.linalg.cholesky(covariance + (ROUND_OFF * np.trace(covariance) + TINY) * np.eye(len(covariance)))
    logarithmic = problem.coordinates.by_logarithm
    longest = np.abs(axes[logarithmic]).max(axis=0, initial=TINY)
    return np.asarray(axes * np.minimum(1.0, GREATEST_LOGARITHM / longest))


def _is_straight(problem: LeastSquares, at: Linearised, weights: Sequence[Weighting], axis: np.ndarray) -> bool:
    """Test whether the tangents predict the residuals at the end of an axis, on the side that the search did not come
    from."""
    each = zip(problem.parts, at.jacobians, strict=True)
    if all(np.abs(J @ axis).max() <= ROUNDING * np.nanmax(np.abs(part.observation.measured)) for part, J in each):
        return True
    J, r = problem.stacked(at, weights)
    onwards = -1.0 if (problem.coordinates.start - at.u) @ axis > 0.0 else 1.0
    for way in (onwards, -onwards):
        for one in _moved(problem, at, way * axis):
            said = J @ (one.u - at.u)
            off = problem.stacked(one, weights)[1] - r - said
            return bool(np.linalg.norm(off) <= STRAIGHT * np.linalg.norm(said))
    return True


def _differences(
    problem: LeastSquares, at: Linearised, weights: Sequence[Weighting], axes: np.ndarray
) -> tuple[Linearised, list[Linearised]]:
    """Return the point with a Jacobian made of differences along the axes, and the points that were run for it.

    Among the two one-sided differences and the central one, the smallest is used. The point itself may lie on a kink,
    or in a minimum far narrower than the error bars."""
    tried, columns = list[Linearised](), list[list[np.ndarray]]()
    for axis in axes.T:
        ends = [*_moved(problem, at, axis), *_moved(problem, at, -axis)]
        pairs = [(a, b, float((b.u - a.u) @ axis / (axis @ axis))) for a, b in combinations([at, *ends], 2)]
        slopes = [  # by two points that are a share of the axis apart what changes along all of it, of each part
            [(after - before) / share for before, after in zip(a.residuals, b.residuals, strict=True)]
            for a, b, share in pairs
            if abs(share) > LEAST_SHARE
        ]
        slopes = slopes or [[J @ axis for J in at.jacobians]]
        columns.append(min(slopes, key=lambda one: problem.sum_of_squares(one, weights)))
        tried += ends
    inverse = np.linalg.inv(axes)
    jacobians = [np.stack(part, axis=-1) @ inverse for part in zip(*columns, strict=True)]
    return Linearised(at.u, at.residuals, jacobians), tried


def _moved(problem: LeastSquares, at: Linearised, shift: np.ndarray) -> list[Linearised]:
    """Return the point ``shift`` away, within the bounds, with this point's Jacobian; None if its run diverges."""
    point = np.clip(at.u + shift, *problem.coordinates.bounds)
    try:
        return [Linearised(point, problem.residuals(point), at.jacobians)] if (point != at.u).any() else []
    except DivergedError:
        return []


def misfit(problem: LeastSquares, residuals: list[np.ndarray]) -> float:
    """Return the logarithm of the residuals' size, averaged over all measured numbers. For Gaussian noise of unknown
    size, the smallest value is the most likely."""
    counts = [np.count_nonzero(~np.isnan(part.observation.measured)) for part in problem.parts]
    return float(np.average([np.log(max(spread(r), TINY)) for r in residuals], weights=counts))


def other_starts(problem: LeastSquares, count: int) -> list[np.ndarray]:
    """Return at most ``count`` points (free,), best first, of a Sobol sequence over the bounds, and over two decades to
    both sides of positive numbers without bounds. All other numbers are those of the start."""
    start, (lower, upper) = problem.coordinates.start, problem.coordinates.bounds
    reach = np.where(problem.coordinates.by_logarithm, RANGE, 0.0)
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
    """Return points (points, free) from 0 to 1 that cover each searched number evenly."""
    from scipy.stats import qmc

    dimensions = int(searched.sum())
    if not dimensions:
        return np.zeros((0, len(searched)))
    power = int(np.ceil(np.log2(min(POINTS * dimensions, MOST_POINTS))))
    points = np.zeros((2**power, len(searched)))
    points[:, searched] = qmc.Sobol(dimensions, scramble=False).random_base2(power) + 0.5 ** (power + 1)
    return points
