"""How often 95 % intervals of estimates contain what they should, over many seeds of the estimator."""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np

from cortado.gradients import AdjointViscosity, EnsembleMean, Estimate, GradientEstimator, Guided, RandomizedSmoothing

from .cells import TRUTH, Bench, Cell
from .controls import CONTROLS

REFERENCE = "smoothing-4"
"""Its mean over all seeds is the smoothed gradient that the others are compared with."""
ESTIMATORS: dict[str, Callable[[float, int], GradientEstimator]] = {
    REFERENCE: lambda spread, seed: RandomizedSmoothing(spread, 4, seed=seed),
    "mean-of-8-viscosity": lambda spread, seed: EnsembleMean(spread, 8, seed=seed, estimator=AdjointViscosity()),
    "guided-2-differences": lambda spread, seed: Guided(spread, seed=seed),
    "guided-4-differences": lambda spread, seed: Guided(spread, differences=4, seed=seed),
}


@dataclass(frozen=True)
class Intervals:
    """Estimates of one gradient by many seeds of one estimator."""

    gradients: np.ndarray
    """(seeds, numbers)"""
    lower: np.ndarray
    """(seeds, numbers)"""
    upper: np.ndarray
    """(seeds, numbers)"""

    @classmethod
    def of(cls, estimates: Sequence[Estimate], name: str, confidence: float = 0.95) -> "Intervals":
        """The intervals of the components of the gradient with respect to a parameter."""
        ends = [one.interval(confidence) for one in estimates]
        rows = [
            [one.gradient[name].ravel(), *(end[name].ravel() for end in e)]
            for one, e in zip(estimates, ends, strict=True)
        ]
        return cls(*np.swapaxes(rows, 0, 1))

    def contain(self, wanted: np.ndarray) -> float:
        """How often the intervals contain what is wanted: one number for each component, or a row for each seed."""
        return float(np.mean((self.lower <= wanted) & (wanted <= self.upper)))

    @property
    def contain_mean(self) -> float:
        """How often the interval of a seed contains the mean over all other seeds."""
        others = len(self.gradients) - 1
        return self.contain((self.gradients.sum(axis=0) - self.gradients) / others)


def coverage(found: dict[str, Intervals]) -> str:
    """A table in Markdown: how often the intervals contain the estimator's own mean, and the smoothed gradient."""
    lines = [
        "| estimator | contain its own mean | contain the smoothed gradient | error of the mean |",
        "|---" * 4 + "|",
    ]
    wanted = found[REFERENCE].gradients.mean(axis=0)
    for name, one in found.items():
        smoothed = one.contain_mean if name == REFERENCE else one.contain(wanted)
        bias = np.linalg.norm(one.gradients.mean(axis=0) - wanted) / np.linalg.norm(wanted)
        error = "" if name == REFERENCE else f"{bias:.2f}"
        lines.append(f"| {name} | {one.contain_mean:.1%} | {smoothed:.1%} | {error} |")
    return "\n".join(lines)


def intervals(cell: Cell, seeds: Sequence[int]) -> Intervals:
    """Those of an estimator at the place of a cell, on a CPU."""
    bench = Bench("cpu", "float64")
    (problem, u), name = bench.posed(cell), CONTROLS[cell.control].parameter
    made = (ESTIMATORS[cell.estimator](bench.spread(cell), seed) for seed in seeds)
    return Intervals.of([one.estimate(problem, {name: u}) for one in made], name)


def main(words: Sequence[str]) -> int:
    """Prints a table for a place; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gradients.coverage", description=__doc__)
    parser.add_argument("--scene", default="plane-144")
    parser.add_argument("--loss", default="centre-of-mass")
    parser.add_argument("--horizon", type=int, default=400, help="in steps")
    parser.add_argument("--place", type=int, default=600, help="the seed of the place and of the loss's target")
    parser.add_argument("--seeds", type=int, default=40, help="how many seeds of each estimator")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--out", help="a file to which the estimates and the ends of their intervals are written, as JSON"
    )
    chosen = parser.parse_args(words)
    if chosen.seeds < 2:
        parser.error(f"--seeds is {chosen.seeds}, but must be at least 2, to have a mean over the others")
    place = Cell(chosen.scene, "gravity-4", chosen.loss, chosen.horizon, chosen.place, TRUTH)
    found = _computed(place, range(chosen.seeds), chosen.workers)
    print(coverage(found))
    if chosen.out:
        rows = {name: {key: value.tolist() for key, value in vars(one).items()} for name, one in found.items()}
        with open(chosen.out, "w", encoding="utf-8") as file:
            json.dump({"place": vars(place), "estimates": rows}, file)
    return 0


def _computed(place: Cell, seeds: Sequence[int], workers: int) -> dict[str, Intervals]:
    cells = [Cell(**{**vars(place), "estimator": name}) for name in ESTIMATORS]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        return dict(zip(ESTIMATORS, pool.map(intervals, cells, [seeds] * len(cells)), strict=True))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
