"""The same dam break on the reference engine, in C++."""

from typing import Any

from benchmarks.bench.scene import ITERATIONS, dam_break
from benchmarks.bench.timing import median_seconds
from cortado import reference
from cortado.arrays import check_steps


def measure_reference(particles: int, steps: int, precision: str, repeats: int) -> dict[str, Any]:
    """Times of the reference engine, on one core and on all."""
    scene, steps = dam_break(particles), check_steps(steps)
    alone, together = reference.Simulation(scene, precision, threads=1), reference.Simulation(scene, precision)
    loss = reference.FinalPositions(alone.positions)
    down = {"gravity": scene.forces.gravity}
    forward = median_seconds(lambda: alone.run(steps, record_every=steps), repeats)
    parallel = median_seconds(lambda: together.run(steps, record_every=steps), repeats)
    tangent = median_seconds(lambda: together.tangent(down, down, steps, record_every=steps), repeats)
    gradient = median_seconds(lambda: together.gradient(down, steps, loss, record_every=steps), repeats)
    return {
        "engine": "reference",
        "precision": precision,
        "threads": together.threads,
        "particles": len(alone.positions),
        "steps": steps,
        "repeats": repeats,
        "iterations_per_step": ITERATIONS,
        "forward_ms_per_step_one_thread": 1e3 * forward / steps,
        "forward_ms_per_step": 1e3 * parallel / steps,
        "speed_up": forward / parallel,
        "tangent_ms_per_step": 1e3 * tangent / steps,
        "gradient_ms_per_step": 1e3 * gradient / steps,
    }
