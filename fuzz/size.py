"""Whether a scene is simply large, so that a computer has a right to be busy with it for long."""

import warnings
from collections.abc import Sequence
from pathlib import Path

from cortado.errors import CortadoError, CortadoWarning
from cortado.scene.scene import load_scene, read_toml

MOST_PARTICLES, MOST_PIXELS, MOST_WORK = 30_000, 500_000, 2e6
"""Work is counted in pressure iterations of one particle."""


def is_large(file: Path, overrides: Sequence[str], steps: int) -> bool:
    """Whether the scene or task of a file can be read, and asks for more than a case should."""
    try:
        with warnings.catch_warnings(action="ignore", category=CortadoWarning):
            scene, tables = load_scene(file, overrides), read_toml(file, overrides)
    except CortadoError:
        return False
    spacing = scene.discretisation.spacing
    bodies = [*scene.fluid, *scene.emitter]
    particles = sum(body.count(spacing) for body in bodies) + scene.container.wall_count(spacing)
    pixels = scene.render.resolution[0] * scene.render.resolution[1] if scene.render else 0
    runs = 1
    if "problem" in tables and "optimise" in tables:
        optimise, steps = tables["optimise"], tables["problem"]["steps"]
        searches = len(optimise.get("extinction_schedule", [1.0])) * optimise.get("gradient", {}).get("samples", 1)
        runs = 5 * searches * (optimise["iterations"] + 1)
    work = particles * max(steps, 1) * (3 + scene.solver.maximum_iterations) * runs
    return particles > MOST_PARTICLES or pixels > MOST_PIXELS or work > MOST_WORK
