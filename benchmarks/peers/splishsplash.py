"""SPlisHSPlasH on the dam break of `benchmarks.bench.scene`, on the CPU, forward alone: it has no gradients.

    python benchmarks/peers/splishsplash.py --particles 8000 --method PCISPH --json

The same lattice, box, time step and support radius. PCISPH does as many pressure iterations in every step as Cortado;
DFSPH as many as its own tolerances ask for. What differs from Cortado: walls are one layer of particles on their
surface (Akinci et al. 2012; volume maps took 1.7 times as long), and the particles have 0.8 of the volume of a cell of
this lattice, so that the pressure is 0 until the block has been compressed, which changes nothing in the work of an
iteration.

Threads that wait sleep, unless the environment has OMP_WAIT_POLICY=active: beside other processes, threads that spin
made a step take up to four times as long.

It is the package `pysplishsplash`. Where its import crashes, its own libGLX, libOpenGL and libGLdispatch do not get on
with those of the system: put links to the system's in their place, in the folder ``pysplishsplash.libs``.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path
from statistics import median
from typing import Any

METHODS = {"PCISPH": 1, "DFSPH": 4}
ITERATIONS = 5
BOX = (2.0, 1.5, 1.0)
VISCOSITY = 0.05
WARM = 3
"""Steps that are not timed."""
CUBE = """v -0.5 -0.5 -0.5
v 0.5 -0.5 -0.5
v 0.5 0.5 -0.5
v -0.5 0.5 -0.5
v -0.5 -0.5 0.5
v 0.5 -0.5 0.5
v 0.5 0.5 0.5
v -0.5 0.5 0.5
f 1 3 2
f 1 4 3
f 5 6 7
f 5 7 8
f 1 2 6
f 1 6 5
f 4 7 3
f 4 8 7
f 1 5 8
f 1 8 4
f 2 3 7
f 2 7 6
"""


def scene(edge: int, method: str, steps: int) -> dict[str, Any]:
    """The block as SPlisHSPlasH describes it."""
    spacing = 1.0 / edge
    radius, time_step = 0.5 * spacing, 0.02 * spacing
    solver = {"PCISPH": {"minIterations": ITERATIONS, "maxIterations": ITERATIONS}, "DFSPH": {}}[method]
    return {
        "Configuration": {
            "particleRadius": radius,
            "simulationMethod": METHODS[method],
            "gravitation": [0.0, -9.81, 0.0],
            "timeStepSize": time_step,
            "cflMethod": 0,
            "cflMaxTimeStepSize": time_step,
            "boundaryHandlingMethod": 0,
            "stopAt": (steps + 0.5) * time_step,
            method: solver,
        },
        "Materials": [
            {
                "id": "Fluid",
                "density0": 1000,
                "viscosityMethod": 1,
                "surfaceTensionMethod": 0,
                "vorticityMethod": 0,
                "Standard viscosity": {"viscosity": VISCOSITY / 1000.0},
            }
        ],
        "RigidBodies": [
            {
                "geometryFile": "cube.obj",
                "translation": [0.5 * length for length in BOX],
                "rotationAxis": [1, 0, 0],
                "rotationAngle": 0,
                "scale": list(BOX),
                "isDynamic": False,
                "isWall": True,
            }
        ],
        "FluidBlocks": [
            {
                "denseMode": 0,
                "start": [-radius] * 3,
                "end": [1.0 + radius] * 3,
                "translation": [0.0, 0.0, 0.0],
                "scale": [1.0, 1.0, 1.0],
            }
        ],
    }


def measure(particles: int, method: str, steps: int, repeats: int) -> dict[str, Any]:
    """Milliseconds a step: the median over as many steps as Cortado's repeats take together."""
    import pysplishsplash as sph

    edge, timed = max(round(particles ** (1 / 3)), 2), steps * repeats
    times: list[float] = []
    iterations: list[int] = []
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "cube.obj").write_text(CUBE)
        file = Path(folder) / "scene.json"
        file.write_text(json.dumps(scene(edge, method, WARM + timed)))
        base = sph.Exec.SimulatorBase()
        base.init(sceneFile=str(file), useGui=False, initialPause=False, outputDir=folder, useCache=False)
        base.initSimulation()
        simulation = sph.Simulation.getCurrent()
        solver = simulation.getTimeStep()
        number = next(n for n in range(solver.numParameters()) if solver.getName(n) == "iterations")

        def note() -> None:
            times.append(time.perf_counter())
            iterations.append(solver.getValueUInt(number))

        base.setTimeStepCB(note)
        base.runSimulation()
    spent = [after - before for before, after in zip(times[WARM:-1], times[WARM + 1 :], strict=True)]
    return {
        "peer": f"SPlisHSPlasH, {method}",
        "version": f"pysplishsplash {metadata.version('pysplishsplash')}",
        "device": "cpu",
        "threads": int(os.environ["OMP_NUM_THREADS"]),
        "particles": simulation.getFluidModel(0).numActiveParticles(),
        "steps": steps,
        "repeats": repeats,
        "iterations_per_step": median(iterations[WARM:]),
        "rollout": {"ms": 1e3 * median(spent)},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="SPlisHSPlasH, timed.")
    parser.add_argument("--particles", type=int, default=8000)
    parser.add_argument("--method", choices=list(METHODS), default="PCISPH")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", action="store_true", help="one line of JSON at the end")
    given = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = str(given.threads)
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    row = measure(given.particles, given.method, given.steps, given.repeats)
    print(json.dumps(row) if given.json else "\n".join(f"{name:30} {value}" for name, value in row.items()))
    sys.stdout.flush()
    os._exit(0)  # it does not survive the end of the interpreter


if __name__ == "__main__":
    main()
