"""Sentences on possible errors of a fitted model, if the residuals do not look like noise.

Possible errors are a trend, a late clock, a wrong density, or slipping walls. Each of these causes changes the
predictions along a known direction. A fit that includes the changes gives the size of each change, with an error bar.
"""

import warnings
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cortado.errors import ComputationError, CortadoWarning, DivergedError, InputError
from cortado.optimisation.fitting.certainty import Certainty, hessian, inverse, noise_of, spread
from cortado.optimisation.fitting.experiment import Experiment
from cortado.optimisation.fitting.least_squares import LeastSquares, Linearised, Weights, weighted
from cortado.optimisation.fitting.observations import CLOCK
from cortado.scene.parameter_values import Arrays

TOO_LARGE_IN_MOTION = 2.0
"""Least ratio of the residuals of changing numbers to the residuals of constant numbers for a doubt."""
EXACT = 1e-4
"""Residuals below this fraction of the largest measured number count as zero."""


def doubts_of(problem: LeastSquares, at: Linearised, weights: Weights, certainty: Certainty) -> tuple[str, ...]:
    found, is_exact = list[str](), True
    for part, r, weight in zip(problem.parts, at.residuals, weights, strict=True):
        times, noise, size = part.observation.times, part.observation.noise, spread(r)
        if size <= EXACT * np.nanmax(np.abs(part.observation.measured)):
            continue
        is_exact = False
        if noise is not None and size > 1.3 * noise:
            against = f"{size:.2g} against {noise:.2g} {part.observation.unit}"
            given = f"are {size / noise:.2g} times the noise that was given ({against})"
            found.append(f"The residuals of {part.label} {given}: the model has an error of this size.")
        still, moving = still_and_moving(part.observation.measured, r)
        if moving > TOO_LARGE_IN_MOTION * still:
            found.append(
                f"The residuals of {part.label} are {moving / still:.2g} times as large where the model changes as "
                f"where the model is constant ({moving:.2g} against {still:.2g} {part.observation.unit}): the "
                "model has an error of this size in motion, and the error bars are too small."
            )
        length = times[-1] - times[0]
        if weight.correlation_time > 0.35 * length:
            found.append(
                f"The residuals of {part.label} hardly change from frame to frame: the correlation time is "
                f"{weight.correlation_time:.2g} s in a record of {length:.2g} s. Noise is seldom so slow. The model "
                f"probably has an error of about {size:.2g} {part.observation.unit}, and the error bars are too small."
            )
    if not is_exact:
        found += _halves(problem, at, weights, certainty) + _trends_and_clocks(problem, at, weights)
    coordinates, bars = problem.coordinates, np.sqrt(np.diag(certainty.covariance))
    for which, ends in zip(("lower", "upper"), coordinates.bounds, strict=True):
        for label, u, end, value in zip(problem.labels, at.u, ends, coordinates.numbers(at.u), strict=True):
            if np.isfinite(end) and abs(u - end) <= 1e-6 * max(abs(end), 1.0):
                asked = "the measurements fit better beyond the bound, and the error bar is meaningless"
                found.append(f"{label} is {value:.4g}, its {which} bound: {asked}.")
    for label, bar in zip(problem.labels, np.where(coordinates.by_logarithm, bars, 0.0), strict=True):
        if bar > 1.0:
            factor = np.exp(min(bar, 20.0))
            found.append(f"The measurements hardly determine {label}: one standard error is a factor of {factor:.2g}.")
    return tuple(found)


def still_and_moving(measured: np.ndarray, r: np.ndarray) -> tuple[float, float]:
    """Return the root mean square residuals of constant numbers, such as a background, and of changing numbers."""
    change = np.ptp(measured + r, axis=0)
    counted = ~np.isnan(change)
    still = counted & (change <= 0.01 * np.max(change[counted], initial=0.0))
    if still.sum() < 20 or not (counted & ~still).any():
        return np.inf, 0.0
    quiet, moving = (float(np.sqrt(np.mean(r[:, chosen] ** 2))) for chosen in (still, counted & ~still))
    return max(quiet, 0.002 * float(np.nanmax(np.abs(measured)))), moving  # half a step of 8 bits


