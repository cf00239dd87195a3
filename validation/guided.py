"""First and zeroth order together over long runs: ``python validation/guided.py --out runs/guided.jsonl``.

The flows are `gradients.SCENES`, the loss is the centre of mass. The parameter is gravity, in 4 blocks of time or of
each step. Printed are medians over flows and seeds [the least] of the cosine to the truth, and of the size over the
truth's.

In blocks the truth is `RandomizedSmoothing`, twice: for "the other half" the second against the first. With a cosine r
between them, nothing has more than sqrt(2 r / (1 + r)) to their mean: *at most*.

Of each step, N numbers, the truth g is the gradient of the loss smoothed over gravities in a ball of radius r,
SPREAD sqrt(N), and over first positions. For a random direction q of length 1 let D = (L(u + r q) - L(u - r q)) / 2 r.
Then N times the mean of D q is g (by the divergence theorem), so that for an estimate e the means of N D (e . q), and
of N^2 D D' (q . q') over all pairs of directions, are e . g and g . g without a bias, however noisy each D is. The
standard error of each cosine is that of its values with a twentieth of the directions left out (the jackknife).

With 3,000 directions a case takes 20 minutes on a core and half a minute on a GPU.
"""

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
from gradients import GRAVITY, POSITION_NOISE, SCENES, SPACING, SPREAD, TILT, TRUE_SPREAD, cosine

from cortado import Problem, Simulation, gradients, losses
from cortado.errors import DivergedError
from cortado.files.terminal import track
from cortado.gradients import Estimate

BLOCKS, HALF_SAMPLES, TOGETHER = 4, 6, 1024
OTHER_HALF = "the other half"
Scores = dict[str, float]
GROUPS = 20
"""Of directions, for standard errors."""
VISCOSITY = gradients.AdjointViscosity()
ESTIMATORS: dict[str, Callable[[int], gradients.GradientEstimator]] = {
    "Exact()": lambda seed: gradients.Exact(),
    "AdjointViscosity()": lambda seed: VISCOSITY,
    "EnsembleMean, 8": lambda seed: gradients.EnsembleMean(SPREAD, 8, POSITION_NOISE, seed, VISCOSITY),
    "Guided, 4 parts": lambda seed: gradients.Guided(SPREAD, 4, POSITION_NOISE, seed, parts=4),
    "Guided, 2 parts": lambda seed: gradients.Guided(SPREAD, 4, POSITION_NOISE, seed, parts=2),
}


