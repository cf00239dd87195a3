"""Whether the peer in JAX computes the same as Cortado: ``python benchmarks/physics.py``.

A cube of fluid without walls falls from random velocities, which the pressure and the viscosity work against; positions
after some steps are compared in units of the spacing, beside how far particles moved and how far they would have moved
without pressure and viscosity.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from programs import PEERS

from benchmarks.bench.scene import dam_break
from cortado import Simulation
from cortado.scene.shape_tables import NoContainer


def main() -> None:
    parser = argparse.ArgumentParser(description="The peer in JAX beside Cortado, without walls.")
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--speed", type=float, default=0.5, help="standard deviation of velocities [m/s]")
    parser.add_argument("--jax-python", default=sys.executable, help="an interpreter that has jax")
    given = parser.parse_args()

    scene = dam_break(given.particles).model_copy(update={"container": NoContainer()})
    simulation = Simulation(scene)
    velocities = given.speed * np.random.default_rng(0).normal(size=simulation.positions.shape)
    own = simulation.run(given.steps, {"initial_velocities": velocities}, record_every=given.steps)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "state.npy"
        np.save(file, velocities)
        words = ["--run-from", str(file), "--steps", str(given.steps)]
        subprocess.run([given.jax_python, str(PEERS / "jax_pcisph.py"), *words], check=True)
        peer, _ = np.load(file)

    spacing, time = scene.discretisation.spacing, given.steps * scene.solver.time_step
    free = (
        simulation.positions
        + time * velocities
        + 0.5 * time * (time + scene.solver.time_step) * np.array(scene.forces.gravity)
    )

    def largest(offsets: np.ndarray) -> str:
        return f"{np.abs(offsets).max() / spacing:.2g} spacings at most"

    end = own.positions[-1]
    print(
        f"{len(end):,} particles, {given.steps} steps: the density error is {own.diagnostics['density_errors'][-1]:.2g}"
    )
    print(f"they moved by                                  {largest(end - simulation.positions)}")
    print(f"pressure and viscosity moved them by           {largest(end - free)}")
    print(f"JAX is from Cortado                            {largest(peer - end)}")


if __name__ == "__main__":
    main()
