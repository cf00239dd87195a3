"""Losses of a probe in some states of a run, timed with pressures of the run's own steps and of steps taken again."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

import cortado.problem
from benchmarks.bench.environment import environment
from benchmarks.bench.learning import device_name, seconds
from benchmarks.bench.watching import tank
from cortado import Problem, Simulation, losses, sensors

KINDS = {"the run's steps": 10**9, "steps again": 0}
"""What pressures are read from, and the `SPARSE` of problems that makes it so."""


def bench_probed(
    depth: int, steps: int, every: tuple[int, ...], repeats: int, device: str, precision: str, as_json: bool
) -> str:
    """Return as text the times of a loss of a probe in every so many states, and of its gradient, over those of a loss
    of the end: the least of ``repeats``, taken in turn."""
    simulation, gravity = Simulation(tank(depth), device, precision), {"gravity": np.array([0.3, -9.81])}
    probe = losses.SensorMatch(sensors.PressureProbe([1.7, 0.5]), [5000.0])
    problems: dict[str, Problem] = {"the end": Problem(simulation, steps, losses.CentreOfMass([1.0, 0.5]))}
    problems |= {
        str(k): Problem(simulation, steps, losses.Frames(dict.fromkeys(range(k, steps, k), probe))) for k in every
    }
    rows: list[dict[str, Any]] = []
    for name, problem in problems.items():
        for kind, sparse in KINDS.items() if name != "the end" else [("", cortado.problem.SPARSE)]:
            with _sparse(sparse):
                works = {"value": problem.value, "gradient": problem.value_and_gradient}
                found = {what: _least(partial(work, gravity), repeats, device) for what, work in works.items()}
            rows.append({"every": name, "read": kind, **found})
    end = rows[0]
    for row in rows:
        row |= {f"{what}_ratio": row[what] / end[what] for what in ("value", "gradient")}
    head = {"device": device_name(device, environment()["processor"]), "particles": simulation.particles}
    if as_json:
        return json.dumps({**head, "steps": steps, "precision": precision, "rows": rows}, indent=2)
    lines = [
        f"{row['every']:>8} {row['read']:16}{row['value']:9.1f} ms{row['value_ratio']:7.2f}"
        f"{row['gradient']:11.1f} ms{row['gradient_ratio']:7.2f}"
        for row in rows
    ]
    said = f"{head['particles']} particles on {head['device']}, {steps} steps, {precision}: a loss of a probe in"
    return "\n".join([said, "every ..th state            value  ratio       gradient  ratio", *lines])


@contextmanager
def _sparse(number: int) -> Iterator[None]:
    """Let problems read quantities from one state in ``number`` on in the run's own steps."""
    usual, cortado.problem.SPARSE = cortado.problem.SPARSE, number
    try:
        yield
    finally:
        cortado.problem.SPARSE = usual


def _least(work: Any, repeats: int, device: str) -> float:
    """Return the least time [ms] of some repeats, after two that compile and capture."""
    for _ in range(2):
        work()
    return 1e3 * float(np.min([seconds(work, device) for _ in range(repeats)]))
