"""Springs and dampers between bodies, solids and the world, what turns bodies about hinges, and their sensor."""

from functools import partial

import numpy as np
import pytest

from cortado import InputError, Problem, SceneError, Simulation
from cortado.losses import Series, SolidPose
from cortado.scene.stability import stability_limits
from cortado.sensors import SpringForce
from finite_differences import both_modes, decades, distance
from floating_bodies import passing
from scenes import box, thrown
from test_free_bodies import BRICK, RAFT, plane, space

RATE = np.sqrt(30.0)
"""Frequency of a block on its spring [rad/s]."""
SIDE, DENSITY = 0.2, 700.0
ALONE = {"container": {"shape": "none"}}


def block(d, name="block", place=(0.5, 3.0, 0.2), **keys):
    middle = np.array(place)[:d]
    sides = (middle - 0.5 * SIDE).tolist(), (middle + 0.5 * SIDE).tolist()
    return box(*sides, name=name, motion="free", density=DENSITY, **keys)


def hung(d=2, time_step=0.002, weight=9.81, **keys):
    """A block that hangs from a spring in nothing, one metre above it."""
    mass = DENSITY * SIDE**d
    spring = {"name": "line", "solid": "block", "point": [0.5, 3.0, 0.2][:d], "anchor": [0.5, 4.0, 0.2][:d]}
    spring |= {"stiffness": mass * RATE**2, **keys}
    solver = {"kind": "projection", "time_step": time_step}
    forces = {"gravity": [0.0, -weight, 0.0][:d]}
    body = block(d, velocity=[0.0, 1e-3 * (weight == 0.0), 0.0][:d])
    return (plane if d == 2 else space)(body, spring=[spring], solver=solver, forces=forces, **ALONE)


def bobbing(scene, steps=2000):
    run = Simulation(scene, precision="float64").run(steps, record_every=1, sensors={"line": SpringForce("line")})
    return run, run.solids["block"].positions[:, 1] - (3.0 - 9.81 / RATE**2)


@pytest.mark.parametrize(("d", "time_step"), [(2, 0.002), (2, 0.01), (3, 0.004)])
def test_a_block_on_a_spring_has_its_period_and_keeps_its_energy(d, time_step):
    run, heights = bobbing(hung(d, time_step), int(4.0 / time_step))
    through = passing(run.times, heights)
    step = RATE * time_step
    assert np.diff(through) == pytest.approx(2.0 * np.pi * time_step / np.arccos(1.0 - 0.5 * step**2), rel=1e-5)
    assert np.diff(through) == pytest.approx(2.0 * np.pi / RATE, rel=0.1 * step**2)
    speeds = run.solids["block"].velocities[:, 1]
    energy = 0.5 * speeds**2 + 0.5 * RATE**2 * heights**2 - 0.5 * RATE**2 * time_step * speeds * heights
    np.testing.assert_allclose(energy, energy[0], rtol=1e-9)


@pytest.mark.parametrize("rate", [0.5, 2.0])
def test_a_damped_block_comes_to_rest_at_its_rate(rate):
    run, heights = bobbing(hung(damping=rate * DENSITY * SIDE**2, time_step=0.001), 4000)
    through = passing(run.times, heights)
    assert np.diff(through) == pytest.approx(2.0 * np.pi / np.sqrt(RATE**2 - rate**2 / 4.0), rel=1e-3)
    speeds = np.interp(through, run.times, run.solids["block"].velocities[:, 1])
    found = np.log(speeds[0] / speeds[-1]) / (through[-1] - through[0])
    assert found == pytest.approx(0.5 * rate, rel=2e-3)


def test_the_force_in_a_spring_is_stiffness_times_extension():
    mass = DENSITY * SIDE**2
    run, _ = bobbing(hung(preload=2.0 * mass), 150)
    read, extension = run.sensors["line"], 3.0 - run.solids["block"].positions[:-1, 1]
    wanted = np.stack([mass * (2.0 + RATE**2 * extension), 1.0 + extension], axis=1)
    np.testing.assert_allclose(read.values[: len(wanted)], wanted, rtol=1e-12)


def test_a_slack_line_only_pulls():
    """A block that is thrown up falls freely, and its line throws it up again without a loss."""
    body = block(2, velocity=[0.0, 2.0])
    line = {"name": "line", "solid": "block", "point": [0.5, 3.0], "anchor": [0.5, 4.0], "slack": True}
    line |= {"stiffness": DENSITY * SIDE**2 * RATE**2}
    scene = plane(body, spring=[line], solver={"kind": "projection", "time_step": 0.002}, **ALONE)
    run = Simulation(scene, precision="float64").run(720, record_every=1, sensors={"line": SpringForce("line")})
    force, speeds = run.sensors["line"].values[:, 0], run.solids["block"].velocities[:, 1]
    free = run.solids["block"].positions[:, 1] > 3.0 + 1e-9
    assert force.min() == 0.0 and force.max() > 100.0 and free[1:200].all()
    np.testing.assert_allclose(np.diff(speeds)[:200], -9.81 * 0.002, rtol=1e-9)
    again = speeds[np.nonzero(np.diff(free.astype(int)) > 0)[0][1]]
    assert again == pytest.approx(2.0, rel=0.01)


