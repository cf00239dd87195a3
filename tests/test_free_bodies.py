"""Rigid bodies that fluid moves: momenta, floating, contact, states, and what is refused. `test_features.py` has
derivatives, batches and runs that go on."""

import numpy as np
import pytest
from pydantic import TypeAdapter

from cortado import InputError, Problem, Scene, SceneError, Simulation
from cortado.discretise.solid import Mass
from cortado.losses import SolidPose
from cortado.runs.frames import posed
from cortado.scene.solid_shapes import AnySolid
from cortado.solvers.contacts import STIFFNESS
from floating_bodies import disc_in_a_round_tank, floating_box
from reference_projection import Projection
from scenes import box, pool, thrown

RAFT = box([0.2, 0.32], [0.45, 0.48], name="raft", motion="free", density=500.0, rotation=0.2, velocity=[0.1, -0.3])
RAFT |= {"angular_velocity": 2.0}
BRICK = {**RAFT, **box([0.1, 0.22, 0.1], [0.3, 0.36, 0.25], rotation=[0.2, 0.1, -0.3], velocity=[0.1, -0.3, 0.1])}
BRICK |= {"angular_velocity": [1.0, 2.0, -3.0]}
BALL = {"name": "ball", "shape": "sphere", "motion": "free", "radius": 0.08, "density": 300.0}
FAR_AWAY = box([0.0, 0.0], [0.2, 0.1], phase="water")
AROUND = box([0.0, 0.0], [1.0, 1.0], periodic=[True, False])


def plane(*solids, **tables):
    return pool([0.6, 0.4], [1.0, 1.0], viscosity=1.0, solid=list(solids), **tables)


def space(*solids, **tables):
    fluid, container = box([0.0, 0.0, 0.0], [0.4, 0.3, 0.4], phase="water"), box([0.0, 0.0, 0.0], [0.5, 0.6, 0.4])
    return plane(*solids, **{"dimension": 3, "fluid": [fluid], "container": container, **tables})


def touching():
    """Two bodies on the floor that touch each other, and an arm that comes down on one."""
    rubs = {"friction": 0.3, "restitution": 0.4}
    raft = {**RAFT, **box([0.2, -0.002], [0.45, 0.18], rotation=0.01, angular_velocity=0.5, **rubs)}
    arm = box([0.3, 0.175], [0.36, 0.3], name="arm", motion="path", velocity=[0.0, -0.2])
    return plane(raft, {**BALL, "centre": [0.52, 0.14], "velocity": [-0.3, 0.1], "friction": 0.2}, arm)


def touching_across():
    raft, ball, arm = (one.model_dump(exclude_none=True) for one in touching().solid)
    raft |= {"lower": [0.7, -0.002], "upper": [0.95, 0.18]}
    ball["centre"], arm["lower"], arm["upper"] = [0.02, 0.14], [0.8, 0.175], [0.86, 0.3]
    return plane(raft, ball, arm, container=AROUND)


def rough(scene, **changes):
    """Of a scene, one with syrup that rubs its free bodies."""
    own = scene.model_dump(exclude_none=True)
    own["phase"] = [{**own["phase"][0], "viscosity": 30.0, **changes}]
    for solid in own["solid"]:
        solid["slip"] = "no"
    return Scene.model_validate(own)


SHEAR_THINNING = {"rheology": {"kind": "power_law", "flow_index": 0.5, "least_shear_rate": 0.1}}


def touching_in_space():
    raft = {**BRICK, **box([0.2, -0.002, 0.1], [0.4, 0.14, 0.3], rotation=[0.01, 0.02, 0.01], friction=0.3)}
    return space(raft, {**BALL, "centre": [0.3, 0.22, 0.2], "radius": 0.085, "velocity": [0.0, -0.4, 0.1]})


def rod(radius, length):
    volume = np.pi * radius**2 * length
    return volume, 0.5 * volume * radius**2, volume * (radius**2 / 4.0 + length**2 / 12.0)


