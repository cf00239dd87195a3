"""Walls hold the fluid, and the fluid keeps its density, at every step of a violent flow."""

from typing import Any

import numpy as np
import pytest

from cortado import Scene, Simulation, Trajectory
from cortado.commands.bench import dam_break

SUPPORTS = {"cubic_spline": 2.0, "wendland_c2": 2.6, "wendland_c4": 3.0}


def box(particles: int = 1000, kernel: str = "cubic_spline") -> Scene:
    """The dam break of `cortado bench`."""
    return _with_kernel(dam_break(particles).model_dump(mode="json"), kernel)


def cup(kernel: str = "cubic_spline") -> Scene:
    """1,008 particles that fall into a tilted cup with a lid."""
    tables = {
        "name": "cup",
        "dimension": 3,
        "discretisation": {"spacing": 0.1},
        "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 0.05}],
        "fluid": [{"shape": "cylinder", "base": [0.0, 0.6, 0.0], "radius": 0.6, "height": 0.9, "phase": "water"}],
        "container": {"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": 0.65, "height": 1.6, "lid": True},
        "forces": {"gravity": [3.0, -9.81, 0.0]},
        "solver": {"time_step": 0.002, "minimum_iterations": 5, "maximum_iterations": 5},
    }
    return _with_kernel(tables, kernel)


def _with_kernel(tables: dict[str, Any], kernel: str) -> Scene:
    changed = {**tables["discretisation"], "kernel": kernel, "support": SUPPORTS[kernel]}
    return Scene(**{**tables, "discretisation": changed})


def escaped(scene: Scene, trajectory: Trajectory) -> int:
    """How many times a particle was outside of the container at the end of a step."""
    everywhere = trajectory.positions.reshape(-1, trajectory.dimension)
    return int(np.count_nonzero(~scene.container.contains(everywhere.astype(np.float64), 0.0)))


def worst_density_error(trajectory: Trajectory) -> float:
    """The greatest average compression after the first ten steps."""
    return float(trajectory.density_errors[10:].max())


@pytest.mark.parametrize("make", [box, cup])
def test_walls_hold_a_dam_break(make):
    """1,000 particles, 1,000 steps."""
    _check(make(), 1000)


@pytest.mark.parametrize("kernel", ["wendland_c2", "wendland_c4"])
@pytest.mark.parametrize("make", [box, cup])
def test_walls_hold_a_dam_break_with_other_kernels(make, kernel):
    _check(make(kernel=kernel), 300)


def _check(scene: Scene, steps: int) -> None:
    trajectory = Simulation(scene, precision="float32").run(steps)
    travelled = np.linalg.norm(trajectory.positions[-1] - trajectory.positions[0], axis=1)
    assert travelled.max() > 3.0 * scene.discretisation.spacing  # it did move
    assert escaped(scene, trajectory) == 0
    assert worst_density_error(trajectory) <= 0.01