def test_two_blocks_on_a_spring_keep_their_momenta():
    """And swing with the reduced mass."""
    bodies = block(2, velocity=[0.3, 0.1]), block(2, "other", (1.5, 3.0), angular_velocity=2.0)
    spring = {"name": "line", "solid": "block", "to": "other", "point": [0.55, 3.02], "anchor": [1.45, 3.07]}
    spring |= {"stiffness": 200.0, "rest_length": 0.7, "damping": 3.0}
    solver = {"kind": "projection", "time_step": 0.005}
    scene = plane(*bodies, spring=[spring], forces={"gravity": [0.0, 0.0]}, solver=solver, **ALONE)
    run = Simulation(scene, precision="float64").run(200, record_every=20)
    one, other = run.solids["block"], run.solids["other"]
    momentum = one.velocities + other.velocities
    assert np.abs(momentum - [0.3, 0.1]).max() < 1e-13 and np.abs(one.velocities - [0.3, 0.1]).max() > 0.15

    def moment(body):
        x, v = body.positions, body.velocities
        return x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0] + SIDE**2 / 6.0 * body.angular_velocities

    angular = moment(one) + moment(other)
    assert np.abs(angular - angular[0]).max() < 1e-12 * np.abs(angular[0])


def test_a_moored_raft_lies_where_its_lines_hold_it():
    """In water at rest: it rises by h from a draft of 0.18 m, as 706 N - 392 N of buoyancy and weight are more than the
    preload, until 6540 N/m h less and 2000 N/m h more are equal. The level sinks by 2 / 3 h beside it."""
    raft = box([0.3, 0.22], [0.7, 0.42], name="raft", motion="free", density=500.0, freedom=["y"])
    line = {"name": "line", "solid": "raft", "point": [0.5, 0.22], "anchor": [0.5, 0.02], "stiffness": 2000.0}
    line |= {"damping": 100.0, "preload": 196.2}
    water = box([0.0, 0.0], [1.0, 0.4], phase="water")
    solver = {"kind": "projection", "time_step": 0.001}
    scene = plane(raft, fluid=[water], spring=[line], discretisation={"spacing": 0.025}, solver=solver)
    run = Simulation(scene, precision="float64").run(1600, record_every=100, sensors={"line": SpringForce("line")})
    force, length = run.sensors["line"].values[800:].mean(axis=0)
    h = (9.81 * (72.0 - 40.0) - 196.2) / (9810.0 * 0.4 * 5.0 / 3.0 + 2000.0)
    assert force == pytest.approx(196.2 + 2000.0 * (length - 0.2), rel=0.01)
    assert force == pytest.approx(196.2 + 2000.0 * h, rel=0.05)


LINE = {"name": "line", "solid": "raft", "stiffness": 3e3, "damping": 20.0}
TAUT = {
    "with a preload": {"point": [0.25, 0.35], "anchor": [0.15, 0.1], "preload": 50.0},
    "slack": {"point": [0.25, 0.35], "anchor": [0.15, 0.1], "rest_length": 0.255, "slack": True},
    "to a ball": {"point": [0.25, 0.35], "anchor": [0.7, 0.65], "rest_length": 0.3, "to": "ball"},
    "to an arm": {"point": [0.25, 0.35], "anchor": [0.82, 0.65], "rest_length": 0.3, "to": "arm"},
}
ACROSS = {
    "with a preload": {"point": [0.12, 0.25, 0.15], "anchor": [0.1, 0.1, 0.3], "preload": 20.0},
    "to a ball": {"point": [0.12, 0.25, 0.15], "anchor": [0.4, 0.44, 0.2], "rest_length": 0.2, "to": "ball"},
}
TURNED_BY = {"stiffness": 20.0, "damping": 1.0, "rest_angle": 0.2, "times": [0.0, 0.01], "torques": [1.0, 4.0]}
"""What a hinge turns a body by, besides holding it."""


def moored(scene_of, table, spring):
    middle = [0.7, 0.7] if scene_of is plane else [0.4, 0.48, 0.2]
    others = {"ball": [{"name": "ball", "shape": "sphere", "motion": "free", "radius": 0.08, "density": 300.0}]}
    others["ball"][0]["centre"] = middle
    others["arm"] = [box([0.8, 0.6], [0.9, 0.7], name="arm", motion="path", velocity=[0.3, 0.2], angular_velocity=2.0)]
    return scene_of(table, *others.get(spring.get("to"), []), spring=[{**LINE, **spring}])


