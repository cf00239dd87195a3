"""The search for the least sum of squares, in few runs: Gauss and Newton's steps, with a Jacobian that runs tell."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cortado.errors import DivergedError
from cortado.optimisation.fitting.least_squares import LeastSquares, Linearised, Weighting
from cortado.optimisation.fitting.trial_points import TINY, TrialPoints

NEAR = 1e-6
"""A search ends, too, where a step is shorter than this, relative to the size of the coordinates."""
GREATEST_LOGARITHM = 1.0
"""Of one step: a positive number changes by a factor of e at most."""
FIRST_DAMPING, LEAST_DAMPING = 1e-2, 1e-4
"""Relative to the Hessian's diagonal."""
POOR, GOOD = 0.25, 0.75
"""Shares of the predicted gain: after a step that gains less, the next one is damped ten times as much; after one that
gains more, half as much."""
MOST_FAILURES = 3
"""Trial points in succession that are no lower: then the Jacobian is estimated anew, and after as many more it ends."""

NEARBY = 9.0
"""In squared standard errors: where a step is predicted to lower the sum of squares by less, tangents are taken."""
ENOUGH = 0.01
"""The same of the end: a tenth of a standard error."""
AS_NEAR_AS_CAN_BE = 0.1
"""The same where no step lowers a rough sum of squares any more: three tenths of a standard error."""
ONE_BAR = 1.0
"""The same of the way from where tangents were taken to the end: if it is longer, they are taken again."""
MOST_JACOBIANS = 4
"""By tangents."""


@dataclass(frozen=True)
class Searched:
    """Where a search ended."""

    at: Linearised
    """The last point that was run; its Jacobian is an estimate."""
    next: np.ndarray
    """(free,) where the next step leads, which was not run."""
    gain: float
    """By how much that lowers the sum of squares of the linear model."""
    converged: bool


def least(problem: LeastSquares, at: Linearised, weights: Sequence[Weighting], trials: int) -> tuple[Linearised, bool]:
    """Where the sum of squares is least, with the Jacobian by tangents near there; and whether it was found, else the
    lowest point that was run: a search up to where its estimate of the Jacobian serves, tangents, and a search from
    there with these."""
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
    """Lower the sum of the squared residuals, from a point whose Jacobian may be an estimate, until a step is predicted
    to lower it by a share of at most ``enough``, with the coordinates of some numbers ``fixed``.

    A trial point takes one forward run, also one that is no lower, and the Jacobian follows from all of them, see
    `trial_points`. After one that is no lower, or where the run diverges, steps are damped (Levenberg 1944, Marquardt
    1963); after several the Jacobian is estimated anew.
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
    """Where the sum of squares of the linear model is least, within the bounds, and by how much it is lower there."""
    from scipy.optimize import lsq_linear

    free = np.setdiff1d(np.arange(len(at.u)), fixed)
    if not len(free):
        return at.u, 0.0
    J, r = problem.stacked(at, weights)
    reduced: Any = np.linalg.qr(np.column_stack([J[:, free], r]), mode="r")
    R, q = reduced[:, :-1], reduced[:, -1]
    damped = np.vstack([R, np.diag(np.sqrt(damping) * np.linalg.norm(R, axis=0))])
    reach = np.where(problem.coordinates.logarithmic[problem.coordinates.free], GREATEST_LOGARITHM, np.inf)
    lower, upper = problem.coordinates.bounds
    ends = np.maximum(lower - at.u, -reach)[free], np.minimum(upper - at.u, reach)[free]
    shift = lsq_linear(damped, np.append(-q, np.zeros(len(free))), ends, method="bvls").x
    point = at.u.copy()
    point[free] = np.clip(at.u[free] + shift, lower[free], upper[free])
    return point, float((q**2).sum() - ((R @ shift + q) ** 2).sum())
