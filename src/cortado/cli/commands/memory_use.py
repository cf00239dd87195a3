"""How much memory a simulation takes: measured on a GPU, where Warp's pool counts it, and estimated on a CPU."""

from typing import Any

import warp as wp

from cortado.device.memory import gradient_parts, simulation_parts
from cortado.rollout.rollout import Rollout
from cortado.simulation import Simulation
from cortado.solvers.particles import ParticleSolver

MEASURED, ESTIMATED = "measured: high-water mark of the memory pool", "estimated: cortado.device.memory"


def memory_high(device: Any) -> int:
    """[bytes] in use on a GPU at most so far; 0 on a CPU."""
    return 0 if device.is_cpu else int(wp.get_mempool_used_mem_high(device))


def estimated_bytes(simulation: Simulation, rollout: Rollout) -> tuple[float, float]:
    """[bytes] of a forward run, and of one with its gradient and a checkpoint of every step."""
    particles, walls, real = simulation.particles, len(simulation.walls), simulation.precision.bytes
    solver = simulation.solver
    assert isinstance(solver, ParticleSolver)
    capacity = solver.search.capacity
    forward = sum(simulation_parts(particles, walls, capacity, real).values())
    counts = rollout.diagnostics.get("iterations")  # a solver of one's own may have none
    iterations = 0 if counts is None else int(counts.max(initial=0))
    checkpoints = rollout.steps * sum(array.capacity for array in rollout.initial.arrays())
    return forward, forward + checkpoints + sum(gradient_parts(particles, iterations, real).values())
