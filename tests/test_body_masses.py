"""Masses of free bodies as scenes say them: a mass, its centre and its radii of gyration."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cortado import Simulation
from cortado.discretise.solid import Mass
from cortado.errors import SceneError
from cortado.pictures.shown_solids import shown_solids
from cortado.runs.frames import posed
from cortado.scene.discrete_scene import discretise
from scenes import box
from test_free_bodies import BRICK, RAFT, plane, space

KEEL = {"centre_of_mass": [0.02, -0.04], "gyration_radius": 0.09}
KEELS = {"centre_of_mass": [0.01, -0.03, 0.02], "gyration_radius": [0.07, 0.09, 0.08]}


def massive(table, mass, **keys):
    return {**{key: value for key, value in table.items() if key != "density"}, "mass": mass, **keys}


def nothing(dimension):
    """Little fluid, far from a body, and no container."""
    return {"container": {"shape": "none"}, "fluid": [box([0.0] * dimension, [0.15] * dimension, phase="water")]}


@pytest.mark.parametrize(("scene_of", "table"), [(plane, RAFT), (space, BRICK)])
def test_a_body_is_the_same_by_its_density_its_mass_and_its_inertia(scene_of, table, monkeypatch):
    """With the centre and the radii of its shape said, or not; an inertia is one or three numbers, or a matrix. The
    particles of all are made once."""
    scene = scene_of(table)
    made = discretise(scene)
    monkeypatch.setattr("cortado.simulation.discretise", lambda _: made)
    even, d = Mass.of(scene.solid[0].shape_about()[0]), scene.dimension
    mass, moments = 500.0 * even.volume, 500.0 * np.diag(even.inertia)
    radii = np.sqrt(moments / mass)
    told = {"centre_of_mass": [0.0] * d, "gyration_radius": float(radii[2]) if d == 2 else radii.tolist()}
    told_or_not = [massive(table, mass), massive(table, mass, **told)]
    for numbers in [[float(moments[2])]] if d == 2 else [moments.tolist(), np.diag(moments).ravel().tolist()]:
        told_or_not += [{**table, "inertia": numbers}, massive(table, mass, inertia=numbers)]
    wanted = Simulation(scene, precision="float64").run(3).positions[-1]
    for one in told_or_not:
        found = Simulation(scene_of(one), precision="float64").run(3).positions[-1]
        np.testing.assert_allclose(found, wanted, atol=1e-13)


def test_the_products_of_a_matrix_turn_a_body_about_other_axes():
    """A body in nothing whose matrix is that of a turned one turns as that one does."""
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    moments, high = np.array([0.02, 0.03, 0.04]), [0.3, 2.0, 0.2]
    body = {"name": "ball", "shape": "sphere", "motion": "free", "centre": high, "radius": 0.1, "mass": 3.0}
    spins = []
    for matrix, rotation in ((np.diag(moments), turn), (turn @ np.diag(moments) @ turn.T, np.eye(3))):
        one = {**body, "inertia": matrix.ravel().tolist(), "angular_velocity": [10.0, 4.0, -6.0]}
        one["rotation"] = Rotation.from_matrix(rotation).as_rotvec().tolist()
        run = Simulation(space(one, **nothing(3)), precision="float64").run(30)
        spins.append(run.solids["ball"].angular_velocities)
    np.testing.assert_allclose(spins[0], spins[1], atol=1e-11)
    assert np.abs(spins[0][-1] - spins[0][0]).max() > 0.1


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_body_in_nothing_turns_about_the_centre_of_its_mass(dimension):
    table, keys, scene_of = ((RAFT, KEEL, plane), (BRICK, KEELS, space))[dimension - 2]
    high = {**massive(table, 20.0, **keys), "position": [0.3, 2.0, 0.2][:dimension]}
    scene = scene_of(high, **nothing(dimension))
    run = Simulation(scene, precision="float64").run(20)
    t, solid, arm = 0.001 * np.arange(21), run.solids["raft"], np.array(keys["centre_of_mass"])
    start = np.array([0.3, 2.0, 0.2][:dimension]) + scene.solid[0].turn(dimension) @ arm
    np.testing.assert_allclose(solid.positions[0], start, atol=1e-15)
    fall = np.zeros((21, dimension))
    fall[:, 1] = -9.81 * 0.001**2 * np.arange(21) * np.arange(1, 22) / 2.0
    np.testing.assert_allclose(solid.positions, start + np.multiply.outer(t, table["velocity"]) + fall, atol=1e-13)
    if dimension == 2:
        np.testing.assert_allclose(solid.angular_velocities, 2.0, rtol=1e-12)


@pytest.mark.parametrize(("load", "sign"), [(0.1, -1.0), (0.25, 1.0)])
def test_a_low_load_rights_a_box_and_a_high_one_capsizes_it(load, sign):
    """A box 0.8 x 0.4 m, half as heavy as water, heels by 0.1 rad to the left. Its metacentre is 0.167 m above its
    middle, 0.8^2 / (12 x 0.2) - 0.1: so far up may its centre of mass be."""
    body = box([1.2, 0.8], [2.0, 1.2], name="raft", motion="free", mass=160.0, rotation=0.1)
    scene = plane(
        {**body, "centre_of_mass": [0.0, load], "gyration_radius": 0.5},
        discretisation={"spacing": 0.04},
        fluid=[box([0.0, 0.0], [3.2, 1.0], phase="water")],
        container=box([0.0, 0.0], [3.2, 2.0]),
        solver={"kind": "projection", "time_step": 0.002},
    )
    run = Simulation(scene, precision="float64").run(60)
    assert sign * run.solids["raft"].angular_velocities[-1] > 0.01


def test_a_picture_of_a_body_shows_its_shape_where_its_walls_are():
    scene = plane(massive(RAFT, 20.0, **KEEL))
    run = Simulation(scene, precision="float64").run(5)
    (one,) = shown_solids(posed(scene, run.solids, -1))
    motion, table = run.solids["raft"], scene.solid[0]
    angle = motion.rotations[-1]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    np.testing.assert_allclose(one.position + turn @ np.array(KEEL["centre_of_mass"]), motion.positions[-1], atol=1e-12)
    np.testing.assert_allclose(one.turn, turn, atol=1e-12)
    assert table.own_solid().distance(-np.array([KEEL["centre_of_mass"]]))[0] == pytest.approx(-0.08)


def test_masses_that_do_not_fit_together_are_refused():
    for keys, wanted in [
        ({"density": 500.0, "mass": 20.0}, "left out, as there is a density"),
        ({"mass": 20.0, "inertia": [0.1, 0.1, 0.1]}, "one number in 2-D"),
        ({"mass": 20.0, "inertia": 0.0}, "greater than 0 about every axis"),
        ({}, "a density in kg/m3, or a mass"),
        ({"mass": 20.0, "centre_of_mass": [0.0, 0.1]}, "gyration_radius"),
    ]:
        with pytest.raises(SceneError, match=wanted):
            plane({**box([0.2, 0.32], [0.45, 0.48], name="raft", motion="free"), **keys})
    with pytest.raises(SceneError, match="only a body whose motion"):
        plane(box([0.2, 0.32], [0.45, 0.48], name="post", gyration_radius=0.1))


def test_an_inertia_of_no_body_is_refused():
    for numbers, wanted in [
        ([1.0, 2.0], "three numbers, or the nine of a matrix, in 3-D"),
        ([1.0, 1.0, 3.0], "whose two least moments together are not less than the greatest"),
        ([1.0, 0.1, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], "the same numbers on both sides of its diagonal"),
    ]:
        with pytest.raises(SceneError, match=wanted):
            space(massive(BRICK, 3.0, inertia=numbers))
