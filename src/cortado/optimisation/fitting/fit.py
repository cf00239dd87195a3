"""`cortado.fit`: the parameters of measured experiments, with error bars."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cortado.arrays import require_function, require_table, whole_number
from cortado.calls import public
from cortado.errors import ComputationError, DivergedError, InputError, shown
from cortado.optimisation.fitting.bar_slopes import over_the_bars
from cortado.optimisation.fitting.causes import dear_causes
from cortado.optimisation.fitting.certainty import Certainty, counted_covariance, noise_of, spread
from cortado.optimisation.fitting.coordinates import Coordinates
from cortado.optimisation.fitting.doubts import doubts_of
from cortado.optimisation.fitting.experiment import Experiment
from cortado.optimisation.fitting.fitted import Fit, Tried
from cortado.optimisation.fitting.least_squares import LeastSquares, Linearised, Weighting
from cortado.optimisation.fitting.other_starts import elsewhere, misfit, other_starts, other_valleys
from cortado.optimisation.fitting.search import least, search
from cortado.scene.parameters import Range

POSITIVE = (Range.POSITIVE, Range.NOT_NEGATIVE)
OTHERS = 3
"""Starts besides the one that was given, for a fit that ends in doubt."""
ROUGHLY = 1e-3
"""Of the sum of squares: the search of weights ends where a step lowers it by less, relative to itself."""


@public
def fit(
    experiments: Experiment | Sequence[Experiment],
    start: Mapping[str, Any],
    bounds: Mapping[str, tuple[Any, Any]] | None = None,
    iterations: int = 50,
    on_trial: Callable[[], None] | None = None,
    starts: int | None = None,
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
        starts: from how many starts to search; all but the first are chosen by forward runs over the bounds, or over
            two decades to both sides of a positive number. If left out, the fit searches from `start` alone, and from
            three others where that ends in doubt. The fit with the least residuals is returned, and where all of the
            searches ended is its ``tried``.

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
    starts = None if starts is None else whole_number("starts", starts, 1)
    known = each[0].simulation.known
    own = {name: value for one in each for name, value in one.start.items()}
    given = {**start, **{name: value for name, value in own.items() if name not in start}}
    if not given:
        raise InputError("start is empty, but must have a parameter to fit.")
    positive = [n for n in given if (n in known and known[n].range in POSITIVE) or n.endswith(".extinction")]
    unseen = {name: mask for one in each for name, mask in one.unseen.items()}
    clocks = {name: ends for one in each for name, ends in one.clocks.items()}
    coordinates = Coordinates.of(given, positive, {**clocks, **({} if bounds is None else bounds)}, unseen)
    problem = LeastSquares(each, coordinates, on_trial)
    found = _from(problem, coordinates.start, iterations)
    if starts != 1 and (starts is not None or found.in_doubt):
        found = _best(problem, found, iterations, starts)
    return _with_causes(problem, found) if found.doubts else found


def _from(problem: LeastSquares, start: np.ndarray, iterations: int) -> Fit:
    """From one start: a first search, with residuals as they are, and a second one with weights that they ask for."""
    at = problem.estimated(start)
    sizes = [part.observation.noise or spread(r) or 1.0 for part, r in zip(problem.parts, at.residuals, strict=True)]
    weights = [Weighting(size) for size in sizes]
    at = search(problem, at, weights, iterations, ROUGHLY).at
    weights = noise_of(problem, at, weights)
    at, converged = least(problem, at, weights, iterations)
    at, settled = over_the_bars(problem, at, weights)
    return _fitted(problem, at, weights, converged if settled is None else settled, start)


def _with_causes(problem: LeastSquares, found: Fit) -> Fit:
    """With causes of its doubts that take runs to be looked at."""
    assert found.at is not None
    causes = dear_causes(problem, found.at, [part.weighting for part in found.parts])
    return replace(found, doubts=(*found.doubts, *causes), runs=problem.runs, tangents=problem.tangents)


def _best(problem: LeastSquares, found: Fit, iterations: int, starts: int | None) -> Fit:
    """Of this fit and of those from other starts that with the least residuals. Where it is not said how many, one
    without doubt is the last, or one that ends where all others did."""
    tried = list(found.tried)
    for start in other_starts(problem, OTHERS if starts is None else starts - 1):
        try:
            other = _from(problem, start, iterations)
        except (ComputationError, DivergedError):  # there, nothing is told
            continue
        tried += other.tried
        if other.tried[0].misfit < min(one.misfit for one in found.tried):
            found = other
        if starts is None and not (found.in_doubt and elsewhere(found, tried)):
            break
    doubts = (*found.doubts, *other_valleys(found, tried))
    counted = replace(found, runs=problem.runs, tangents=problem.tangents, refused=problem.refused)
    return replace(counted, tried=tuple(tried), doubts=doubts)


def _fitted(
    problem: LeastSquares, at: Linearised, weights: Sequence[Weighting], converged: bool, start: np.ndarray
) -> Fit:
    """With the covariance, and what the residuals say of the noise and of the model."""
    found = Certainty.of(problem, at, weights)
    return Fit(
        coordinates=problem.coordinates,
        u=at.u,
        coordinate_covariance=found.covariance,
        naive_covariance=counted_covariance(problem, at, weights),
        degrees_of_freedom=found.degrees_of_freedom,
        parts=found.parts,
        doubts=doubts_of(problem, at, weights, found),
        converged=converged,
        tried=(Tried(start, at.u, misfit(problem, at.residuals)),),
        runs=problem.runs,
        tangents=problem.tangents,
        refused=problem.refused,
        sum_of_squares=problem.sum_of_squares(at.residuals, weights),
        hessian=found.hessian,
        problem=problem,
        at=at,
    )
