"""How often intervals hold the truth: fits of one experiment with other noise each, and of its linear model."""

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest
from scipy.stats import t as student

import cortado
from cortado.arrays import whole_number
from cortado.optimisation.fitting.certainty import correlation_time, independent_frames, score_covariance
from cortado.optimisation.fitting.fit import Fit
from cortado.optimisation.fitting.least_squares import Coordinates, LeastSquares, whitened

from .cases import CASES, Case, CaseName


def share(found: Sequence[bool]) -> str:
    """In percent, with its own 95 % interval, of Clopper and Pearson (1934)."""
    interval = binomtest(int(np.sum(found)), len(found)).proportion_ci()
    return f"{100 * np.mean(found):.1f} % ({100 * interval.low:.1f} to {100 * interval.high:.1f})"


def record(case: Case, fitted: Fit) -> dict[str, Any]:
    """Of one fit: by the label of each number, its error over its standard error, the same of the naive covariance, and
    whether each of the intervals holds the truth."""
    true = fitted.coordinates.vector(np.concatenate([np.ravel(case.true[name]) for name in fitted.coordinates.names]))
    lower, upper = (np.concatenate([np.ravel(p[k]) for p in fitted.intervals().values()]) for k in range(2))
    free, off = fitted.coordinates.free, fitted.u - true
    holds = (lower[free] <= fitted.coordinates.numbers(true)) & (fitted.coordinates.numbers(true) <= upper[free])
    naive = np.abs(off) <= 1.96 * np.sqrt(np.diag(fitted.naive_covariance))
    return {
        "labels": fitted.labels,
        "off": off.tolist(),
        "error": np.sqrt(np.diag(fitted.coordinate_covariance)).tolist(),
        "holds": holds.tolist(),
        "naive_holds": naive.tolist(),
        "naive_error": np.sqrt(np.diag(fitted.naive_covariance)).tolist(),
        "doubts": len(fitted.doubts),
        "runs": fitted.runs,
        "tangents": fitted.tangents,
    }


@cache
def case_of(name: CaseName) -> Case:
    """Made once in a process."""
    return CASES[name]()


def fitted_line(name: CaseName, seed: int) -> str:
    """The record of the fit with the noise of a seed."""
    case = case_of(name)
    return json.dumps(record(case, cortado.fit(case.noisy(seed), case.start, case.bounds)))


def fitted_lines(name: CaseName, seeds: range, processes: int) -> Iterator[str]:
    """The records of many, in the order of their seeds."""
    fit_one = partial(fitted_line, name)
    if processes == 1:
        yield from map(fit_one, seeds)
        return
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        yield from pool.map(fit_one, seeds)


def cover(case: CaseName, runs: int, processes: int, out: Path) -> str:
    """A table of how many intervals held the truth."""
    runs, processes = whole_number("runs", runs, 1), whole_number("processes", processes, 1)
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{case}.jsonl"
    done = path.read_text().splitlines() if path.exists() else []
    for line in fitted_lines(case, range(len(done), runs), processes):
        with path.open("a") as file:
            file.write(line + "\n")
        done.append(line)
    rows = [json.loads(line) for line in done[:runs]]
    text = [
        f"{case}: {len(rows)} fits of a right model, which {share([row['doubts'] > 0 for row in rows])} of them doubt"
    ]
    for k, label in enumerate(rows[0]["labels"]):
        holds, naive = (share([row[key][k] for row in rows]) for key in ("holds", "naive_holds"))
        spread = np.std([row["off"][k] for row in rows])
        error, small = (np.median([row[key][k] for row in rows]) for key in ("error", "naive_error"))
        bias = np.mean([row["off"][k] for row in rows])
        text.append(
            f"  {label}: {holds} of the 95 % intervals hold the truth, {naive} of the naive ones; scatter "
            f"{spread:.3g}, standard error {error:.3g}, naive {small:.3g}; bias {bias:.2g}"
        )
    return "\n".join(text)


def cover_linear(case: CaseName, runs: int) -> str:
    """The same of the experiment's linear model at the truth, with the noise of the same seeds: no run for a fit."""
    made = case_of(case)
    coordinates = Coordinates.of(made.true, made.true, made.bounds)
    problem = LeastSquares([made.experiment], coordinates)
    (J,) = problem.linearised(coordinates.start).jacobians
    ((name, observation),) = made.experiment.observations.items()
    J, times = J / made.sizes[name], observation.times
    held = []
    for seed in range(runs):
        noise = made.noise(seed)[name] / made.sizes[name]
        _, r, inverse = _linear_fit(J, noise)
        time = correlation_time(J, r, inverse, times)
        white = whitened(J, times, time)
        estimate, r, inverse = _linear_fit(white, whitened(noise, times, time))
        score = score_covariance(white, r, inverse, independent_frames(times, time))
        freedom = [score.degrees_of_freedom(inverse, unit) for unit in np.eye(len(estimate))]
        held.append(np.abs(estimate) < student.ppf(0.975, freedom) * np.sqrt(np.diag(inverse @ score.B @ inverse)))
    rows = [f"  {label}: {share(one)}" for label, one in zip(coordinates.labels, np.array(held).T, strict=True)]
    return "\n".join([f"{case}: of {runs} fits of the linear model the 95 % intervals hold the truth in", *rows])


def _linear_fit(J: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Estimate, residuals and N^-1."""
    flat = J.reshape(-1, J.shape[-1])
    inverse = np.linalg.inv(flat.T @ flat)
    estimate = inverse @ flat.T @ y.ravel()
    return estimate, y - J @ estimate, inverse
