"""Gradient estimators that go back through one run, timed beside the exact one."""

import json
from functools import partial
from typing import Any

import numpy as np

from benchmarks.bench.environment import environment
from benchmarks.bench.learning import device_name, seconds
from benchmarks.bench.scene import dam_break
from benchmarks.bench.watching import tank
from cortado import Problem, Simulation, gradients, losses

ESTIMATORS = gradients.Exact(), gradients.AdjointViscosity()


def bench_estimating(depth: int, particles: int, steps: int, repeats: int, device: str, as_json: bool) -> str:
    """Return as a table the time of a value with its gradient by each estimator, over that of `Exact`: the least of
    ``repeats``, taken in turn, in a tank in the plane and in a dam break in space."""
    rows = []
    for scene in (tank(depth), dam_break(particles, "projection")):
        for precision in ("float32", "float64"):
            simulation = Simulation(scene, device, precision)
            gravity = {"gravity": np.array(scene.forces.gravity)}
            goal = losses.CentreOfMass(simulation.positions.mean(axis=0))
            problem, times = Problem(simulation, steps, goal), dict[str, list[float]]()
            for number in range(2 + repeats):  # a CPU captures in the second
                for estimator in ESTIMATORS:
                    work = partial(problem.value_and_gradient, gravity, estimator)
                    found = times.setdefault(type(estimator).__name__, [])
                    found += [1e3 * seconds(work, device)][: number // 2]
            least = {name: float(np.min(own)) for name, own in times.items()}
            rows.append({"particles": simulation.particles, "d": scene.dimension, "precision": precision, "ms": least})
    if as_json:
        around = {"device": device_name(device, environment()["processor"]), "steps": steps}
        return json.dumps({**around, "rows": rows}, indent=2)
    names = [type(one).__name__ for one in ESTIMATORS]
    head = f"| {steps} steps | `{names[0]}` | {' | '.join(f'`{name}`' for name in names[1:])} |"
    return "\n".join([head, "|---" * (1 + len(names)) + "|", *map(_in_words, rows)])


def _in_words(row: dict[str, Any]) -> str:
    exact, *others = row["ms"].values()
    where = f"{row['particles']} particles in {'space' if row['d'] == 3 else 'the plane'}, {row['precision']}"
    return f"| {where} | {exact:.0f} ms | {' | '.join(f'{time / exact:.2f} times' for time in others)} |"
