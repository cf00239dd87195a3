"""Free bodies on hinges: pendulums, and what is refused."""

import numpy as np
import pytest
from scipy.linalg import eigh
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
    run = Simulation(scene, precision="float64").run(steps, record_every=1)
    solid, d = run.solids["rod"], scene.dimension
    angles, spins = (a if d == 2 else a[:, 2] for a in (solid.rotations, solid.angular_velocities))
    return run.times, angles, spins, solid.positions


MOTOR = {"stiffness": 20.0, "damping": 1.0, "rest_angle": 0.2, "times": [0.0, 0.01], "torques": [1.0, 4.0]}
MOTOR |= {"speeds": [0.0, 3.0]}
"""What turns both sides of a hinge."""


def chained(scene_of, table):
    """A body on a hinge to another one, which in the plane is on a hinge to an arm, and in space moves in some ways."""
    float_ = {"name": "float", "motion": "free", "density": 300.0}
    if scene_of is space:
        float_ |= {**box([0.34, 0.24, 0.12], [0.44, 0.36, 0.25]), "freedom": ["x", "y", "rotation_y", "rotation_z"]}
        knee = {"position": [0.32, 0.3, 0.18], "axis": [0.2, 0.1, 1.0], **MOTOR}
        return space(table, float_, hinge=[{"name": "knee", "solid": "raft", "to": "float", **knee}])
    float_ |= {**box([0.5, 0.34], [0.6, 0.46]), "velocity": [0.2, 0.1]}
    arm = box([0.65, 0.36], [0.75, 0.7], name="arm", motion="path", velocity=[0.3, 0.2], angular_velocity=2.0)
    knee = {"name": "knee", "solid": "raft", "to": "float", "position": [0.475, 0.41], **MOTOR}
    wrist = {"name": "wrist", "solid": "float", "to": "arm", "position": [0.62, 0.4], "damping": 2.0}
    return plane(table, float_, arm, hinge=[knee, wrist])


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


LINK = SIZE[1] + 0.02
"""From hinge to hinge of a double pendulum [m]."""


def double(angles, time_step=0.002, **tables):
    """Two rods that hang from each other in nothing, at these angles, and where the hinges are."""
    arms = [LINK * np.array([np.sin(angle), -np.cos(angle)]) for angle in angles]
    pin = np.array([0.5, 3.0])
    middles, rods = (pin + 0.5 * arms[0], pin + arms[0] + 0.5 * arms[1]), []
    for name, angle, middle in zip(("one", "two"), angles, middles, strict=True):
        sides = (middle - 0.5 * SIZE[:2]).tolist(), (middle + 0.5 * SIZE[:2]).tolist()
        rods.append({**box(*sides, name=name, motion="free", density=700.0), "rotation": angle})
    hinges = [{"name": "pin", "solid": "one", "position": pin.tolist()}]
    hinges += [{"name": "knee", "solid": "two", "to": "one", "position": (pin + arms[0]).tolist()}]
    solver = {"kind": "projection", "time_step": time_step}
    return plane(*rods, hinge=hinges, container={"shape": "none"}, solver=solver, **tables)


@pytest.mark.parametrize("mode", [0, 1])
def test_a_double_pendulum_swings_in_its_modes(mode):
    """With M q'' + K q = 0 of small angles q from the vertical, for a mass of 1."""
    arm, inertia = 0.5 * LINK, (SIZE[0] ** 2 + SIZE[1] ** 2) / 12.0
    mixed = LINK * arm
    masses = np.array([[inertia + arm**2 + LINK**2, mixed], [mixed, inertia + arm**2]])
    squares, ways = eigh(9.81 * np.diag([arm + LINK, arm]), masses)
    period, angles = 2.0 * np.pi / np.sqrt(squares[mode]), 0.004 * ways[:, mode] / np.abs(ways[:, mode]).max()
    run = Simulation(double(angles), precision="float64").run(int(1.9 * period / 0.002), record_every=1)
    one, two = run.solids["one"], run.solids["two"]
    assert np.diff(passing(run.times, one.rotations)) == pytest.approx(period, rel=1e-3)
    np.testing.assert_allclose(two.rotations, angles[1] / angles[0] * one.rotations, atol=0.02 * np.abs(angles).max())
    ends = [
        body.positions + side * arm * np.stack([np.sin(body.rotations), -np.cos(body.rotations)], axis=1)
        for body, side in ((one, 1.0), (two, -1.0))
    ]
    assert np.abs(ends[0] - ends[1]).max() < 1e-12