def _halves(problem: LeastSquares, at: Linearised, weights: Weights, certainty: Certainty) -> list[str]:
    """Return a sentence for each parameter that differs between fits of the first and the second half of the frames."""
    size, steps, variances = len(at.u), [], []
    white, slopes = (weighted(problem.parts, weights, own) for own in (at.residuals, at.jacobians))
    for half in (0, 1):
        N, s, B = np.zeros((size, size)), np.zeros(size), np.zeros((size, size))
        for r, J, score in zip(white, slopes, certainty.scores, strict=True):
            chosen = np.array_split(np.arange(len(r)), 2)[half]
            N += np.einsum("fmp,fmq->pq", J[chosen], J[chosen], optimize=True)
            s += np.einsum("fmp,fm->p", J[chosen], r[chosen], optimize=True)
            B += score.products.S[chosen, chosen].sum(axis=0) / (1.0 - score.lost)
        if np.linalg.cond(N) > 1e10:
            return []
        inverse = np.linalg.inv(N)
        steps.append(-inverse @ s)
        variances.append(np.diag(inverse @ B @ inverse))
    away = np.abs(steps[0] - steps[1]) / np.sqrt(variances[0] + variances[1] + 1e-300)
    differ = "The first and the second half of the frames give different values of"
    wrong = "times its standard error. The model has an error that changes over time."
    each = zip(problem.labels, away, strict=True)
    return [f"{differ} {label}: the difference is {off:.2g} {wrong}" for label, off in each if off > 3.0]


class Explained(NamedTuple):
    """The sizes of possible causes (causes,), and the fraction of the sum of squares that these causes explain."""

    sizes: np.ndarray
    share: float


def explained(
    problem: LeastSquares, at: Linearised, weights: Weights, columns: Sequence[np.ndarray], is_doubted: bool = False
) -> Explained | None:
    """Estimate the sizes of possible causes by a Gauss-Newton step. Return None if noise can explain the residuals.

    ``columns`` are the derivatives (frames, m, causes) of each observation's predictions with respect to the causes. If
    ``is_doubted`` is true, the test for noise is left out, and the causes must explain half of the sum of squares.
    """
    from scipy.stats import f as fisher

    count = columns[0].shape[-1]
    wide = copy(problem)
    wide.labels = [*problem.labels, *(f"cause {k}" for k in range(count))]
    free = len(wide.labels)
    if sum(len(part.observation.times) for part in problem.parts) < free + 3:
        return None
    jacobians = [np.concatenate([J, c], axis=-1) for J, c in zip(at.jacobians, columns, strict=True)]
    before = Linearised(np.zeros(free), at.residuals, jacobians)

    def step() -> Linearised:
        white, slopes = (weighted(wide.parts, weights, own) for own in (before.residuals, before.jacobians))
        score: np.ndarray = sum(np.einsum("fmp,fm->p", J, r) for J, r in zip(slopes, white, strict=True))
        u = -inverse(wide, hessian(wide, before, weights)) @ score
        each = zip(before.residuals, before.jacobians, strict=True)
        return replace(before, u=u, residuals=[r + J @ u for r, J in each])

    try:
        weights = noise_of(wide, step(), weights)
        left = step()
        found = Certainty.of(wide, left, weights)
    except ComputationError:
        return None
    sizes, V = left.u[-count:], found.covariance[-count:, -count:]
    statistic = float(sizes @ np.linalg.pinv(V) @ sizes) / count
    least = fisher.isf(1e-3, count, found.degrees_of_freedom[-count:].min())
    gaps = [float(np.median(np.diff(part.observation.times))) for part in wide.parts]
    times = [one.correlation_time for one in weights]
    fades_slowly = any(time and np.exp(-gap / time) > 0.6 for time, gap in zip(times, gaps, strict=True))
    if not is_doubted and (statistic <= least or fades_slowly):
        return None
    share = 1.0 - problem.sum_of_squares(left.residuals, weights) / problem.sum_of_squares(before.residuals, weights)
    return None if share < (0.5 if is_doubted else 0.05) else Explained(sizes, share)


