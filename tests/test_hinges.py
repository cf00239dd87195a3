"""Free bodies on hinges: pendulums, and what is refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import ellipk

from cortado import SceneError, Simulation
from floating_bodies import passing
from scenes import box
from test_free_bodies import BRICK, RAFT, plane, space

ARM, SIZE = 0.3, np.array([0.1, 0.6, 0.2])
"""From the hinge to the middle of a rod, and its sides [m]."""


def on_hinge(scene_of, table, hinge, **tables):
    """A scene of a body on a hinge, without a velocity, but for what else its tables say."""
    body = {key: value for key, value in table.items() if key not in ("velocity", "angular_velocity")}
    return scene_of(body, hinge=[{"name": "pin", "solid": table["name"], **hinge}], **tables)


def pendulum(angle, time_step=0.001, dimension=2, **hinge):
    """A rod that hangs from its upper end in nothing, and where the hinge is."""
    middle, turned = np.array([0.5, 3.0, 0.2]), Rotation.from_rotvec([0.0, 0.0, angle])
    pin, d = (middle + turned.apply([0.0, ARM, 0.0])), dimension
    rod = box((middle - 0.5 * SIZE)[:d].tolist(), (middle + 0.5 * SIZE)[:d].tolist(), name="rod", motion="free")
    rod |= {"density": 700.0, "rotation": angle if d == 2 else [0.0, 0.0, angle]}
    tables = {"container": {"shape": "none"}, "solver": {"kind": "projection", "time_step": time_step}}
    return on_hinge(plane if d == 2 else space, rod, {"position": pin[:d].tolist(), **hinge}, **tables), pin[:d]


def swing(scene, steps):
    """Times [s], angles [rad], angular velocities and positions of the rod."""
    run = Simulation(scene, precision="float64").run(steps, record_every=1)
    solid, d = run.solids["rod"], scene.dimension
    angles, spins = (a if d == 2 else a[:, 2] for a in (solid.rotations, solid.angular_velocities))
    return run.times, angles, spins, solid.positions


INERTIA = (SIZE[0] ** 2 + SIZE[1] ** 2) / 12.0 + ARM**2
"""About the hinge, of a mass of 1."""


@pytest.mark.parametrize(
    ("angle", "time_step", "dimension", "hinge"),
    [
        (0.1, 0.001, 2, {}),
        (2.5, 0.001, 2, {}),
        (2.5, 0.004, 2, {}),
        (1.0, 0.002, 3, {}),
        (1.0, 0.002, 3, {"axis": [0.0, 0.0, -2.0]}),
    ],
)
def test_a_pendulum_has_its_period_and_keeps_its_energy(angle, time_step, dimension, hinge):
    """Also where it swings far. Its energy swings with the step, and does not drift."""
    scene, pin = pendulum(angle, time_step, dimension, **hinge)
    times, angles, spins, positions = swing(scene, int(4.5 / time_step))
    wanted = 4.0 * np.sqrt(INERTIA / (9.81 * ARM)) * ellipk(np.sin(0.5 * angle) ** 2)
    through = passing(times, angles)
    assert np.diff(through) == pytest.approx(wanted, rel=1e-4)
    fastest = np.interp(through, times, spins)
    np.testing.assert_allclose(fastest, np.sqrt(2.0 * 9.81 * ARM * (1.0 - np.cos(angle)) / INERTIA), rtol=3e-3)
    np.testing.assert_allclose(fastest, fastest[0], rtol=3e-5)
    ends = positions[:, :2] + ARM * np.stack([-np.sin(angles), np.cos(angles)], axis=1)
    assert np.abs(ends - pin[:2]).max() < 1e-12


def test_a_hinge_with_a_leaning_axis_holds_a_rod_to_its_plane():
    """It falls as if along a slope, with the part of gravity across the axis."""
    lean = 0.5
    axis = np.array([0.0, np.sin(lean), np.cos(lean)])
    scene, pin = pendulum(0.3, 0.002, 3, axis=axis.tolist())
    run = Simulation(scene, precision="float64").run(500, record_every=1)
    arms = run.solids["rod"].positions - pin
    assert np.abs(np.linalg.norm(arms, axis=1) - ARM).max() < 1e-12
    assert np.abs((arms - arms[0]) @ axis).max() < 1e-12
    turns = run.solids["rod"].angular_velocities
    assert np.abs(np.cross(turns, axis)).max() < 1e-12 and np.abs(turns).max() > 1.0


WRONG = {
    "no solid": ({"solid": "boat"}, {}, r"hinge\[0\]\.solid is 'boat', but must be the name of a free body"),
    "a path": ({}, {"motion": "path", "velocity": [0.0, 0.1], "density": None}, "of a solid whose motion is"),
    "an axis": ({"axis": [0.0, 0.0, 1.0]}, {}, r"hinge\[0\]\.axis is .* left out in 2-D"),
    "a place in space": ({"position": [0.2, 0.5, 0.0]}, {}, r"hinge\[0\]\.position"),
    "freedoms": ({}, {"freedom": ["y"]}, r"solid\[0\]\.freedom is given, but must be left out, as the solid is on the"),
    "a velocity": ({}, {"velocity": [0.0, 1.0]}, r"solid\[0\]\.velocity is given, but must be left out"),
}


@pytest.mark.parametrize("name", WRONG)
def test_hinges_that_hold_nothing_are_a_sentence(name):
    hinge, body, sentence = WRONG[name]
    table = {**RAFT, "velocity": None, "angular_velocity": None, **body}
    table = {key: value for key, value in table.items() if value is not None}
    with pytest.raises(SceneError, match=sentence):
        plane(table, hinge=[{"name": "pin", "solid": "raft", "position": [0.22, 0.5], **hinge}])


def test_a_body_has_one_hinge_and_turns_about_its_axis():
    body = {key: value for key, value in BRICK.items() if key not in ("velocity", "angular_velocity")}
    hinge = {"name": "pin", "solid": "raft", "position": [0.12, 0.36, 0.1], "axis": [0.0, 0.0, 1.0]}
    with pytest.raises(SceneError, match="this one is on a hinge already"):
        space(body, hinge=[hinge, {**hinge, "name": "other"}])
    with pytest.raises(SceneError, match="along the axis of the hinge"):
        space({**body, "angular_velocity": [0.0, 1.0, 1.0]}, hinge=[hinge])
