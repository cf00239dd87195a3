"""Planes as solids: walls where the container leaves room for fluid, films and water in front of them."""

import numpy as np
import pytest

from cortado import InputError, Scene, SceneError, Simulation
from cortado.discretise.solid import cut_box_faces
from cortado.pictures.shown_solids import solid_outline
from cortado.scene.discrete_scene import discretise
from test_packing import densities
from test_solids import volume_and_middle, winding

SPACING = 0.05
BOX = {"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0]}
SLOPE = {"name": "slope", "shape": "plane", "position": [0.5, 0.3], "normal": [-1.0, 2.0]}
UNIT = np.array([-1.0, 2.0]) / np.sqrt(5.0)


def scene(solids: list, fluid: tuple = ([0.0, 0.0], [1.0, 0.6]), container: dict | None = BOX, **more) -> Scene:
    """By default all of a tank below 0.6 m is full of water, but for what is solid."""
    dimension = len(fluid[0])
    return Scene(
        dimension=dimension,
        discretisation={"spacing": SPACING},
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.001}],
        fluid=[{"shape": "box", "lower": fluid[0], "upper": fluid[1], "phase": "water"}],
        solid=solids,
        solver={"kind": "projection", "time_step": 0.001},
        **({} if container is None else {"container": container}),
        **more,
    )


def energies(run, gravity=9.81):
    return 0.5 * (run.velocities**2).sum(axis=2).mean(axis=1) + gravity * run.positions[:, :, 1].mean(axis=1)


def test_walls_are_behind_the_plane_beside_where_fluid_may_be():
    table = scene([SLOPE])
    found = discretise(table)
    walls, room = found.walls.positions, table.discretisation.support_radius
    below = (walls - SLOPE["position"]) @ UNIT
    of_slope = np.linalg.norm(found.walls.feet - (-below[:, None] * UNIT), axis=1) < 1e-9
    assert of_slope.sum() > 20 and below[of_slope].max() < 0.0
    assert (walls > -room).all() and (walls < 1.0 + room).all()
    in_room = ((walls > 0.0) & (walls < 1.0)).all(axis=1)
    assert below[in_room].max() < 0.0


def test_water_on_a_slope_starts_at_rest_and_stays_in_front_of_it():
    table = scene([SLOPE])
    density = densities(table, discretise(table))
    assert density.max() < 1.012
    x = discretise(table).fluid.positions
    assert len(x) * SPACING**2 == pytest.approx(0.3, rel=0.04)  # the slope goes from 0.05 to 0.55
    run = Simulation(table, precision="float64").run(300, record_every=50)
    assert energies(run).max() < 1.002 * energies(run)[0]  # 0.17 %, from repairs of a density that is uneven at first
    assert ((run.positions - SLOPE["position"]) @ UNIT).min() > 0.2 * SPACING


def test_a_plane_along_the_lattice_is_a_floor():
    """Water at rest on one has the densities of water on the floor of a container."""
    floor = {"name": "floor", "shape": "plane", "position": [0.3, 0.2], "normal": [0.0, 3.0]}
    on_plane = scene([floor], ([0.0, 0.2], [1.0, 0.6]))
    density = densities(on_plane, discretise(on_plane))
    inner = discretise(on_plane).fluid.positions[:, 1] < 0.6 - on_plane.discretisation.support_radius
    np.testing.assert_allclose(density[inner], 1.0, atol=0.01)


def test_a_plane_beside_a_period_is_one_wall_without_an_end():
    container = BOX | {"periodic": [True, False], "lower": [0.0, -0.5]}
    floor = {"name": "floor", "shape": "plane", "position": [0.3, 0.02], "normal": [0.0, 1.0]}
    table = scene([floor], ([0.0, 0.0], [1.0, 0.5]), container)
    found = discretise(table)
    walls = found.walls.positions
    walls = walls[np.abs(walls[:, 1]) < 0.2]
    assert (walls[:, 0] >= 0.0).all() and (walls[:, 0] < 1.0).all() and walls[:, 1].max() < 0.02
    density = densities(table, found)
    inner = found.fluid.positions[:, 1] < 0.3
    assert np.abs(density[inner] - 1.0).max() < 0.01