@pytest.mark.parametrize(("scene_of", "table", "springs"), [(plane, RAFT, TAUT), (space, BRICK, ACROSS)])
def test_the_force_in_a_spring_has_derivatives(scene_of, table, springs):
    scene = moored(scene_of, table, springs["with a preload"])
    body = scene.solid[0]
    loss = Series(SpringForce("line"), [0.0, 0.004], np.zeros((2, 2)), 0.001)
    point = {"line.stiffness": 3e3, "line.damping": 20.0, "line.rest_length": scene.spring[0].length_at_rest}
    point |= {"raft.position": body.middle(), "raft.velocity": body.velocity}
    point = {name: np.array(value, dtype=np.float64) for name, value in point.items()}
    sizes = {"stiffness": 300.0, "damping": 10.0, "rest_length": 0.01, "position": 0.01}
    random = np.random.default_rng(3)
    along = {n: sizes.get(n.split(".")[-1], 0.3) * random.normal(size=np.shape(v)) for n, v in point.items()}
    simulation = Simulation(scene, precision="float64")
    moved = 0.1 * thrown(simulation)["initial_velocities"]  # at rest it is on corners of the clamp
    point["initial_velocities"] = moved
    problem = Problem(simulation, 6, loss)
    gradient, tangent = both_modes(problem, point, along)
    assert all(np.abs(gradient[name]).max() > 0.0 for name in along)
    assert distance(problem.value, point, along, tangent, decades(3.0, 7.0), enough=1e-6) < 1e-6


def test_steps_beyond_the_limit_of_springs_are_told_and_go_wrong():
    """Of a spring in nothing the limit is exact, 2 / omega, and without a load on the middle it is on the safe side."""
    limit, mass = stability_limits(hung(), {})["springs"], DENSITY * SIDE**2
    assert limit == pytest.approx(2.0 / RATE, rel=1e-12)
    stiff = {"line.stiffness": np.array(4.0 * mass * RATE**2)}
    assert stability_limits(hung(), stiff)["springs"] == pytest.approx(1.0 / RATE, rel=1e-12)
    damped = stability_limits(hung(damping=40.0 * mass), {})["springs"]
    for scene, longest, steps in ((hung, limit, 60), (partial(hung, damping=40.0 * mass), damped, 400)):
        for factor, held in ((0.98, True), (1.02, False)):
            heights = bobbing(scene(time_step=factor * longest, weight=0.0), steps)[1] - 9.81 / RATE**2
            assert (np.abs(heights).max() < 0.02) == held


TURNED = {"name": "pin", "solid": "block", "position": [0.5, 3.0]}
ABOUT = DENSITY * SIDE**4 / 6.0
"""Inertia of the block about its middle."""


def turning(steps=1000, **keys):
    body = block(2, angular_velocity=keys.pop("spin", None))
    scene = plane(body, hinge=[{**TURNED, **keys}], **ALONE)
    run = Simulation(scene, precision="float64").run(steps, record_every=1)
    return run.times, run.solids["block"].rotations, run.solids["block"].angular_velocities


def test_a_block_on_a_torsional_spring_has_its_period():
    times, angles, _ = turning(4000, stiffness=ABOUT * RATE**2, rest_angle=0.4)
    through = passing(times, angles - 0.4)
    assert np.diff(through) == pytest.approx(2.0 * np.pi / RATE, rel=1e-4)
    assert angles.max() == pytest.approx(0.8, rel=1e-3)


def test_a_damped_hinge_slows_a_block_and_a_motor_turns_it():
    times, _, spins = turning(damping=2.0 * ABOUT, spin=3.0)
    np.testing.assert_allclose(spins, 3.0 * np.exp(-2.0 * times), rtol=3e-3)
    times, _, spins = turning(torque=5.0 * ABOUT)
    np.testing.assert_allclose(spins, 5.0 * times, rtol=1e-9, atol=1e-12)
    times, _, spins = turning(times=[0.0, 0.5, 1.0], torques=[0.0, 6.0 * ABOUT, 0.0])
    assert spins[500] == pytest.approx(1.5, rel=1e-9) and spins[-1] == pytest.approx(3.0, rel=1e-9)


def test_a_motor_follows_the_torques_and_speeds_of_a_file(tmp_path):
    """A damper of the rate 50 / s brings the block to a speed that grows by 6 rad / s2, 6 / 50 rad / s late."""
    file = tmp_path / "motor.csv"
    file.write_text("time [s],speed [rpm],torque [N m]\n0.0,0.0,0.0\n1.0,57.2957795,0.0\n")
    times, _, spins = turning(501, file=str(file), damping=50.0 * ABOUT)
    assert spins[500] == pytest.approx(6.0 * (times[500] - 0.02), rel=2e-3)
    with pytest.raises(SceneError, match=r"hinge\[0\]\.torque is 1\.0, but must be left out, as there is a file"):
        turning(file=str(file), damping=1.0, torque=1.0)
    file.write_text("time [s],power [W]\n0.0,0.0\n1.0,1.0\n")
    with pytest.raises(SceneError, match=r"cannot be used: .*its columns must be among time"):
        turning(file=str(file), damping=1.0)