def capsule(radius, length):
    volume, along, across = rod(radius, length)
    ends = 4.0 / 3.0 * np.pi * radius**3
    away = ends * (0.4 * radius**2 + 0.25 * length**2 + 0.375 * radius * length)
    return volume + ends, along + 0.4 * ends * radius**2, across + away


def cup(radius, height, thickness):
    """That stands along y: a cylinder less another one."""
    outer, inner = rod(radius + thickness, height), rod(radius, height - thickness)
    parts = (1.0, outer, 0.5 * height), (-1.0, inner, 0.5 * (height + thickness))
    volume = sum(sign * own[0] for sign, own, _ in parts)
    middle = sum(sign * own[0] * y for sign, own, y in parts) / volume
    across = sum(sign * (own[2] + own[0] * (y - middle) ** 2) for sign, own, y in parts)
    return volume, sum(sign * own[1] for sign, own, _ in parts), across


def plank(x, y, z):
    return x * y * z, *(x * y * z / 12.0 * np.array([y**2 + z**2, x**2 + z**2]))


ALONG_X = {"axis": "x", "base": [-2.0, 0.1, 0.2], "height": 4.0}
SLENDER = {
    "plank": (box([0.0, 0.0, 0.0], [4.0, 0.1, 1.0]), plank(4.0, 0.1, 1.0)),
    "far": (box([1e5, 0.0, 0.0], [1e5 + 4.0, 0.125, 1.0]), plank(4.0, 0.125, 1.0)),
    "cylinder": ({"shape": "cylinder", "radius": 0.03, **ALONG_X}, rod(0.03, 4.0)),
    "capsule": ({"shape": "capsule", "start": [0, 0, 0], "end": [3.0, 0, 0], "radius": 0.05}, capsule(0.05, 3.0)),
    "ball": ({"shape": "sphere", "centre": [1.0, 2.0, 3.0], "radius": 0.2}, capsule(0.2, 0.0)),
    "cup": ({"shape": "cup", **ALONG_X, "radius": 0.1, "height": 2.0, "thickness": 0.01}, cup(0.1, 2.0, 0.01)),
}


def mass_of(table):
    return Mass.of(TypeAdapter(AnySolid).validate_python({"name": "one", **table}).own_solid())


@pytest.mark.parametrize("name", SLENDER)
def test_a_mass_has_the_volume_and_the_inertia_of_its_shape(name):
    """About the axis along x and across it; bodies are as slender as they like."""
    table, (volume, along, across) = SLENDER[name]
    mass = mass_of(table)
    assert mass.volume == pytest.approx(volume, rel=1e-10)
    np.testing.assert_allclose(np.diag(mass.inertia)[:2], [along, across], rtol=1e-10)
    np.testing.assert_allclose(mass.inertia, np.diag(np.diag(mass.inertia)), atol=1e-12 * along)


DISC, ROD = 0.05**2 * np.pi, 3.0 * 0.1
ENDS = DISC * (0.05**2 / 2.0 + 1.5**2) + 4.0 * 1.5 * 2.0 / 3.0 * 0.05**3
L_CORNERS = [[5, 5], [5, 7], [5.5, 7], [5.5, 5.5], [7, 5.5], [7, 5]]
OF_CUP = 0.3 * (0.36 + 0.25) / 12.0 + 0.3 * 0.25**2 - 0.16 * (0.16 + 0.16) / 12.0 - 0.16 * 0.3**2 - 0.027**2 / 0.14
STADIUM = {"shape": "capsule", "start": [0, 0], "end": [1.8, 2.4], "radius": 0.05}
FLAT = {
    "box": (box([0, 0], [4.0, 0.1]), 0.4, 0.4 * (16.0 + 0.01) / 12.0),
    "disc": ({"shape": "sphere", "centre": [9.0, 1.0], "radius": 0.05}, DISC, 0.5 * DISC * 0.05**2),
    "stadium": (STADIUM, ROD + DISC, ROD * (9.0 + 0.01) / 12.0 + ENDS),
    "cup": ({"shape": "cup", "base": [0, 0], "radius": 0.2, "height": 0.5, "thickness": 0.1}, 0.14, OF_CUP),
    "angle": ({"shape": "polygon", "corners": L_CORNERS}, 1.75, 8.5 / 3.0 - 0.125 / 3.0 - 2.0 * 1.1875**2 / 1.75),
}