def test_a_plane_in_space_cuts_a_cup():
    """A cylinder whose bottom leans."""
    cup = {"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": 0.3, "height": 0.8}
    plane = {"name": "bottom", "shape": "plane", "position": [0.0, 0.2, 0.0], "normal": [0.3, 1.0, 0.1]}
    table = scene([plane], ([-0.2, 0.0, -0.2], [0.2, 0.5, 0.2]), cup)
    found = discretise(table)
    unit = np.array(plane["normal"]) / np.linalg.norm(plane["normal"])
    assert ((found.fluid.positions - plane["position"]) @ unit).min() > 0.2 * SPACING
    assert len(found.fluid.positions) * SPACING**3 == pytest.approx(0.4 * 0.4 * 0.3, rel=0.05)
    assert densities(table, found).max() < 1.02


@pytest.mark.parametrize("normal", [[0.6, 0.8], [0.0, 1.0], [-0.36, 0.48, 0.8], [0.0, 0.0, -1.0]])
def test_a_box_below_a_plane_has_its_volume_and_faces(normal):
    normal, d = np.array(normal), len(normal)
    lower, upper = np.full(d, -0.5), np.full(d, 0.7)
    faces = cut_box_faces(lower, upper, normal, 0.1)
    rng = np.random.default_rng(2)
    points = rng.uniform(-1.0, 1.0, (4000, d))
    inside = ((points > lower) & (points < upper)).all(axis=1) & (points @ normal < 0.1)
    np.testing.assert_allclose(winding(points, faces), inside, atol=1e-6)
    assert volume_and_middle(faces)[0] == pytest.approx(inside.mean() * 2.0**d, rel=0.1)


@pytest.mark.parametrize(
    ("change", "container", "sentence"),
    [
        ({"normal": [0.0, 0.0]}, BOX, "solid[0].normal is [0.0, 0.0], but must be a vector that is not 0"),
        ({"normal": [0.0, 1.0, 0.0]}, BOX, "a list of 2 components"),
        ({"position": None}, BOX, "solid[0].position"),
        ({"side": "inside"}, BOX, "fluid is where the normal of a plane points"),
        ({"rotation": 0.1}, BOX, "normal says how a plane is turned"),
        ({"motion": "path", "velocity": [1.0, 0.0]}, BOX, "a plane is at rest"),
        ({"surface_velocity": [1.0, 0.0]}, BOX, "a plane is at rest"),
        ({}, None, "as a plane has no end: give it a [container] to cut"),
        ({}, BOX | {"periodic": [True, False]}, "0 along axis 0, where the container is periodic"),
        ({"position": [0.5, -2.0]}, BOX, "outside of the container, all of which is in front of it"),
    ],
)
def test_a_wrong_plane_is_a_sentence(change, container, sentence):
    with pytest.raises(SceneError) as error:
        scene([SLOPE | change], container=container)
    assert sentence in str(error.value) and "solid[0]" in str(error.value)


def test_a_plane_in_front_of_all_of_the_fluid_is_said():
    with pytest.raises(InputError, match=r"fluid.0 has no particle"):
        discretise(scene([SLOPE | {"position": [0.5, 2.0]}]))


def test_pictures_have_a_plane_as_far_as_the_container_goes():
    lines = solid_outline(scene([SLOPE]))
    assert lines.min() == pytest.approx(0.0, abs=1e-12) and lines.max() == pytest.approx(1.0)
    assert np.abs((lines - SLOPE["position"]) @ UNIT).min() < 1e-12


def test_a_scene_with_a_plane_is_the_same_out_of_its_json():
    table = scene([SLOPE])
    again = Scene.from_json(table.to_json())
    np.testing.assert_array_equal(discretise(again).walls.positions, discretise(table).walls.positions)