def test_a_block_hangs_on_an_arm_that_moves_and_turns():
    """Its hinge goes where the arm takes it, and the motor turns it against the arm."""
    arm = box([0.8, 2.95], [0.9, 3.05], name="arm", motion="path", velocity=[0.3, 0.1], angular_velocity=2.0)
    pin = {"name": "pin", "solid": "block", "to": "arm", "position": [0.65, 3.0], "damping": 100.0 * ABOUT}
    scene = plane(block(2), arm, hinge=[{**pin, "speed": 1.0}], forces={"gravity": [0.0, 0.0]}, **ALONE)
    run = Simulation(scene, precision="float64").run(150, record_every=1)
    places = [
        run.solids[name].positions
        + way * np.stack([np.cos(run.solids[name].rotations), np.sin(run.solids[name].rotations)], axis=1)
        for name, way in (("block", 0.15), ("arm", -0.2))
    ]
    assert np.abs(places[0] - places[1])[1:].max() < 1e-6
    assert run.solids["block"].angular_velocities[-1] == pytest.approx(3.0, abs=0.15)


def test_gradients_of_springs_in_float32_are_those_in_float64():
    scene, loss = moored(plane, RAFT, TAUT["to a ball"]), SolidPose("raft", [0.3, 0.2], 0.3, length=0.2)
    point = {"line.stiffness": 3e3, "line.damping": 20.0, "line.rest_length": 0.3}
    found, wanted = (
        Problem(Simulation(scene, precision=precision), 6, loss).value_and_gradient(point)[1]
        for precision in ("float32", "float64")
    )
    for name in point:
        assert found[name] == pytest.approx(wanted[name], rel=1e-3)


WRONG = {
    "no solid": ({"solid": "boat"}, r"spring\[0\]\.solid is 'boat', but must be the name of a free body"),
    "itself": ({"to": "raft"}, r"spring\[0\]\.to is 'raft', but must be another solid"),
    "no stiffness": ({"stiffness": 0.0}, r"spring\[0\]\.stiffness is 0"),
    "a point in space": ({"point": [0.2, 0.3, 0.1]}, r"spring\[0\]\.point"),
    "two lengths": ({"preload": 1.0, "rest_length": 0.1}, "left out, as there is a rest_length"),
    "a great preload": ({"preload": 1e6}, "with which it would have no length at rest"),
    "its name": ({"name": "raft"}, "another name than those of the solids and hinges"),
    "two torques": ({"hinge": {"torque": 1.0, "times": [0.0, 1.0], "torques": [1.0, 2.0]}}, "as there are torques"),
    "three torques": ({"hinge": {"times": [0.0, 1.0], "torques": [1.0, 2.0, 3.0]}}, r"hinge\[0\]\.torques"),
}


def test_springs_between_nothing_are_a_sentence():
    for name in WRONG:
        changes, sentence = WRONG[name]
        hinge = changes.pop("hinge", None)
        line = {**LINE, "point": [0.25, 0.35], "anchor": [0.15, 0.1], **changes}
        table = {key: value for key, value in RAFT.items() if "velocity" not in key}
        hinges = [] if hinge is None else [{"name": "pin", "solid": "raft", "position": [0.3, 0.4], **hinge}]
        with pytest.raises(SceneError, match=sentence):
            plane(table, spring=[line], hinge=hinges)


def test_a_sensor_of_no_spring_and_a_hinge_without_an_axis_are_sentences():
    sensor = [{"kind": "spring_force", "name": "rope", "spring": "rope"}]
    with pytest.raises(SceneError, match=r"sensor\[0\]\.spring is 'rope', but must be the name of a spring, of"):
        plane(RAFT, spring=[{**LINE, **TAUT["with a preload"]}], sensor=sensor)
    with pytest.raises(InputError, match=r"'rope\.load' is a load on 'rope'"):
        Simulation(moored(plane, RAFT, TAUT["with a preload"])).run(2, sensors={"rope": SpringForce("rope")})
    table = {key: value for key, value in BRICK.items() if "velocity" not in key}
    pin = {"name": "pin", "solid": "raft", "position": [0.12, 0.36, 0.1], "torque": 1.0}
    with pytest.raises(SceneError, match=r"hinge\[0\]\.torque is given, .* as the hinge has no axis"):
        space(table, hinge=[pin])
