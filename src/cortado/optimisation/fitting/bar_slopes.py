"""Slopes over the width of the error bars, where tangents only tell those of a wiggle.

What particles predict is a rough function of a parameter: the height of a surface moves in small jumps, as particles
pass each other. Its derivative at a point may be many times as steep as what a change by a standard error does, and
bars from it are as many times too small. So a forward run for each number looks two standard errors away. Where that is
not what the tangents say, differences over the width of the bars replace them, until the bars that follow are those
that the differences were taken over.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from cortado.errors import DivergedError
from cortado.optimisation.fitting.certainty import Certainty
from cortado.optimisation.fitting.least_squares import LeastSquares, Linearised, Weighting
from cortado.optimisation.fitting.search import GREATEST_LOGARITHM, TINY, next_point

REACH = 2.0
"""Standard errors, to about the ends of intervals of 95 %: how far away it looks."""
STRAIGHT = 0.3
"""Of what tangents say of the change up to there: by so much it may be off."""
ROUNDING = 1e-5
"""Of the largest number measured: bars that change what is predicted by less are not looked at."""
MOST_ROUNDS = 8
"""Of differences, each over the bars of the one before."""
SETTLED = 0.3
"""Of that distance: a round that moves the estimate by less, and changes no bar by more of itself, is the last."""
LEAST_SHARE = 0.1
"""Of that distance: nearer points, as at a bound, tell no difference."""
ROUND_OFF = 1e-12
"""Of a variance."""


def over_the_bars(
    problem: LeastSquares, at: Linearised, weights: Sequence[Weighting]
) -> tuple[Linearised, bool | None]:
    """The end of a search with slopes that hold over the width of the bars, and whether they settled; None where the
    tangents do hold."""
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
    """(free, free) columns of independent moves by so many standard errors, none longer than a step of a search."""
    covariance = Certainty.of(problem, at, weights).covariance
    axes = REACH * np.linalg.cholesky(covariance + (ROUND_OFF * np.trace(covariance) + TINY) * np.eye(len(covariance)))
    logarithmic = problem.coordinates.logarithmic[problem.coordinates.free]
    longest = np.abs(axes[logarithmic]).max(axis=0, initial=TINY)
    return np.asarray(axes * np.minimum(1.0, GREATEST_LOGARITHM / longest))


def _is_straight(problem: LeastSquares, at: Linearised, weights: Sequence[Weighting], axis: np.ndarray) -> bool:
    """Whether at the end of an axis it is as the tangents say, on the side to which the search did not get."""
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
    """The same point with differences along the axes as its Jacobian, and the points that were run for them.

    Of the differences to both sides and of that across the one in which least changes is taken: the point itself may
    lie on a kink, or in a hole that is far narrower than the bars."""
    tried, columns = list[Linearised](), list[list[np.ndarray]]()
    for axis in axes.T:
        ends = [*_moved(problem, at, axis), *_moved(problem, at, -axis)]
        pairs = [(a, b, float((b.u - a.u) @ axis / (axis @ axis))) for a, b in combinations([at, *ends], 2)]
        slopes = [_difference(a, b, share) for a, b, share in pairs if abs(share) > LEAST_SHARE]
        slopes = slopes or [[J @ axis for J in at.jacobians]]
        columns.append(min(slopes, key=lambda one: problem.sum_of_squares(one, weights)))
        tried += ends
    inverse = np.linalg.inv(axes)
    jacobians = [np.stack(part, axis=-1) @ inverse for part in zip(*columns, strict=True)]
    return Linearised(at.u, at.residuals, jacobians), tried


def _difference(a: Linearised, b: Linearised, share: float) -> list[np.ndarray]:
    """What changes along a whole axis, of each part, by two points that are a share of it apart."""
    return [(after - before) / share for before, after in zip(a.residuals, b.residuals, strict=True)]


def _moved(problem: LeastSquares, at: Linearised, shift: np.ndarray) -> list[Linearised]:
    """The point that is so far away, within the bounds, with the Jacobian of this one; none where its run diverges."""
    point = np.clip(at.u + shift, *problem.coordinates.bounds)
    try:
        return [Linearised(point, problem.residuals(point), at.jacobians)] if (point != at.u).any() else []
    except DivergedError:
        return []