@pytest.mark.parametrize("name", FLAT)
def test_a_mass_in_the_plane_has_the_area_and_the_inertia_of_its_shape(name):
    table, area, inertia = FLAT[name]
    mass = mass_of(table)
    assert mass.volume == pytest.approx(area, rel=1e-10)
    np.testing.assert_allclose(mass.inertia, np.diag([0.0, 0.0, inertia]), rtol=1e-10)


def hit(d, x, density, steps, slip="free", **tables):
    """Fluid hits a body from ``x`` on in free space: the run, in which all of their momentum is kept."""
    s, solver = 0.05 if d == 2 else 0.08, {"kind": "projection", "time_step": 0.002}
    fluid = box([-0.5] + [-0.25] * (d - 1), [-0.1] + [0.25] * (d - 1), phase="water", velocity=[1.0, 0.2, 0.0][:d])
    body = box([x, -0.4, -0.3][:d], [0.3, 0.1, 0.1][:d], name="raft", motion="free", density=density, slip=slip)
    tables |= {"container": {"shape": "none"}, "forces": {"gravity": [0.0] * d}, "discretisation": {"spacing": s}}
    scene = plane(body, dimension=d, fluid=[fluid], solver=solver, **tables)
    run = Simulation(scene, precision="float64").run(steps, record_every=20)
    mass = density * Mass.of(scene.solid[0].own_solid()).volume
    momentum = 1000.0 * s**d * run.velocities.sum(axis=1) + mass * run.solids["raft"].velocities
    assert np.abs(momentum - momentum[0]).max() < 1e-12 * np.abs(momentum[0]).max()
    return run


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_body_and_fluid_in_free_space_keep_their_momentum(dimension):
    """Without the body's share of the pressures it would keep its velocity."""
    assert hit(dimension, 0.0, 400.0, 100).solids["raft"].velocities[-1][0] > 0.3


def test_a_body_in_nothing_falls_and_turns_as_bodies_do():
    """Far from water: free fall, and a turn that keeps the angular momentum, here about an axis between its own."""
    scene = space({**BRICK, "lower": [0.1, 0.45, 0.1], "upper": [0.2, 0.5, 0.25]}, container={"shape": "none"})
    run = Simulation(scene, precision="float64").run(100, record_every=20)
    solid, t = run.solids["raft"], 0.001 * np.arange(0, 101, 20)
    assert np.allclose(solid.velocities[:, 1], -0.3 - 9.81 * t, rtol=1e-12)
    inertia = Mass.of(scene.solid[0].own_solid()).inertia
    from scipy.spatial.transform import Rotation

    R = Rotation.from_rotvec(solid.rotations).as_matrix()
    L = np.einsum("fij,jk,flk,fl->fi", R, inertia, R, solid.angular_velocities)
    assert np.abs(L - L[0]).max() < 1e-12 * np.abs(L[0]).max()
    assert np.abs(solid.angular_velocities - solid.angular_velocities[0]).max() > 0.1


def test_a_box_floats_as_deep_as_it_should():
    assert floating_box(16)["draft over the exact one"] == pytest.approx(1.0, rel=0.03)


@pytest.mark.parametrize("density", [50.0, 200.0, 3000.0])
def test_a_disc_gets_faster_as_its_added_mass_says(density, tmp_path):
    """From the second step on. The tank is full, so that its walls must let tension through, and a light disc is thrown
    about by a coarse grid that does not know its mass."""
    faster = disc_in_a_round_tank(density, str(tmp_path / "rings.npy"), 0.03, 6)
    assert np.abs(faster[1:] - 1.0).max() < 0.1


def test_a_body_lies_on_the_floor():
    """Held by its contact alone, as deep as one point would be."""
    raft = box([0.7, 0.0], [0.9, 0.1], name="raft", motion="free", density=500.0)
    solid = Simulation(plane(raft, fluid=[FAR_AWAY]), precision="float64").run(200, record_every=1).solids["raft"]
    assert 0.05 - solid.positions[-1, 1] == pytest.approx(9.81 * 0.001**2 / STIFFNESS, rel=0.01)
    assert np.abs(solid.velocities[-20:]).max() < 1e-4