def dear_causes(problem: LeastSquares, at: Linearised, weights: Weights) -> list[str]:
    """Return sentences on causes that need additional runs: a wrong density, or a wrong slip condition."""
    values, found = problem.coordinates.values(at.u), list[str]()

    def by_density(experiment: Experiment, own: Arrays) -> Arrays:
        _, slopes = experiment.linearised(own, [{"rest_density": experiment.simulation.parameters()["rest_density"]}])
        problem.runs, problem.tangents = problem.runs + 1, problem.tangents + 1
        return {name: slope[..., 0] for name, slope in slopes.items()}

    def by_slip(experiment: Experiment, own: Arrays) -> Arrays:
        slip = getattr(experiment.simulation.scene.container, "slip", None)
        if slip is None:
            return {}
        simulation = experiment.simulation.replaced(f"container.slip={'no' if slip == 'free' else 'free'}")
        changed, now = experiment.simulated_by(simulation).predicted(own), experiment.predicted(own)
        problem.runs += 2
        return {name: np.nan_to_num(changed[name] - now[name]) for name in now}

    def explains(change: Callable[[Experiment, Arrays], Arrays]) -> Explained | None:
        columns = _nothing(problem, 1)
        for k, experiment in enumerate(problem.experiments):
            try:
                changed = change(experiment, problem.values_of(k, values))
            except (DivergedError, InputError):
                continue
            for part, column in zip(problem.parts, columns, strict=True):
                if part.experiment == k and changed:
                    column[..., 0] = np.where(np.isnan(part.observation.measured), 0.0, changed[part.name])
        return explained(problem, at, weights, columns, True)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CortadoWarning)
        said = explains(by_density) if "rest_density" not in values else None
        if said and abs(said.sizes[0]) < 1.0:
            would = f"would explain {said.share:.0%} of the squares of the residuals: is rest_density right?"
            found.append(f"A density {1.0 + said.sizes[0]:.3g} times as large {would}")
        said = explains(by_slip)
        if said and said.sizes[0] > 0.0:
            would = f"would explain {said.share:.0%} of the squares of the residuals: is container.slip right?"
            found.append(f"The other value of container.slip {would}")
    return found


def _nothing(problem: LeastSquares, count: int) -> list[np.ndarray]:
    return [np.zeros((*part.observation.measured.shape, count)) for part in problem.parts]


def _trends_and_clocks(problem: LeastSquares, at: Linearised, weights: Weights) -> list[str]:
    """Return sentences on late clocks, and on trends in observations with at most four numbers per frame."""
    found, late = list[str](), list[str]()
    for k, part in enumerate(problem.parts):
        times, measured = part.observation.times, part.observation.measured
        x = 2.0 * (times - times[0]) / (times[-1] - times[0]) - 1.0
        shapes = np.stack([x, 1.5 * x**2 - 0.5], axis=-1)
        for number in range(measured.shape[1]) if measured.shape[1] <= 4 else ():
            columns, there = _nothing(problem, 2), ~np.isnan(measured[:, number])
            columns[k][there, number] = shapes[there]
            if said := explained(problem, at, weights, columns):
                course = -shapes[there] @ said.sizes
                which = f"number {number + 1} of " if measured.shape[1] > 1 else ""
                found.append(
                    f"The residuals of {which}{part.label} have a trend, from {course[0]:.2g} to {course[-1]:.2g} "
                    f"{part.observation.unit}, which is {said.share:.0%} of their squares and no noise: the model has "
                    "an error that grows or fades."
                )
        if CLOCK not in part.observation.start:
            columns, rates = _nothing(problem, 1), np.gradient(np.nan_to_num(measured) + at.residuals[k], times, axis=0)
            columns[k][..., 0] = np.where(np.isnan(measured), 0.0, rates)
            said = explained(problem, at, weights, columns)
            if said and abs(said.sizes[0]) < times[-1] - times[0]:
                late.append(
                    f"Frames of {part.label} that are {said.sizes[0]:.2g} s later would explain {said.share:.0%} of "
                    f'the squares of the residuals: is the clock right? Fit the clock by calibrate = ["{CLOCK}"].'
                )
    return found + late
