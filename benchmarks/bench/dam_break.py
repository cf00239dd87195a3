"""The measurements of one dam break."""

import gc
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from benchmarks.bench.passes import Pass, PassTimer
from benchmarks.bench.scene import ITERATIONS, dam_break, search_of
from benchmarks.bench.timing import median_seconds
from cortado.arrays import check_steps
from cortado.cli.describe import estimated_bytes
from cortado.device.launching import CapturedGraph
from cortado.losses import FinalPositions
from cortado.problem import Problem
from cortado.rollout.rollout import Rollout
from cortado.simulation import Simulation

Row = dict[str, Any]
MEASURED, ESTIMATED = "measured: high-water mark of the memory pool", "estimated: cortado.device.threads"


def measure_dam_break(
    particles: int, steps: int, device: str, precision: str, repeats: int, solver: str = "pcisph"
) -> Row:
    """Times [ms a step] and memory of a dam break, without floors, which `with_floors` adds.

    ``step``: the device's work alone, step after step. ``rollout``: `Problem.value`, as a user calls it. ``gradient``:
    `Problem.value_and_gradient` with respect to gravity. ``passes`` and ``adjoint_passes``: see `PassTimer`.
    """
    gc.collect()
    simulation = Simulation(dam_break(particles, solver), device, precision)
    problem = Problem(simulation, check_steps(steps), FinalPositions(simulation.positions))
    start = {"gravity": np.array(simulation.scene.forces.gravity)}
    wait = partial(wp.synchronize_device, simulation.device)
    row: Row = {
        "particles": simulation.particles,
        "wall_particles": len(simulation.walls),
        "neighbours_per_particle": 0.0,
        "precision": precision,
        "steps": steps,
        "repeats": repeats,
        "solver": solver,
        "iterations_per_step": getattr(simulation.scene.solver, "iterations", ITERATIONS),
    }
    forward = median_seconds(lambda: problem.value(start), repeats, wait)
    forward_high = memory_high(simulation.device)
    gradient = median_seconds(lambda: problem.value_and_gradient(start), repeats, wait)
    both_high = memory_high(simulation.device)
    with simulation.turn:
        rollout = simulation.rollout(steps)
        rollout.forward(keep=False)
        row["step"] = {"ms": 1e3 * _step_seconds(rollout, repeats)}
        row["rollout"] = {"ms": 1e3 * forward / steps}
        row["gradient"] = {"ms": 1e3 * gradient / steps}
        timer = PassTimer(rollout, search_of(simulation), repeats)
        row["passes"] = [_pass_row(one) for one in timer.step_passes()]
        row["adjoint_passes"] = [_pass_row(one) for one in timer.adjoint_passes()]
    row["neighbours_per_particle"] = timer.pairs / simulation.particles
    if simulation.device.is_cpu:
        used, how = estimated_bytes(simulation, rollout), ESTIMATED
    else:
        used, how = (forward_high, both_high), MEASURED
    row["memory"] = {
        "forward_bytes_per_particle": used[0] / simulation.particles,
        "gradient_bytes_per_particle": used[1] / simulation.particles,
        "how": how,
    }
    return row


def memory_high(device: Any) -> int:
    """[bytes] in use on a GPU at most so far, which Warp's pool counts; 0 on a CPU."""
    return 0 if device.is_cpu else int(wp.get_mempool_used_mem_high(device))


def with_floors(row: Row, bandwidth: float) -> Row:
    """The same with ``floor_ms``, what the bytes of each pass take at a bandwidth [bytes / s]; see
    `benchmarks.bench.floor`. The floor of a step is the sum of those of its passes, that of a gradient of both ways."""

    def floor(passes: list[Row]) -> float:
        return sum(1e3 * one["bytes"] / bandwidth for one in passes)

    there, back = floor(row["passes"]), floor(row["adjoint_passes"])
    floors = {"step": there, "rollout": there, "gradient": there + back}
    timed = {name: {**row[name], "floor_ms": floors[name]} for name in floors}
    passes = {name: [{**one, "floor_ms": floor([one])} for one in row[name]] for name in ("passes", "adjoint_passes")}
    return {**row, **timed, **passes}


def _step_seconds(rollout: Rollout, repeats: int) -> float:
    """Of a step in the middle of others, as a graph where there is one."""
    solver, state = rollout.solver, rollout.initial.following()
    step = CapturedGraph(partial(solver.step, state, state, rollout.parameters, rollout.log), solver.launch)

    def begin() -> None:
        solver.reset()
        state.assign(rollout.initial)

    def run() -> None:
        for _ in range(rollout.steps):
            step()

    return median_seconds(run, repeats, partial(wp.synchronize_device, solver.device), begin) / rollout.steps


def _pass_row(one: Pass) -> Row:
    row: Row = {"name": one.name, "launches": one.launches, "ms": 1e3 * one.seconds, "bytes": one.bytes}
    return {**row, "pairs_per_second": one.pairs / one.seconds} if one.pairs else row