@pytest.mark.parametrize(("part", "time_step"), [(0.3, 0.001), (None, 0.0005), (0.95, 0.001), (0.95, 0.0005)])
def test_a_body_leaves_the_floor_with_its_part_of_the_speed(part, time_step):
    ball = {**BALL, "centre": [0.8, 0.1], "velocity": [0.0, -1.0], "restitution": part}
    scene = plane(ball, fluid=[FAR_AWAY], forces={"gravity": [0.0, 0.0]}, solver=SOLVER | {"time_step": time_step})
    run = Simulation(scene, precision="float64").run(int(0.06 / time_step), record_every=1)
    assert run.solids["ball"].velocities[-1, 1] == pytest.approx(0.6 if part is None else part, abs=0.05)


SOLVER = {"kind": "projection", "time_step": 0.001}


def on_a_slope(lean, friction, shape, steps=200, flat=True):
    """How fast a body goes and turns in each step that begins at rest on a slope that is so steep [rad], in nothing."""
    d, gravity = 2 if flat else 3, 9.81 * np.array([np.sin(lean), -np.cos(lean), 0.0])
    at = {"centre": [0.1, 0.08, 0.2][:d]} if shape == "sphere" else box([0.1, 0.0, 0.1][:d], [0.2, 0.1, 0.2][:d])
    body = {"name": "body", "motion": "free", "density": 500.0, **at, "friction": friction}
    body |= {"shape": "sphere", "radius": 0.08} if shape == "sphere" else {}
    far = [box([0.8, 0.0, 0.0][:d], [0.9, 0.1, 0.4][:d], phase="water")]
    room = box([0.0, 0.0, 0.0][:d], [0.9, 0.4, 0.4][:d])
    scene = (plane if flat else space)(body, fluid=far, container=room, forces={"gravity": gravity[:d]}, solver=SOLVER)
    run = Simulation(scene, precision="float64").run(steps, record_every=1).solids["body"]
    return run.velocities[:, 0] / (9.81 * np.sin(lean)), run.angular_velocities


@pytest.mark.parametrize(("flat", "steep", "near"), [(True, 0.5, 0.015), (True, 1.5, 0.01), (False, 0.5, 0.03)])
def test_a_ball_rolls_down_a_slope_and_slides_down_a_steeper_one(flat, steep, near):
    """It slides where tan a is above 3 mu in the plane, and above 3.5 mu in space."""
    most = 3.0 if flat else 3.5
    lean = np.arctan(steep * most * 0.1)
    speed, turned = on_a_slope(lean, 0.1, "sphere", flat=flat)
    wanted = 1.0 - 1.0 / (most * max(steep, 1.0))
    assert np.polyfit(1e-3 * np.arange(100), speed[101:], 1)[0] == pytest.approx(wanted, rel=near)
    rolls = np.abs(turned[-1]).max() * 0.08 / (9.81 * np.sin(lean) * speed[-1])
    assert rolls > 0.99 if steep < 1.0 else rolls < 0.6


def test_a_box_lies_on_a_slope_or_slides_as_friction_says():
    still, sliding = (on_a_slope(0.3, friction, "box", 120)[0] for friction in (0.5, 0.2))
    assert np.abs(still[-50:].mean()) * 9.81 * np.sin(0.3) < 1e-4
    assert np.polyfit(1e-3 * np.arange(60), sliding[61:], 1)[0] == pytest.approx(1.0 - 0.2 / np.tan(0.3), rel=0.01)


