"""Steps of a batch of environments, timed beside those of the simulation alone."""

import json
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from benchmarks.bench.environment import environment
from benchmarks.bench.timing import now
from cortado.environments import make_vec

WARM = 3
"""Steps before those that are timed: they compile kernels, make room and capture graphs."""


def bench_environments(
    task: str, scenes: int, size: str, steps: int, device: str, precision: str, as_json: bool
) -> str:
    """Particle-steps a millisecond, as text: of so many steps of the environment under random actions, and of those of
    the simulation alone, from the same states with the same actions."""
    envs = make_vec(task, scenes, size=size, device=device, precision=precision)
    envs.reset(seed=0)
    engine, simulation = envs.scenes, envs.scenes.simulation
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (WARM + steps, *np.shape(envs.action_space.sample())))
    whole, bare = list[float](), list[float]()
    for action in actions:
        for work, times in ((envs.step, whole), (engine.advance, bare)):
            times.append(seconds(partial(work, action), device))
            if not np.isfinite(engine.observed()).all():  # a scene diverged
                envs.reset()
    steps_of_particles = scenes * simulation.particles * engine.task.substeps
    around = environment()
    found: dict[str, Any] = {
        "device": device_name(device, around["processor"]),
        "task": task,
        "scenes": scenes,
        "particles": simulation.particles,
        "simulation_steps": engine.task.substeps,
        "environment_ms": 1e3 * float(np.median(whole[WARM:])),
        "simulation_ms": 1e3 * float(np.median(bare[WARM:])),
    }
    found["particle_steps_per_ms"] = steps_of_particles / found["environment_ms"]
    found["particle_steps_per_ms_of_the_simulation_alone"] = steps_of_particles / found["simulation_ms"]
    return json.dumps(found, indent=2) if as_json else _as_text(found)


def device_name(device: str, processor: str) -> str:
    """Return the name of a GPU, or the processor's."""
    return processor if wp.get_device(device).is_cpu else str(wp.get_device(device).name)


def seconds(work: Callable[[], Any], device: str) -> float:
    """Return the time of work, as `now` has it, until the device has done it."""
    wp.synchronize_device(device)
    start = now()
    work()
    wp.synchronize_device(device)
    return now() - start


def _as_text(found: dict[str, Any]) -> str:
    return (
        f"{found['task']}, {found['scenes']} scenes of {found['particles']} particles, on {found['device']}: a step of "
        f"the environment, {found['simulation_steps']} of the simulation, takes {found['environment_ms']:.3g} ms, and "
        f"{found['simulation_ms']:.3g} ms of these are the simulation's.\n"
        f"{found['particle_steps_per_ms']:.0f} particle-steps a millisecond; the simulation alone has "
        f"{found['particle_steps_per_ms_of_the_simulation_alone']:.0f}."
    )
