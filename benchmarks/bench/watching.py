"""Runs that are watched by sensors, or keep frames, timed beside the same steps alone."""

import json
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from benchmarks.bench.environment import environment
from benchmarks.bench.learning import device_name, seconds
from cortado import Scene, Simulation, sensors

SELDOM = 10**9
"""Steps between two frames of a run that keeps the first and the last alone."""


def tank(depth: int) -> Scene:
    """Return a tank in the plane, that many spacings deep and 3.4 times as wide, which leans."""
    spacing = 1.0 / depth
    return Scene.model_validate(
        {
            "dimension": 2,
            "discretisation": {"spacing": spacing},
            "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 1e-6}],
            "fluid": [{"shape": "box", "lower": [0.0, 0.0], "upper": [3.4, 1.0], "phase": "water"}],
            "container": {"shape": "box", "lower": [0.0, 0.0], "upper": [3.4, 1.5]},
            "forces": {"gravity": [0.3, -9.81]},
            "solver": {"kind": "projection", "time_step": 0.1 * spacing},
        }
    )


def bench_watching(depth: int, steps: int, repeats: int, device: str, as_json: bool) -> str:
    """Return as text the time of a step of each kind of run from the second on, and its ratio to a captured step: the
    least of ``repeats``."""
    simulation = Simulation(tank(depth), device)
    first, on_device = simulation.state(), simulation.on_device()
    placed: dict[str, Any] = {
        "a wave gauge": sensors.WaveGauge([1.7, 0.0]),
        "a pressure probe": sensors.PressureProbe([1.7, 0.5]),
        "the force on the walls": sensors.WallForce(),
    }
    works: dict[str, tuple[int, Callable[[], Any]]] = {
        "captured steps": (steps, partial(simulation.step, on_device, None, steps)),
        "a run": (steps, partial(simulation.run, steps, record_every=SELDOM)),
        **{
            f"a run with {name}": (steps, partial(simulation.run, steps, record_every=SELDOM, sensors={"one": sensor}))
            for name, sensor in placed.items()
        },
        "a run with all three": (steps, partial(simulation.run, steps, record_every=SELDOM, sensors=placed)),
        "a frame in every step": (steps, partial(simulation.run, steps)),
        "a frame in every 22nd step": (4 * steps, partial(simulation.run, 4 * steps, record_every=22)),
        "calls of one step on the device": (steps, partial(_one_by_one, simulation, on_device, steps)),
        "calls of one step on the host": (steps, partial(_one_by_one, simulation, first, steps)),
    }
    times = {}
    for name, (count, work) in works.items():
        for _ in range(2):  # a CPU captures in the second
            work()
        times[name] = 1e3 * float(np.min([seconds(work, device) for _ in range(repeats)])) / count
    alone = times["captured steps"]
    found = {
        "device": device_name(device, environment()["processor"]),
        "particles": simulation.particles,
        "ms": times,
        "ratios": {name: time / alone for name, time in times.items()},
    }
    if as_json:
        return json.dumps(found, indent=2)
    head = f"{simulation.particles} particles on {found['device']}, a step:"
    return "\n".join([head, *(f"{name:34}{time:9.3f} ms{time / alone:8.2f}" for name, time in times.items())])


def _one_by_one(simulation: Simulation, state: Any, steps: int) -> None:
    for _ in range(steps):
        state = simulation.step(state)