def test_a_belt_takes_a_box_along_by_friction():
    """With mu g until the box goes as fast as the surface of the belt."""
    belt = box([-0.1, 0.3], [1.1, 0.5], name="belt", surface_velocity=[0.5, 0.0])
    body = box([0.1, 0.5], [0.2, 0.6], name="body", motion="free", density=500.0, friction=0.3)
    scene = plane(belt, body, fluid=[FAR_AWAY], solver=SOLVER)
    speeds = Simulation(scene, precision="float64").run(300, record_every=1).solids["body"].velocities[:, 0]
    assert np.polyfit(1e-3 * np.arange(80), speeds[20:100], 1)[0] == pytest.approx(0.3 * 9.81, rel=0.02)
    assert speeds[-50:] == pytest.approx(0.5, rel=1e-3)


def test_bodies_touch_across_a_period():
    """One that has left the box where it began meets images: of a body, of a pillar, and of the floor."""
    raft = box([0.8, 0.5], [0.9, 0.6], name="raft", motion="free", density=500.0, velocity=[2.0, 0.0])
    other = box([0.05, 0.5], [0.15, 0.6], name="other", motion="free", density=500.0)
    pillar = box([0.3, 0.3], [0.4, 0.9], name="pillar")
    scene = plane(raft, other, pillar, fluid=[FAR_AWAY], container=AROUND)
    run = Simulation(scene, precision="float64").run(450, record_every=10)
    solid, hit = run.solids["raft"], run.solids["other"]
    velocity = solid.velocities + hit.velocities
    assert np.allclose(velocity[10], [2.0, -2 * 9.81 * 0.1], rtol=1e-9) and hit.velocities[10, 0] > 1.0
    assert hit.velocities[:, 0].min() < -0.1 and solid.positions[:, 0].max() > 0.95
    fastest = np.abs([solid.velocities[:, 1], hit.velocities[:, 1]]).max()
    assert all(body.positions[:, 1].min() > 0.05 - fastest * 0.001 / STIFFNESS**0.5 for body in (solid, hit))


@pytest.mark.parametrize("made", [touching, touching_in_space])
def test_bodies_are_drawn_where_they_are(made):
    """Where contact has pushed and turned the raft, which no table of the scene says."""
    scene = made()
    run = Simulation(scene).run(10, record_every=5)
    drawn, solid = posed(scene, run.solids, 2).solid[0], run.solids["raft"]
    points = np.random.default_rng(4).uniform(0.0, 0.5, (50, scene.dimension))
    turned = np.array([drawn.turn(scene.dimension).T @ (x - solid.positions[2]) for x in points])
    assert np.allclose(drawn.solid().distance(points), drawn.own_solid().distance(turned), atol=1e-6)
    R = drawn.turn(scene.dimension)
    axes = np.array([run.last_state[f"raft.turn_{axis}"][0] for axis in "xyz"[: scene.dimension]]).T
    assert np.allclose(R, (np.eye(scene.dimension) + axes) @ scene.solid[0].turn(scene.dimension), atol=1e-5)
    assert np.abs(axes).max() > 1e-3


@pytest.mark.parametrize(
    ("changes", "tables", "sentence"),
    [
        ({"density": None}, {}, r"solid\[0\]\.density is missing, but must be a density"),
        ({"motion": "fixed"}, {}, r"solid\[0\]\.density is 500"),
        ({"side": "inside"}, {}, r"solid\[0\]\.side"),
        ({"times": [0.0, 1.0]}, {}, r"solid\[0\]\.times"),
        ({"lower": [-0.1, 0.3]}, {}, r"solid\[0\] is .* m deep in the container at"),
        ({}, {"solver": {"kind": "pcisph", "time_step": 0.001}}, "solver.kind is 'pcisph', but must be \"projection\""),
        ({}, {"forces": {"pressure": False}}, r"forces\.pressure"),
    ],
)
def test_what_a_body_cannot_be_is_a_sentence(changes, tables, sentence):
    with pytest.raises(SceneError, match=sentence):
        plane({name: value for name, value in {**RAFT, **changes}.items() if value is not None}, **tables)
    with pytest.raises(SceneError, match=r"solid\[0\] is .* m deep in the solid 'other' at"):
        plane(RAFT, {**RAFT, "name": "other", "rotation": 0.3})


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"name": "raft"}, "position and rotation are left out"),
        ({"name": "raft", "position": [0.0, 0.0], "length": 0.0}, "length is 0.0"),
        ({"name": "boat", "position": [0.0, 0.0]}, "name is 'boat', but must be the name of a moving solid: raft"),
        ({"name": "raft", "position": [0.0, 0.0, 0.0]}, r"position has shape \(3,\), but must be \(2,\)"),
    ],
)
def test_a_bad_pose_and_one_of_another_scene_are_sentences(given, sentence):
    with pytest.raises(InputError, match=sentence):
        Problem(Simulation(plane(RAFT)), 1, SolidPose(**given)).value({})


