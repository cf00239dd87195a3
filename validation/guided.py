"""First and zeroth order together over long runs: ``python validation/guided.py --out runs/guided.jsonl`` (1 h).

The flows are `gradients.SCENES`, the loss is the centre of mass. The parameter is gravity, in 4 blocks of time or of
each step. In blocks the truth is `RandomizedSmoothing`, of each step differences along random directions, both twice.
Printed are medians over flows and seeds [the least], of

- the cosine to the truth, along random directions that of the derivatives along them;
- the size: in blocks over the truth's, along random directions the slope of the truth over the estimate, 1 if right;
- for "the other half", how well the two halves of the truth agree. With a cosine r between them, nothing has more than
  sqrt(2 r / (1 + r)) to their mean: *at most*.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from gradients import GRAVITY, POSITION_NOISE, SCENES, SPACING, SPREAD, TILT, TRUE_SPREAD, cosine

from cortado import Problem, Simulation, gradients, losses
from cortado.errors import DivergedError
from cortado.gradients import Estimate
from cortado.io.progress import track

BLOCKS, HALF_SAMPLES, TOGETHER = 4, 6, 192
TRUTH = ("one half", "the other half")
VISCOSITY = gradients.AdjointViscosity()
ESTIMATORS = {
    "Exact()": lambda seed: gradients.Exact(),
    "FrozenGeometry()": lambda seed: gradients.FrozenGeometry(),
    "AdjointViscosity()": lambda seed: VISCOSITY,
    "EnsembleMean, 8": lambda seed: gradients.EnsembleMean(SPREAD, 8, POSITION_NOISE, seed, VISCOSITY),
    "Guided, 4 parts": lambda seed: gradients.Guided(SPREAD, 4, POSITION_NOISE, seed, parts=4),
    "Guided, 2 parts": lambda seed: gradients.Guided(SPREAD, 4, POSITION_NOISE, seed, parts=2),
}


class InBlocks:
    """A problem whose parameter is gravity in blocks of time, as estimators see it."""

    def __init__(self, problem: Problem, start: np.ndarray, blocks: int):
        self._problem, self._start, self._blocks = problem, start, blocks
        self.simulation = SimpleNamespace(positions=start, scene=problem.simulation.scene, batch=None)
        self.room = problem.room

    def value(self, values: Mapping[str, Any]) -> float:
        return self._problem.value(self._parameters(values))

    def forward_pass(self, values: Mapping[str, Any]) -> Any:
        run = self._problem.forward_pass(self._parameters(values))
        back = lambda derivative, observe=None: self._gathered(run.back(derivative, observe))  # noqa: E731
        return SimpleNamespace(loss=run.loss, rollout=run.rollout, derivative=run.derivative, back=back)

    def together(self, points: Sequence[Mapping[str, Any]], estimator: Any = None) -> list[Any]:
        found = self._problem.together([self._parameters(point) for point in points], estimator)
        return [replace(x, gradient=self._gathered(x.gradient)) if isinstance(x, Estimate) else x for x in found]

    def _parameters(self, values: Mapping[str, Any]) -> dict[str, Any]:
        gravity = np.repeat(values["gravity"], self._problem.steps // self._blocks, axis=0)
        return {"initial_positions": values.get("initial_positions", self._start), "gravity": gravity}

    def _gathered(self, gradient: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Nothing of a loss alone."""
        return {name: gradient[name].reshape(self._blocks, -1, 2).sum(axis=1) for name in ("gravity",) if gradient}


def slopes(problem: InBlocks, gravity: np.ndarray, directions: np.ndarray, start: np.ndarray, seed: int) -> np.ndarray:
    """Differences of the loss along directions (k, numbers), each with other first positions; each number of gravity
    moves by about the spread."""
    random, reach = np.random.default_rng(seed), SPREAD * np.sqrt(gravity.size)
    points = []
    for q in directions:
        moved = start + POSITION_NOISE * SPACING * random.standard_normal(start.shape)
        step = reach * q.reshape(gravity.shape)
        points += [{"gravity": gravity + way * step, "initial_positions": moved} for way in (1.0, -1.0)]
    found = [x for k in range(0, len(points), TOGETHER) for x in problem.together(points[k : k + TOGETHER])]
    values = [np.nan if isinstance(x, DivergedError) else x.loss for x in found]
    return (np.array(values[::2]) - values[1::2]) / (2.0 * reach)


def case(scene: str, seed: int, steps: int, count: int, device: str) -> list[dict[str, Any]]:
    """Cosines and sizes of all estimators, in blocks and along directions."""
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
        directions = np.random.default_rng(seed + 1).standard_normal((count, gravity.size))
        directions = np.eye(gravity.size) if blocks == BLOCKS else directions
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        known = []
        for half in (1, 2):
            if blocks == steps:
                known.append(slopes(problem, gravity, directions, start, 1000 * seed + half))
                continue
            smoothed = gradients.RandomizedSmoothing(SPREAD, HALF_SAMPLES, POSITION_NOISE, 1000 * seed + half)
            known.append(smoothed.estimate(problem, {"gravity": gravity}).gradient["gravity"].ravel())
        found = {TRUTH[1]: known[1]}
        for name, make in ESTIMATORS.items():
            estimate = make(seed + 2).estimate(problem, {"gravity": gravity}).gradient["gravity"]
            found[name] = directions @ estimate.ravel()
        for name, g in found.items():
            truth = known[0] if name in TRUTH else np.mean(known, axis=0)
            size = np.linalg.norm(g) / np.linalg.norm(truth) if blocks == BLOCKS else float(g @ truth / (g @ g))
            row = {"scene": scene, "seed": seed, "steps": steps, "blocks": blocks, "estimator": name}
            rows.append(row | {"cosine": cosine(g, truth), "size": float(size)})
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """See the head of the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/guided.jsonl"))
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=["dam break", "crash", "drop", "two fluids"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--steps", type=int, default=800, help="a multiple of 4")
    parser.add_argument("--directions", type=int, default=48)
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
        for name in [TRUTH[1], *ESTIMATORS]:
            of = [row for row in rows if (row["blocks"], row["estimator"]) == (blocks, name)]
            cosines, sizes = ([row[key] for row in of] for key in ("cosine", "size"))
            print(f"{name:20} {np.median(cosines):6.3f} [{min(cosines):6.3f}] {np.median(sizes):8.2g}")
            if name in TRUTH:
                r = max(float(np.median(cosines)), 0.0)
                print(f"{'at most':20} {np.sqrt(2.0 * r / (1.0 + r)):6.3f}")


if __name__ == "__main__":
    main()
