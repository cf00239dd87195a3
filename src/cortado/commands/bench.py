"""``cortado bench``: a dam break, timed."""

import json
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from cortado import reference
from cortado.losses import FinalPositions
from cortado.problem import Problem
from cortado.scene.containers import BoxContainer
from cortado.scene.fluids import BoxFluid
from cortado.scene.model import Discretisation, Forces, Phase, Solver
from cortado.scene.scene import Scene
from cortado.simulation import Simulation, check_steps

REPEATS = 3
"""The best of so many runs counts."""


def dam_break(particles: int) -> Scene:
    """A cube of about that many particles beside an empty half of a box; 5 iterations a step."""
    edge = max(round(particles ** (1 / 3)), 2)
    spacing = 1.0 / edge
    return Scene(
        name="dam break",
        dimension=3,
        discretisation=Discretisation(spacing=spacing),
        phase=(Phase(name="water", rest_density=1000.0, viscosity=0.05),),
        fluid=(BoxFluid(lower=(0.0, 0.0, 0.0), upper=(1.0, 1.0, 1.0), phase="water"),),
        container=BoxContainer(lower=(0.0, 0.0, 0.0), upper=(2.0, 1.5, 1.0)),
        forces=Forces(gravity=(0.0, -9.81, 0.0)),
        solver=Solver(time_step=0.02 * spacing, minimum_iterations=5, maximum_iterations=5),
    )


def bench_dam_break(particles: int, steps: int, device: str, precision: str, as_json: bool) -> str:
    """Times and memory of the forward run and of its gradient, as text."""
    simulation = Simulation(dam_break(particles), device, precision)
    problem = Problem(simulation, check_steps(steps), FinalPositions(simulation.positions))
    start = {"gravity": np.array(simulation.scene.forces.gravity)}
    wait = partial(wp.synchronize_device, simulation.device)
    forward = _best(lambda: problem.value(start), wait)
    neighbourhood = simulation.solver.context(simulation.solver.new_parameters(1)).neighbourhood
    gradient = _best(lambda: problem.value_and_gradient(start), wait)
    rows: dict[str, Any] = {
        "device": simulation.device.name,
        "precision": precision,
        "particles": simulation.particles,
        "wall_particles": len(simulation.walls),
        "steps": steps,
        "iterations_per_step": 5,
        "neighbours_per_particle": float(neighbourhood.count.numpy().mean()),
        "forward_ms_per_step": 1e3 * forward / steps,
        "gradient_ms_per_step": 1e3 * gradient / steps,
        "gradient_over_forward": gradient / forward,
    }
    if not simulation.device.is_cpu:
        rows["bytes_per_particle"] = wp.get_mempool_used_mem_high(simulation.device) / simulation.particles
    return _text(rows, as_json)


def bench_reference(particles: int, steps: int, precision: str, as_json: bool) -> str:
    """Times of the reference engine, on one core and on all, as text."""
    scene, steps = dam_break(particles), check_steps(steps)
    alone, together = reference.Simulation(scene, precision, threads=1), reference.Simulation(scene, precision)
    loss = reference.FinalPositions(alone.positions)
    down = {"gravity": scene.forces.gravity}
    forward = _best(lambda: alone.run(steps, record_every=steps))
    parallel = _best(lambda: together.run(steps, record_every=steps))
    rows: dict[str, Any] = {
        "engine": "reference",
        "precision": precision,
        "threads": together.threads,
        "particles": len(alone.positions),
        "steps": steps,
        "iterations_per_step": 5,
        "forward_ms_per_step_one_thread": 1e3 * forward / steps,
        "forward_ms_per_step": 1e3 * parallel / steps,
        "speed_up": forward / parallel,
        "tangent_ms_per_step": 1e3 * _best(lambda: together.tangent(down, down, steps, record_every=steps)) / steps,
        "gradient_ms_per_step": 1e3 * _best(lambda: together.gradient(down, steps, loss, record_every=steps)) / steps,
    }
    return _text(rows, as_json)


def _text(rows: dict[str, Any], as_json: bool) -> str:
    if as_json:
        return json.dumps(rows, indent=2)
    return "\n".join(
        f"{name:30} {value:.4g}" if isinstance(value, float) else f"{name:30} {value}" for name, value in rows.items()
    )


def _best(work: Callable[[], object], wait: Callable[[], object] = lambda: None) -> float:
    """Seconds of the fastest of a few runs, after one that compiles and fills the caches; ``wait`` for the device."""
    work()
    times = []
    for _ in range(REPEATS):
        wait()
        start = time.perf_counter()
        work()
        wait()
        times.append(time.perf_counter() - start)
    return min(times)