def test_a_file_of_frames_tells_where_bodies_are(tmp_path):
    simulation = Simulation(touching())
    run = simulation.run(6, record_every=2)
    run.save(tmp_path / "run.vtkhdf")
    read = type(run).load(tmp_path / "run.vtkhdf")
    assert read.solids.keys() == run.solids.keys() == {"raft", "ball", "arm"}
    for name, motion in run.solids.items():
        assert np.array_equal(read.solids[name].positions, motion.positions)
        assert np.array_equal(read.solids[name].rotations, motion.rotations)
    assert np.array_equal(read.solids["raft"].velocities, run.solids["raft"].velocities)
    with pytest.raises(
        InputError, match=r"parameter raft\.velocity is given, but must be left out, as the given state"
    ):
        simulation.run(1, controls={"raft.velocity": np.zeros(2)}, state=read.last_state)


@pytest.mark.parametrize(
    ("made", "freedom", "hinge"),
    [
        (plane, None, {}),
        (space, None, {}),
        (plane, ["y"], {}),
        (plane, ["x", "rotation"], {}),
        (space, ["x", "rotation_x", "rotation_z"], {}),
        (space, ["y", "z", "rotation_y"], {}),
        (plane, None, {"position": [0.2, 0.6]}),
        (space, None, {"position": [0.1, 0.4, 0.2]}),
        (space, None, {"position": [0.1, 0.4, 0.2], "axis": [0.2, 0.5, 1.0]}),
    ],
)
def test_a_step_beside_bodies_is_that_of_the_twin(made, freedom, hinge):
    """Two light bodies at rest in water that is thrown about, of which one is held, is on a hinge, or is not. A hinge
    turns the velocity in the step itself."""
    flat, still = made is plane, {"velocity": [0.0] * (2 if made is plane else 3), "angular_velocity": None}
    raft = {**(RAFT if flat else BRICK), **still, "density": 100.0, "freedom": freedom}
    raft |= {"velocity": None} if hinge else {}
    hinges = [{"name": "pin", "solid": "raft", **hinge}] if hinge else []
    ball = {**BALL, "centre": [0.3, 0.12] if flat else [0.32, 0.1, 0.3]}
    scene = made(*({key: v for key, v in one.items() if v is not None} for one in (raft, ball)), hinge=hinges)
    scene = scene.replaced("phase[0].viscosity=0")
    simulation = Simulation(scene, precision="float64")
    given, gravity, dt = thrown(simulation), np.array(scene.forces.gravity), 0.001
    x, v = given["initial_positions"], given["initial_velocities"]
    run, m = simulation.run(1, given), simulation.state()["reference_density"]
    twin = Projection.of(simulation)
    x_new, v_new, (k, _), _ = twin.step(x, v + dt * gravity, (np.zeros(len(m)), np.zeros_like(x)), m, dt, gravity)
    np.testing.assert_allclose(run.positions[-1], x_new, rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(run.velocities[-1], v_new, rtol=1e-10, atol=1e-11)
    assert len(twin.bodies) == 2
    for body, row, name in zip(twin.bodies, twin.body_rows(x), ("raft", "ball"), strict=True):
        moved, d = body.mobility @ row @ k, scene.dimension
        velocity = (moved + body.falling(gravity, d, dt))[:d]
        turned = {"rtol": 5e-3, "atol": 1e-4} if hinge and name == "raft" else {"rtol": 1e-9, "atol": 1e-11}
        np.testing.assert_allclose(run.solids[name].velocities[-1], velocity, **turned)
        assert np.abs(moved[:d]).max() > dt * 9.81