class InBlocks:
    """A problem whose parameter is gravity in blocks of time, as estimators see it."""

    def __init__(self, problem: Problem, start: np.ndarray, blocks: int):
        self._problem, self._start, self._blocks = problem, start, blocks
        simulation = problem.simulation
        self.simulation = SimpleNamespace(
            positions=start, scene=simulation.scene, batch=None, precision=simulation.precision, known=simulation.known
        )
        self.room = problem.room

    def value(self, values: Mapping[str, Any]) -> float:
        return self._problem.value(self._parameters(values))

    def forward_pass(self, values: Mapping[str, Any]) -> Any:
        run = self._problem.forward_pass(self._parameters(values))
        back = lambda estimator, observe=None: self._gathered(run.back(estimator, observe))  # noqa: E731
        return SimpleNamespace(loss=run.loss, back=back)

    def together(self, points: Sequence[Mapping[str, Any]], estimator: Any = None) -> list[Any]:
        found = self._problem.together([self._parameters(point) for point in points], estimator)
        return [replace(x, gradient=self._gathered(x.gradient)) if isinstance(x, Estimate) else x for x in found]

    def _parameters(self, values: Mapping[str, Any]) -> dict[str, Any]:
        gravity = np.repeat(values["gravity"], self._problem.steps // self._blocks, axis=0)
        return {"initial_positions": values.get("initial_positions", self._start), "gravity": gravity}

    def _gathered(self, gradient: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Nothing of a loss alone."""
        return {name: gradient[name].reshape(self._blocks, -1, 2).sum(axis=1) for name in ("gravity",) if gradient}


@dataclass(frozen=True)
class Smoothed:
    """The truth of gravity in blocks, twice (numbers,)."""

    halves: tuple[np.ndarray, np.ndarray]

    @classmethod
    def found(cls, problem: InBlocks, gravity: np.ndarray, seed: int) -> Self:
        estimators = [gradients.RandomizedSmoothing(SPREAD, HALF_SAMPLES, POSITION_NOISE, seed + k) for k in (1, 2)]
        first, second = (one.estimate(problem, {"gravity": gravity}).gradient["gravity"].ravel() for one in estimators)
        return cls((first, second))

    @property
    def likeness(self) -> float:
        """The cosine between the halves."""
        return cosine(*self.halves)

    def scores(self, g: np.ndarray) -> Scores:
        """Of an estimate (numbers,)."""
        truth = np.mean(self.halves, axis=0)
        return {"cosine": cosine(g, truth), "size": float(np.linalg.norm(g) / np.linalg.norm(truth))}


@dataclass(frozen=True)
class AlongDirections:
    """The truth of many numbers, by differences of the loss (count,) along directions (count, numbers)."""

    directions: np.ndarray
    slopes: np.ndarray

    @classmethod
    def found(cls, problem: InBlocks, gravity: np.ndarray, start: np.ndarray, seed: int, count: int) -> Self:
        """Each direction with first positions of its own."""
        random, reach = np.random.default_rng(seed), SPREAD * np.sqrt(gravity.size)
        directions, slopes = np.empty((count, gravity.size)), np.full(count, np.nan)
        for first in range(0, count, TOGETHER // 2):
            drawn, points = directions[first : first + TOGETHER // 2], []
            drawn[:] = random.standard_normal(drawn.shape)
            drawn /= np.linalg.norm(drawn, axis=1)[:, None]
            for q in drawn:
                moved = start + POSITION_NOISE * SPACING * random.standard_normal(start.shape)
                step = reach * q.reshape(gravity.shape)
                points += [{"gravity": gravity + way * step, "initial_positions": moved} for way in (1.0, -1.0)]
            found = [np.nan if isinstance(x, DivergedError) else x.loss for x in problem.together(points)]
            slopes[first : first + len(drawn)] = (np.array(found[::2]) - found[1::2]) / (2.0 * reach)
        held = np.isfinite(slopes)
        return cls(directions[held], slopes[held])

    def scores(self, g: np.ndarray) -> Scores:
        """Of an estimate (numbers,), and the standard error of its cosine."""
        groups = np.arange(len(self.slopes)) % GROUPS
        cosines = np.array([self._scores(g, groups != k)["cosine"] for k in range(GROUPS)])
        error = np.sqrt((GROUPS - 1) / GROUPS * ((cosines - cosines.mean()) ** 2).sum())
        return self._scores(g, groups >= 0) | {"error": float(error)}

    def _scores(self, g: np.ndarray, chosen: np.ndarray) -> Scores:
        directions, slopes, length = self.directions[chosen], self.slopes[chosen], np.linalg.norm(g)
        count, numbers = directions.shape
        inner = numbers * np.mean(slopes * (directions @ g))
        pairs = ((slopes @ directions) ** 2).sum() - (slopes**2).sum()
        truth = numbers * np.sqrt(pairs / (count * (count - 1)))
        return {"cosine": float(inner / (length * truth)), "size": float(length / truth)}


def case(scene: str, seed: int, steps: int, count: int, device: str) -> list[dict[str, Any]]:
    """Scores of all estimators, in blocks and of each step."""
    simulation = Simulation(SCENES[scene].scene(), precision="float64", device=device)
    random = np.random.default_rng(seed)
    start = simulation.positions + POSITION_NOISE * SPACING * random.standard_normal(simulation.positions.shape)
    true = np.tile(GRAVITY, (BLOCKS, 1)) + [random.choice([-TILT, TILT]), 0.0]
    true = true + TRUE_SPREAD * random.standard_normal(true.shape)
    hidden = {"initial_positions": start, "gravity": np.repeat(true, steps // BLOCKS, axis=0)}
    end = Problem(simulation, steps, losses.CentreOfMass([0.0, 0.0])).end(hidden)
    inner = Problem(simulation, steps, losses.CentreOfMass(end.positions.mean(axis=0)))
    rows = []
    for blocks in (BLOCKS, steps):
        problem, gravity = InBlocks(inner, start, blocks), np.tile(GRAVITY, (blocks, 1))
        of = {"scene": scene, "seed": seed, "steps": steps, "blocks": blocks}
        truth: Smoothed | AlongDirections
        if blocks == BLOCKS:
            truth = Smoothed.found(problem, gravity, 1000 * seed)
            rows.append(of | {"estimator": OTHER_HALF, "cosine": truth.likeness})
        else:
            truth = AlongDirections.found(problem, gravity, start, 1000 * seed, count)
        for name, make in ESTIMATORS.items():
            estimate = make(seed + 2).estimate(problem, {"gravity": gravity}).gradient["gravity"]
            rows.append(of | {"estimator": name} | truth.scores(estimate.ravel()))
    return rows


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Medians over flows and seeds [the least] of one number of blocks."""
    lines = []
    for name in dict.fromkeys(row["estimator"] for row in rows):
        cosines, sizes, errors = (
            np.array([row.get(key, np.nan) for row in rows if row["estimator"] == name])
            for key in ("cosine", "size", "error")
        )
        median = np.median(cosines)
        most = np.sqrt(2.0 * max(median, 0.0) / (1.0 + max(median, 0.0)))
        size = f", at most {most:6.3f}" if name == OTHER_HALF else f" {np.median(sizes):8.2g}"
        error = f", cosines to {np.median(errors):.3f}" if np.isfinite(errors).all() else ""
        lines.append(f"{name:20} {median:6.3f} [{min(cosines):6.3f}]{size}{error}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """See the head of the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/guided.jsonl"))
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=["dam break", "crash", "drop", "two fluids"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--steps", type=int, default=800, help="a multiple of 4")
    parser.add_argument("--directions", type=int, default=3000)
    parser.add_argument("--device", default="cpu")
    given = parser.parse_args(arguments)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    wanted, rows = [(scene, seed) for seed in given.seeds for scene in given.scenes], []
    with track(len(wanted), "cases") as advance, given.out.open("w") as file:
        for scene, seed in wanted:
            made = case(scene, seed, given.steps, given.directions, given.device)
            file.writelines(json.dumps(row) + "\n" for row in made)
            file.flush()
            rows += made
            advance()
    for blocks in (BLOCKS, given.steps):
        print(f"\ngravity in {blocks} blocks, {given.steps} steps, {len(wanted)} cases: median cosine [least], size")
        print(table([row for row in rows if row["blocks"] == blocks]))


if __name__ == "__main__":
    main()