@pytest.mark.parametrize("scene_of", [plane, space])
def test_bodies_on_a_hinge_to_each_other_keep_their_momenta(scene_of):
    """In nothing, where a motor turns them against each other. What the hinge takes of the first motion is kept too."""
    d = 2 if scene_of is plane else 3
    middles = np.array([[0.5, 3.0, 0.2], [0.8, 3.1, 0.25]])[:, :d]
    bodies = [
        box((middle - 0.1).tolist(), (middle + 0.1).tolist(), name=name, motion="free", density=density)
        for name, middle, density in zip(("one", "two"), middles, (700.0, 200.0), strict=True)
    ]
    bodies[0]["velocity"] = [0.3, 0.1, -0.2][:d]
    bodies[1]["angular_velocity"] = 2.0 if d == 2 else [1.0, -2.0, 2.0]
    knee = {"name": "knee", "solid": "one", "to": "two", "position": [0.65, 3.02, 0.2][:d], "torque": 5.0 * 0.2**d}
    knee |= {} if d == 2 else {"axis": [0.3, 0.1, 1.0]}
    tables = {"container": {"shape": "none"}, "forces": {"gravity": [0.0] * d}}
    run = Simulation(scene_of(*bodies, hinge=[knee], **tables), precision="float64").run(150, record_every=1)
    one, two = (run.solids[name] for name in ("one", "two"))
    momentum = 700.0 * one.velocities + 200.0 * two.velocities
    assert np.abs(momentum - momentum[0]).max() < 1e-12 * np.abs(momentum[0]).max()
    turns = [
        density
        * (
            np.cross(body.positions, body.velocities)
            + 0.2**2 / 6.0 * body.angular_velocities  # of a square, and of a cube about any axis
        )
        for density, body in ((700.0, one), (200.0, two))
    ]
    angular = sum(turns)
    assert np.abs(angular - angular[1]).max() < 1e-9 * np.abs(angular[1]).max()
    assert np.abs(np.diff(one.angular_velocities, axis=0)).max() > 1e-3


WRONG = {
    "nobody": ({"to": "boat"}, {}, r"hinge\[0\]\.to is 'boat', but must be left out, for the world"),
    "a speed alone": (
        {"speed": 1.0},
        {},
        r"hinge\[0\]\.speed is given, but must be left out, as the hinge has no damping",
    ),
    "no solid": ({"solid": "boat"}, {}, r"hinge\[0\]\.solid is 'boat', but must be the name of a free body"),
    "a path": ({}, {"motion": "path", "velocity": [0.0, 0.1], "density": None}, "of a solid whose motion is"),
    "an axis": ({"axis": [0.0, 0.0, 1.0]}, {}, r"hinge\[0\]\.axis is .* left out in 2-D"),
    "freedoms": ({}, {"freedom": ["y"]}, r"solid\[0\]\.freedom is given, but must be left out, as the solid is on the"),
    "a velocity": ({}, {"velocity": [0.0, 1.0]}, r"solid\[0\]\.velocity is given, but must be left out"),
}


def test_hinges_that_hold_nothing_are_a_sentence():
    for name in WRONG:
        hinge, body, sentence = WRONG[name]
        table = {**RAFT, "velocity": None, "angular_velocity": None, **body}
        table = {key: value for key, value in table.items() if value is not None}
        with pytest.raises(SceneError, match=sentence):
            plane(table, hinge=[{"name": "pin", "solid": "raft", "position": [0.22, 0.5], **hinge}])


def test_rings_of_hinges_and_rubbed_bodies_on_them_are_a_sentence():
    others = [{"name": name, "shape": "sphere", "motion": "free", "density": 500.0, "radius": 0.08} for name in "ab"]
    others[0]["centre"], others[1]["centre"] = [0.6, 0.6], [0.8, 0.6]
    ring = [("raft", "a"), ("a", "b"), ("b", "raft")]
    hinges = [
        {"name": f"{one}{two}", "solid": one, "to": two, "position": [0.5, 0.6]} for one, two in [*ring, ("raft", "a")]
    ]
    for some in (hinges[:3], [hinges[0], hinges[3]]):
        with pytest.raises(SceneError, match=r"but must be a solid that other hinges do not join to this one already"):
            plane(RAFT, *others, hinge=[{**one, "name": str(k)} for k, one in enumerate(some)])
    with pytest.raises(
        SceneError, match=r"solid\[1\]\.slip is 'no', but must be \"free\", as the body is on the hinge"
    ):
        plane(RAFT, {**others[0], "slip": "no"}, hinge=hinges[:1])


def test_a_body_has_one_hinge_and_turns_about_its_axis():
    body = {key: value for key, value in BRICK.items() if key not in ("velocity", "angular_velocity")}
    hinge = {"name": "pin", "solid": "raft", "position": [0.12, 0.36, 0.1], "axis": [0.0, 0.0, 1.0]}
    with pytest.raises(SceneError, match="this one is on a hinge already"):
        space(body, hinge=[hinge, {**hinge, "name": "other"}])
    with pytest.raises(SceneError, match="along the axis of the hinge"):
        space({**body, "angular_velocity": [0.0, 1.0, 1.0]}, hinge=[hinge])
