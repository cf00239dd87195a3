"""Free bodies that are held: fewer ways to move."""

import numpy as np
import pytest

from cortado import SceneError, Simulation
from floating_bodies import disc_in_a_round_tank, passing
from scenes import box, pool
from test_free_bodies import BRICK, RAFT, plane, space

STILL = {"velocity": None, "angular_velocity": None}
WAYS = [(plane, RAFT, ["x", "y"]), (plane, RAFT, ["x", "rotation"]), (space, BRICK, ["x", "y", "rotation_y"])]
WAYS += [(space, BRICK, ["z", "rotation_x", "rotation_z"])]


def held(table, *freedom):
    """A body with these freedoms, which begins with what it may of its motion."""
    flat = "rotation" in freedom or len(table["velocity"]) == 2
    turns = ["rotation"] if flat else ["rotation_x", "rotation_y", "rotation_z"]
    speeds = [speed * (way in freedom) for way, speed in zip("xyz", table["velocity"], strict=False)]
    spins = [spin * (way in freedom) for way, spin in zip(turns, np.atleast_1d(table["angular_velocity"]), strict=True)]
    return {**table, "freedom": list(freedom), "velocity": speeds, "angular_velocity": spins[0] if flat else spins}


@pytest.mark.parametrize(("scene_of", "table", "freedom"), WAYS)
def test_a_body_in_nothing_moves_in_its_free_ways_alone(scene_of, table, freedom):
    d = 2 if scene_of is plane else 3
    body = {**held(table, *freedom), "position": [0.3, 3.0, 0.2][:d]}
    run = Simulation(scene_of(body, container={"shape": "none"}), precision="float64").run(50)
    solid, t = run.solids["raft"], 0.001 * np.arange(51)
    for axis, way in enumerate("xyz"[:d]):
        fall = -9.81 * 0.001**2 * np.arange(51) * np.arange(1, 52) / 2.0 if way == "y" else 0.0 * t
        moved = body["velocity"][axis] * t + fall if way in freedom else 0.0 * t
        np.testing.assert_allclose(solid.positions[:, axis], body["position"][axis] + moved, atol=1e-14)
    spins, begun = solid.angular_velocities.reshape(51, -1), np.atleast_1d(body["angular_velocity"])
    free = [way in freedom for way in (["rotation"] if d == 2 else ["rotation_x", "rotation_y", "rotation_z"])]
    assert np.abs(spins[:, ~np.array(free)]).max(initial=0.0) < 1e-14
    if sum(free) == 1:
        np.testing.assert_allclose(spins[:, free][:, 0], begun[free][0], rtol=1e-12)


def test_a_disc_that_may_only_rise_has_its_added_mass(tmp_path):
    faster = disc_in_a_round_tank(200.0, str(tmp_path / "rings.npy"), 0.03, 6, freedom=["y"])
    assert np.abs(faster[1:] - 1.0).max() < 0.1


def test_a_box_that_may_only_heave_has_its_period():
    """That of its mass and of the water that goes along, 368 kg by potential flow on cells of 1 cm, in a tank that is
    not much wider, where its surface sinks as the box rises."""
    wide, draft, depth, width = 0.6, 0.2, 0.5, 1.0
    lower = depth - draft + 0.05
    raft = box([0.5 * (width - wide), lower], [0.5 * (width + wide), lower + 0.4], name="raft", motion="free")
    raft |= {"density": 500.0, "freedom": ["y"]}
    scene = pool([width, depth], [width, 1.2], 0.025, 0.001, solid=[raft])
    run = Simulation(scene, precision="float64").run(3000, record_every=5)
    heights = run.solids["raft"].positions[:, 1]
    mass = 1000.0 * wide * draft + 368.0
    rate = np.sqrt(9810.0 * wide * (1.0 + wide / (width - wide)) / mass)
    through = passing(run.times, heights - heights[len(heights) // 4 :].mean())
    assert np.diff(through).mean() == pytest.approx(2.0 * np.pi / rate, rel=0.03)


def test_a_box_that_may_not_move_is_a_solid_at_rest_to_the_fluid():
    """But for its turn about its middle, to which the symmetric water gives nothing."""
    boxed = box([0.4, 0.3], [0.6, 0.5], name="raft")
    one = plane({**boxed, "motion": "free", "density": 500.0, "freedom": ["rotation"]})
    other = plane({**boxed, "motion": "path", "velocity": [0.0, 0.0]})
    runs = [Simulation(scene, precision="float64").run(30) for scene in (one, other)]
    assert np.abs(runs[0].positions[-1] - runs[1].positions[-1]).max() < 1e-3


WRONG = {
    "a way in space": ({"freedom": ["x", "rotation_x"]}, r"solid\[0\]\.freedom is a list of 'x', 'rotation_x', but"),
    "no way": ({"freedom": []}, "freedom is a list of nothing, but must be some of"),
    "on a path": ({"freedom": ["x"], "motion": "path", "density": None}, "left out, as only a body whose motion is"),
    "a speed": ({"freedom": ["x", "rotation"], **STILL, "velocity": [0.0, 1.0]}, "0 where the body is held, in 'y'"),
    "a turn": ({"freedom": ["x"], **STILL, "angular_velocity": 1.0}, "0 where the body is held, in 'rotation'"),
}


@pytest.mark.parametrize("name", WRONG)
def test_freedoms_that_are_none_are_a_sentence(name):
    changes, sentence = WRONG[name]
    with pytest.raises(SceneError, match=sentence):
        plane({key: value for key, value in {**RAFT, **changes}.items() if value is not None})
