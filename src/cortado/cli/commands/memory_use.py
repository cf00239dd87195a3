"""How much memory a simulation takes, by an estimate."""

from cortado.device.memory import gradient_parts, simulation_parts
from cortado.rollout.rollout import Rollout
from cortado.simulation import Simulation
from cortado.solvers.particles import ParticleSolver


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
