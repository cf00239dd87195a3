"""Bodies of fluid that spin about their middle at the start."""

import numpy as np
import pytest

from cortado import Scene, SceneError, Simulation
from cortado.scene.stability import stability_limits

WATER = {"name": "water", "rest_density": 1000.0, "viscosity": 0.0}


def scene(dimension, *fluid, **more):
    forces = {"gravity": [0.0] * dimension, "viscosity": "none"}
    tables = {
        "solver": {"kind": "pcisph", "time_step": 0.001},
        "discretisation": {"spacing": 0.1},
        "phase": [WATER],
        "forces": forces,
        "container": {"shape": "none"},
    }
    return Scene(dimension=dimension, fluid=[{"phase": "water", **one} for one in fluid], **tables, **more)


def test_a_rectangle_spins_counterclockwise_besides_its_velocity():
    box = {"shape": "box", "lower": [1.0, 0.0], "upper": [2.0, 0.6], "velocity": [0.3, 0.0], "angular_velocity": 2.0}
    rest = {"shape": "box", "lower": [3.0, 0.0], "upper": [3.4, 0.4]}
    simulation = Simulation(scene(2, box, rest), precision="float64")
    arms = simulation.positions[:60] - [1.5, 0.3]
    wanted = np.stack([0.3 - 2.0 * arms[:, 1], 2.0 * arms[:, 0]], axis=1)
    np.testing.assert_allclose(simulation.velocities[:60], wanted, atol=1e-12)
    assert not simulation.velocities[60:].any()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_sphere_spins_where_its_particles_were_packed(axis):
    spin = 3.0 * np.eye(3)[axis]
    ball = {"shape": "sphere", "centre": [1.0, 2.0, 3.0], "radius": 0.3, "angular_velocity": spin.tolist()}
    simulation = Simulation(scene(3, ball), precision="float64")
    arms = simulation.positions - simulation.positions.mean(axis=0)
    np.testing.assert_allclose(simulation.velocities, np.cross(spin, arms), atol=1e-12)
    momentum = np.cross(arms, simulation.velocities).sum(axis=0)
    assert momentum[axis] > 0.0 and np.abs(simulation.velocities.mean(axis=0)).max() < 1e-12


def test_the_time_step_knows_how_fast_the_fastest_particle_is():
    box = {"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0]}
    still, spinning = (stability_limits(scene(2, {**box, "angular_velocity": w})) for w in (0.0, 50.0))
    greatest = np.linalg.norm(Simulation(scene(2, {**box, "angular_velocity": 50.0})).velocities, axis=1).max()
    assert spinning["speed"] < still["speed"]
    assert scene(2, {**box, "angular_velocity": 50.0}).fluid[0].greatest_speed(0.1) >= (1.0 - 1e-12) * greatest


@pytest.mark.parametrize(
    ("dimension", "spin", "words"),
    [(2, [1.0, 0.0, 0.0], "one number in 2-D"), (3, 1.0, "a list of 3 components"), (2, "fast", "angular_velocity")],
)
def test_wrong_spins_are_sentences(dimension, spin, words):
    lower, upper = [0.0] * dimension, [1.0] * dimension
    with pytest.raises(SceneError, match=words):
        scene(dimension, {"shape": "box", "lower": lower, "upper": upper, "angular_velocity": spin})
