"""Time until a scene with a large mesh can run: ``python benchmarks/large_mesh.py --across 100 --motion path``.

A cube of water, so many particles wide, stands beside a dented ball of 199,000 triangles, a quarter of a metre in
radius, in a tank 1.6 times as long; where no solid cuts the water nothing is packed. The ball is so near to the tank
that, with ``--motion fixed``, walls of both are found together where it is. Seconds are those of one core: set
``CORTADO_CORES=1 OPENBLAS_NUM_THREADS=1``.
"""

import argparse
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

SECTIONS = 224
"""Of the ball, around its axis and along it."""
MOTIONS: dict[str, dict[str, Any]] = {"fixed": {}, "path": {"motion": "path", "velocity": [0.1, 0.0, 0.0]}}


def dented_ball(file: Path) -> int:
    """Write the mesh to a file; returns how many triangles it has."""
    import trimesh

    ball = trimesh.creation.uv_sphere(0.25, count=[SECTIONS, SECTIONS])
    x, y, z = (ball.vertices / np.linalg.norm(ball.vertices, axis=1, keepdims=True)).T
    dents = 1.0 + 0.05 * np.sin(7.0 * x) * np.cos(5.0 * y) * np.sin(9.0 * z)
    mesh = trimesh.Trimesh(ball.vertices * dents[:, None], ball.faces)
    mesh.export(file)
    return len(mesh.faces)


def tables(across: int, file: Path, motion: str) -> dict[str, Any]:
    """The scene."""
    ball = {"name": "ball", "shape": "mesh", "file": str(file), "position": [1.3, 0.5, 0.5], **MOTIONS[motion]}
    return {
        "dimension": 3,
        "discretisation": {"spacing": 1.0 / across},
        "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 0.001}],
        "fluid": [{"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [1.0, 1.0, 1.0], "phase": "water"}],
        "container": {"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [1.6, 1.0, 1.0]},
        "solid": [ball],
        "solver": {"kind": "projection", "time_step": 0.045 / across},
    }


def measured(what: str, make: Callable[[], Any]) -> Any:
    """What is made, after a line about how long it took."""
    clock, processor = time.perf_counter(), time.process_time()
    made = make()
    print(f"{what}: {time.process_time() - processor:.1f} s of processor time, {time.perf_counter() - clock:.1f} s")
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--across", type=int, default=100, help="particles along a side of the water; 100 are a million"
    )
    parser.add_argument("--motion", choices=MOTIONS, default="path", help="of the ball")
    parser.add_argument("--device", default="cpu")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "ball.stl"
        print(f"{dented_ball(file):,} triangles, {given.across**3:,} particles")
        cortado = measured("import", lambda: __import__("cortado"))
        scene = measured("scene", lambda: cortado.Scene(**tables(given.across, file, given.motion)))
        measured("simulation", lambda: cortado.Simulation(scene, device=given.device))


if __name__ == "__main__":
    main()
