"""How much memory a simulation takes, and what a budget buys: ``python benchmarks/memory.py --sizes 8000 97000``.

Every size is measured in a process of its own: on a GPU by the high-water mark of Warp's memory pool, on a CPU by how
much the largest resident size of the process grows, beyond that of a process which has done the same with 27 particles.
"""

import argparse
import json
import os
import resource
import sys
from typing import Any

import numpy as np
from programs import ProgramError, last_json

from benchmarks.bench.dam_break import memory_high
from benchmarks.bench.scene import dam_break
from cortado import Problem, Simulation
from cortado.cli.describe import estimated_bytes
from cortado.losses import FinalPositions

BUDGETS = (8, 24, 80, 141)
"""[GB]"""


def measure(particles: int, steps: int, device: str) -> dict[str, Any]:
    """Bytes a particle of a forward run, of one with its gradient, and what Cortado itself estimates."""
    _run(27, steps, device)
    simulation, forward, both = _run(particles, steps, device)
    rollout = simulation.rollout(steps)
    rollout.forward(keep=False)
    estimated = estimated_bytes(simulation, rollout)
    n = simulation.particles
    return {
        "particles": n,
        "steps": steps,
        "forward": forward / n,
        "gradient": both / n,
        "estimated_forward": estimated[0] / n,
        "estimated_gradient": estimated[1] / n,
    }


def _run(particles: int, steps: int, device: str) -> tuple[Simulation, int, int]:
    """A simulation that has gone forward and back, and the bytes that each took at most."""
    before = _resident()
    simulation = Simulation(dam_break(particles), device)
    problem = Problem(simulation, steps, FinalPositions(simulation.positions))
    start = {"gravity": np.array(simulation.scene.forces.gravity)}
    on_cpu = simulation.device.is_cpu
    problem.value(start)
    forward = _resident() - before if on_cpu else memory_high(simulation.device)
    problem.value_and_gradient(start)
    return simulation, forward, _resident() - before if on_cpu else memory_high(simulation.device)


def _resident() -> int:
    """The largest resident size of this process so far."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main() -> None:
    parser = argparse.ArgumentParser(description="Memory of a simulation.")
    parser.add_argument("--sizes", type=int, nargs="+", default=[8000, 97336, 1000000])
    parser.add_argument("--steps", type=int, default=20, help="each of which keeps a checkpoint for the gradient")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--one", action="store_true", help="one size, here and as JSON")
    given = parser.parse_args()
    if given.one:
        print(json.dumps(measure(given.sizes[0], given.steps, given.device)))
        return
    print(f"bytes a particle, gradient of {given.steps} steps")
    print(f"{'particles':>12}{'forward':>12}{'gradient':>12}{'estimated':>20}")
    rows = []
    for particles in given.sizes:
        words = ["--one", "--sizes", str(particles), "--steps", str(given.steps), "--device", given.device]
        try:
            rows.append(last_json([sys.executable, __file__, *words], 3600.0, dict(os.environ)))
        except ProgramError as error:
            print(f"{particles:12,}  {error}")
            continue
        row = rows[-1]
        estimated = f"{row['estimated_forward']:,.0f} / {row['estimated_gradient']:,.0f}"
        print(f"{row['particles']:12,}{row['forward']:12,.0f}{row['gradient']:12,.0f}{estimated:>20}", flush=True)
    for budget in BUDGETS if rows else ():
        forward, gradient = (1e9 * budget / rows[-1][what] for what in ("forward", "gradient"))
        print(f"{budget:4} GB buy {forward:.2g} particles forward, {gradient:.2g} with the gradient")


if __name__ == "__main__":
    main()
