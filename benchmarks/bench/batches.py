"""Batches of dam breaks, timed beside one."""

import json
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from benchmarks.bench.environment import environment
from benchmarks.bench.learning import device_name
from benchmarks.bench.scene import dam_break
from benchmarks.bench.timing import median_seconds
from cortado.losses import FinalPositions
from cortado.problem import Problem
from cortado.simulation import Simulation

PARTICLES = 125
"""Of each scene."""


def bench_batches(scenes: Sequence[int], steps: int, repeats: int, device: str, as_json: bool) -> str:
    """Milliseconds of a step of all scenes together, forward and with the gradient, as text: for each number of scenes,
    with how many times the first number's throughput."""
    rows: list[dict[str, Any]] = []
    for number in scenes:
        simulation = Simulation(dam_break(PARTICLES, "projection"), device, batch=number)
        problem = Problem(simulation, steps, FinalPositions(simulation.positions))
        start = {"gravity": np.tile(simulation.scene.forces.gravity, (number, 1, 1))}
        wait = partial(wp.synchronize_device, simulation.device)
        works = {"forward": partial(problem.value, start), "gradient": partial(problem.value_and_gradient, start)}
        times = {what: 1e3 * median_seconds(work, repeats, wait) / steps for what, work in works.items()}
        rows.append({"scenes": number, **times})
    first = rows[0]
    for row in rows:
        for what in ("forward", "gradient"):
            row[f"{what}_gain"] = row["scenes"] / first["scenes"] * first[what] / row[what]
    name = device_name(device, environment()["processor"])
    found = {"device": name, "particles": PARTICLES, "steps": steps, "rows": rows}
    if as_json:
        return json.dumps(found, indent=2)
    head = f"{PARTICLES} particles a scene on {name}, ms a step of all, and times the throughput of {first['scenes']}:"
    lines = (
        f"{row['scenes']:6} scenes: forward {row['forward']:8.3f} ms, {row['forward_gain']:.1f} times; "
        f"gradient {row['gradient']:8.3f} ms, {row['gradient_gain']:.1f} times"
        for row in rows
    )
    return "\n".join([head, *lines])
