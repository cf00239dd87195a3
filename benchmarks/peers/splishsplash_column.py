"""A column of syrup that collapses in SPlisHSPlasH (DFSPH; viscosity of Weiler et al. 2018), in the plane.

    python -m benchmarks.peers.splishsplash_column runs/column.npz

writes what `python -m benchmarks.fits film --column runs/column.npz` draws: ``times`` (frames,) [s], ``positions`` and
``velocities`` (frames, n, 2), and the ``spacing`` [m] and ``viscosity`` [Pa s] that the program was told. It needs
NumPy and `pysplishsplash` alone (see `splishsplash.py`), and takes some two minutes of a core.

What that program does differently, and what was done about it:

- In the plane its particles have the volume of a square of their diameter, and a support of two diameters. On a square
  lattice its viscous force then has 0.64 of the viscosity that it was told for shear along the rows, and 1.30 for shear
  along the diagonals (a shear wave decays so; so do sums over the lattice). The column is a hexagonal lattice, on which
  both have 0.94.
- Particles rest most of a spacing away from the particles of a wall, so that walls stand 0.6 spacings outside of the
  box. With the viscosity of the fluid at walls a film slips by 0.9 spacings, with three times as much by 0.1.
"""

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers.splishsplash import CUBE

BOX = (0.16, 0.08)
LOWER, UPPER = np.array([0.06, 0.0]), np.array([0.10, 0.06])
DENSITY, VISCOSITY = 1300.0, 20.0
"""[kg/m3], [Pa s]"""
TIME_STEP, EVERY, LAST = 1.0 / 24_000.0, 100, 0.3
"""[s], steps from one recorded state to the next, [s]"""
WALL, GRIP = 0.6, 3.0
"""How far walls stand outside of the box, in spacings; viscosity at walls over that of the fluid."""


def lattice(spacing: float) -> np.ndarray:
    """(n, 2) nearly hexagonal, and whole in the column; about one particle in a square of the spacing."""
    columns = round((UPPER - LOWER)[0] / (spacing * (4.0 / 3.0) ** 0.25))
    rows = round((UPPER - LOWER)[1] / (spacing * (3.0 / 4.0) ** 0.25))
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(columns), np.arange(rows)))
    return LOWER + (UPPER - LOWER) * np.stack([(i + 0.25 + 0.5 * (j % 2)) / columns, (j + 0.5) / rows], axis=1)


def scene(spacing: float, number: int) -> dict[str, Any]:
    """The box, and a block with enough particles."""
    edge = spacing * (np.ceil(np.sqrt(number)) + 1.0)
    return {
        "Configuration": {
            "sim2D": True,
            "enableZSort": False,
            "particleRadius": 0.5 * spacing,
            "simulationMethod": 4,
            "gravitation": [0.0, -9.81, 0.0],
            "timeStepSize": TIME_STEP,
            "cflMethod": 0,
            "cflMaxTimeStepSize": TIME_STEP,
            "boundaryHandlingMethod": 0,
            "stopAt": LAST + 0.5 * TIME_STEP,
            "DFSPH": {"maxError": 0.02, "maxErrorV": 0.02},
        },
        "Materials": [
            {
                "id": "Fluid",
                "density0": DENSITY,
                "viscosityMethod": 6,
                "surfaceTensionMethod": 0,
                "vorticityMethod": 0,
                "Weiler et al. 2018": {
                    "viscosity": VISCOSITY / DENSITY,
                    "viscosityBoundary": GRIP * VISCOSITY / DENSITY,
                    "viscoMaxIter": 1000,
                    "viscoMaxError": 1e-4,
                },
            }
        ],
        "RigidBodies": [
            {
                "geometryFile": "cube.obj",
                "translation": [0.5 * BOX[0], 0.5 * BOX[1], 0.0],
                "rotationAxis": [1, 0, 0],
                "rotationAngle": 0,
                "scale": [BOX[0] + 2.0 * WALL * spacing, BOX[1] + 2.0 * WALL * spacing, 1.0],
                "isDynamic": False,
                "isWall": True,
            }
        ],
        "FluidBlocks": [
            {
                "denseMode": 0,
                "start": [0.0, 0.0, -1.0],
                "end": [edge, edge, 1.0],
                "translation": [0.0, 0.0, 0.0],
                "scale": [1.0, 1.0, 1.0],
            }
        ],
    }


def collapse(spacing: float) -> dict[str, Any]:
    """The arrays of the file."""
    import pysplishsplash as sph

    begin = lattice(spacing)
    number, own_spacing = len(begin), float(np.sqrt(np.prod(UPPER - LOWER) / len(begin)))
    states = [(begin, np.zeros_like(begin))]
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "cube.obj").write_text(CUBE)
        file = Path(folder) / "scene.json"
        file.write_text(json.dumps(scene(own_spacing, number)))
        base = sph.Exec.SimulatorBase()
        base.init(sceneFile=str(file), useGui=False, initialPause=False, outputDir=folder, useCache=False)
        base.initSimulation()
        fluid = sph.Simulation.getCurrent().getFluidModel(0)
        fluid.setNumActiveParticles(number)
        for i, (x, y) in enumerate(begin):
            fluid.setPosition(i, [x, y, 0.0])
            fluid.setPosition0(i, [x, y, 0.0])
        steps = 0

        def note() -> None:
            nonlocal steps
            steps += 1
            if steps % EVERY == 0:
                x, v = ([read(i)[:2] for i in range(number)] for read in (fluid.getPosition, fluid.getVelocity))
                states.append((np.array(x), np.array(v)))

        base.setTimeStepCB(note)
        base.runSimulation()
    positions, velocities = (np.stack([state[k] for state in states]) for k in range(2))
    times = TIME_STEP * EVERY * np.arange(len(states))
    return {
        "times": times,
        "positions": positions.astype(np.float32),
        "velocities": velocities.astype(np.float32),
        "spacing": own_spacing,
        "viscosity": VISCOSITY,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="A column of syrup that collapses in SPlisHSPlasH.")
    parser.add_argument("out", type=Path, help="file that is written, .npz")
    parser.add_argument("--spacing", type=float, default=0.001, help="of the particles [m]")
    given = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    np.savez_compressed(given.out, **collapse(given.spacing))
    sys.stdout.flush()
    os._exit(0)  # it does not survive the end of the interpreter


if __name__ == "__main__":
    main()
