"""Solids at rest: their shapes against brute force, their walls against the lattice, and that they hold fluid."""

import re

import numpy as np
import pytest
from scipy.spatial import KDTree

from cortado import CortadoWarning, DivergedError, InputError, SceneError, Simulation
from cortado.scene.discrete_scene import discretise
from cortado.scene.scene_warnings import thin_sentences
from cortado.scene.solid_shapes import BoxSolid, CapsuleSolid, CupSolid, CylinderSolid, PolygonSolid, SphereSolid
from cortado.scene.solids import solids_of
from held_water import cup_turned, meshes, stirred
from scenes import box, pool
from test_packing import densities

AT = {"name": "a", "base": [0.1, 0.2, 0.3], "radius": 0.4}
SOLIDS = {
    "rectangle": (BoxSolid(name="a", lower=[0.0, 0.1], upper=[1.0, 0.6], rotation=0.3), 0.5),
    "disc": (SphereSolid(name="a", centre=[0.3, 0.2], radius=0.5), np.pi * 0.25),
    "flat capsule": (CapsuleSolid(name="a", start=[0.0, 0.0], end=[0.5, 0.8], radius=0.3),
                     np.pi * 0.09 + 0.6 * np.sqrt(0.89)),
    "flat cup": (CupSolid(**{**AT, "base": [0.1, 0.2]}, height=0.9, thickness=0.2, rotation=-0.4), 0.52),
    "polygon": (PolygonSolid(name="a", corners=[[0.0, 0.0], [0.2, 0.9], [0.4, 0.3], [1.0, 0.1]], position=[0.5, 0.5]),
                0.28),
    "box": (BoxSolid(name="a", lower=[0.0, 0.1, 0.0], upper=[1.0, 0.6, 0.7], rotation=[0.3, -0.2, 0.5]), 0.35),
    "sphere": (SphereSolid(name="a", centre=[0.3, 0.2, 0.1], radius=0.5), np.pi / 6.0),
    "capsule": (CapsuleSolid(name="a", start=[0.0, 0.0, 0.1], end=[0.5, 0.8, 0.3], radius=0.3),
                np.pi * (0.036 + 0.09 * np.sqrt(0.93))),
    "cylinder": (CylinderSolid(**AT, height=0.7, axis="x", rotation=[0.1, 0.0, 0.4]), np.pi * 0.16 * 0.7),
    "cup": (CupSolid(**AT, height=0.9, thickness=0.2, axis="z", rotation=[0.5, 0.0, 0.0]),
            np.pi * (0.36 * 0.9 - 0.16 * 0.7)),
}  # fmt: skip
"""Each with its area or its volume."""


def volume_and_middle(faces):
    """Of what is within faces, by the divergence theorem."""
    corners = faces.vertices[faces.corners]
    parts = np.linalg.det(corners)
    d = corners.shape[2]
    middle = (parts[:, None] * corners.sum(axis=1)).sum(axis=0) / ((d + 1) * parts.sum())
    return parts.sum() / {2: 2.0, 3: 6.0}[d], middle


def winding(points, faces):
    """(n,) how often faces go around points: 1 within, 0 outside."""
    a = faces.vertices[faces.corners][None] - points[:, None, None]
    if points.shape[1] == 2:
        (x, y), (z, w) = np.moveaxis(a[:, :, 0], -1, 0), np.moveaxis(a[:, :, 1], -1, 0)
        return np.arctan2(x * w - y * z, x * z + y * w).sum(axis=1) / (2.0 * np.pi)
    length = np.linalg.norm(a, axis=-1)
    one, two, three = (a[:, :, k] for k in range(3))
    up = np.einsum("nkc,nkc->nk", one, np.cross(two, three))
    down = length.prod(axis=2)
    for (p, q), r in (((one, two), 2), ((two, three), 0), ((three, one), 1)):
        down = down + np.einsum("nkc,nkc->nk", p, q) * length[:, :, r]
    return 2.0 * np.arctan2(up, down).sum(axis=1) / (4.0 * np.pi)


@pytest.mark.parametrize("name", SOLIDS)
def test_a_shape_has_its_volume_and_its_middle(name):
    table, area_or_volume = SOLIDS[name]
    volume, middle = volume_and_middle(table.body().faces(0.01))
    assert volume == pytest.approx(area_or_volume, rel=2e-3)
    wanted = table.shape_about()[1] if table.position is None else table.position
    np.testing.assert_allclose(middle, wanted, atol=1e-3)


@pytest.mark.parametrize("name", SOLIDS)
def test_distances_and_nearest_points_are_those_of_the_faces(name):
    solid, random = SOLIDS[name][0].body(), np.random.default_rng(1)
    lower, upper = solid.extent()
    d = len(lower)
    points = random.uniform(lower - 0.2, upper + 0.2, (100, d))
    faces = solid.faces(0.05)
    found = solid.distance(points)
    np.testing.assert_array_equal(found[np.abs(found) > 0.01] < 0.0, winding(points, faces)[np.abs(found) > 0.01] > 0.5)
    shares = random.dirichlet(np.ones(d), (20000 // len(faces.corners) + 1, len(faces.corners)))
    samples = np.einsum("mkc,kcx->mkx", shares, faces.vertices[faces.corners]).reshape(-1, d)
    assert (np.abs(found) < KDTree(samples).query(points)[0] + 2e-3).all()  # nothing of the surface is nearer
    near = solid.nearest(points)
    np.testing.assert_allclose(np.linalg.norm(points - near, axis=1), np.abs(found), atol=1e-12)
    np.testing.assert_allclose(solid.distance(near), 0.0, atol=1e-12)
    assert ((samples >= lower - 1e-9) & (samples <= upper + 1e-9)).all()


def scene(solids, dimension=2, kind="projection", spacing=0.05, **tables):
    solid = [{"name": f"solid {k}", **table} for k, table in enumerate(solids)]
    own = {"solver": {"kind": kind, "time_step": 0.001}, "solid": solid}
    return pool([0.4, 0.6, 0.5][:dimension], [1.0, 1.0, 0.5][:dimension], spacing, **{**own, **tables})


def energies_of(run):
    return (0.5 * (run.velocities**2).sum(axis=-1) + 9.81 * run.positions[..., 1]).mean(axis=1)


def deepest(run, one):
    (solid,) = solids_of(one.solid)
    return min(solid.distance(x.astype(float)).min() for x in run.positions)


PILLAR = {"shape": "box", "lower": [0.55, 0.0], "upper": [0.65, 0.3]}
LEANING = {"shape": "box", "lower": [0.457, -0.1], "upper": [0.565, 0.317], "rotation": 0.1}
DISC = {"shape": "sphere", "centre": [0.6, 0.2], "radius": 0.1}
SHEET = {"shape": "box", "lower": [0.55, 0.0], "upper": [0.6, 0.4], "rotation": 0.1}
RAMP = {"shape": "polygon", "corners": [[0.6, 0.0], [1.0, 0.0], [1.0, 0.4]]}
WEDGE = {"shape": "polygon", "corners": [[0.4, 0.0], [1.0, 0.0], [1.0, 0.5]]}
OBSTACLES = {"pillar": PILLAR, "leaning": LEANING, "disc": DISC, "sheet": SHEET, "ramp": RAMP, "wedge": WEDGE}


def full(table, **tables):
    return scene([table], fluid=[box([0.0, 0.0], [1.0, 1.0], phase="water")], **tables)


TURNED_TANK = {"shape": "box", "lower": [0.2, 0.2], "upper": [0.8, 0.8], "rotation": 0.4, "side": "inside"}


@pytest.mark.parametrize("kind", ["projection", "pcisph"])
@pytest.mark.parametrize("table", [*OBSTACLES.values(), TURNED_TANK], ids=[*OBSTACLES, "turned tank"])
def test_fluid_around_a_solid_starts_at_rest(table, kind):
    one = full(table, kind=kind)
    found = densities(discretise(one))
    assert found.max() < 1.01 and found.min() > 0.99


def test_a_container_keeps_its_walls_where_no_fluid_beside_a_solid_sees_them():
    """Those that are found together with the walls of the solid begin there, without a gap."""
    one, spacing = scene([PILLAR], spacing=0.025), 0.025
    walls, alone = discretise(one).walls, discretise(scene([], spacing=spacing)).walls
    (solid,), clear = solids_of(one.solid), 2.0 * one.discretisation.support_radius + spacing
    far = solid.distance(alone.positions + alone.feet) >= clear
    assert 0.5 < far.mean() < 0.95
    for name in ("positions", "weights", "feet", "solid"):
        np.testing.assert_allclose(getattr(walls, name)[: far.sum()], getattr(alone, name)[far], atol=1e-9)
    others = (walls.positions + walls.feet)[far.sum() :]
    assert clear - spacing < solid.distance(others).max() < clear + spacing
    layer = np.abs(walls.positions[:, 1] + 0.4 * spacing) < 1e-6
    floor = np.sort(walls.positions[layer & (np.abs(walls.positions[:, 0] - 0.275) < 0.275), 0])
    assert 0.3 * spacing < np.diff(floor).min() and np.diff(floor).max() < 1.2 * spacing


def test_an_open_cup_with_a_solid_in_it_ends_at_its_rim():
    cup = {"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": 0.3, "height": 0.5, "lid": False}
    water = {"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": 0.3, "height": 0.2, "phase": "water"}
    post = {"shape": "box", "lower": [-0.1, -0.1, -0.1], "upper": [0.1, 0.3, 0.1]}
    walls = discretise(scene([post], 3, spacing=0.1, container=cup, fluid=[water])).walls
    assert 0.4 < walls.positions[:, 1].max() < 0.5


@pytest.mark.parametrize("kind", ["projection", "pcisph"])
@pytest.mark.parametrize("name", OBSTACLES)
def test_a_dam_break_against_a_solid_gains_no_energy_and_does_not_enter_it(name, kind):
    one = scene([OBSTACLES[name]], kind=kind, spacing=0.025)
    run = Simulation(one, precision="float64").run(400, record_every=10)
    energies = energies_of(run)
    assert energies.max() < 1.0005 * energies[0] and deepest(run, one) > -0.6 * 0.025
    assert np.ptp(run.positions[-1][:, 0]) > 0.5  # it has moved


@pytest.mark.parametrize("rotation", [0.0, 0.2, 0.785])
def test_a_tank_may_be_turned(rotation):
    tank = box([-0.6, -0.5], [0.6, 0.5], rotation=rotation, side="inside")
    one = scene([tank], container={"shape": "none"}, fluid=[box([-0.25, -0.2], [0.25, 0.2], phase="water")])
    run = Simulation(one, precision="float64").run(600, record_every=20)
    energies = energies_of(run)
    assert np.diff(energies).max() < 1e-3 * (energies[0] - energies[-1]) and deepest(run, one) > 0.0


def test_each_solid_has_its_own_slip():
    """A layer of fluid between two plates that slides along them is held back by the one without slip."""
    one = scene(
        [box([0.0, low], [1.0, low + 0.2], slip=slip) for low, slip in zip((-0.2, 0.4), ("no", "free"), strict=True)],
        fluid=[box([0.0, 0.0], [1.0, 0.4], phase="water", velocity=[1.0, 0.0])],
        container=box([0.0, -0.5], [1.0, 1.0], periodic=[True, False]),
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 20.0}],
        forces={"gravity": [0.0, 0.0]},
    )
    run = Simulation(one, precision="float64").run(200)
    speeds = run.velocities[-1][:, 0]
    y = run.positions[-1][:, 1]
    assert speeds[y < 0.1].mean() < 0.5 and speeds[y > 0.3].mean() > 0.85


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({**PILLAR, "upper": [0.56, 0.3]}, "only 0.01 m thick"),
        ({**PILLAR, "rotation": [0.1, 0.2, 0.3]}, "one number in 2-D"),
        ({"shape": "polygon", "corners": [[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]]}, "sides that do not cross"),
        ({"shape": "cup", "base": [0.5, 0.0], "radius": 0.2, "height": 0.1, "thickness": 0.2}, "less than height, 0.1"),
        ({**DISC, "centre": [1e12, 0.0]}, "m from the origin"),
        ({"shape": "polygon", "corners": [[0.1, 0.3], [0.2, 0.3]]}, "at least 3 entries, each a list"),
    ],
)
def test_a_bad_solid_is_a_sentence(table, sentence):
    with pytest.raises(SceneError) as error:
        scene([table])
    assert sentence in str(error.value) and "solid[0]" in str(error.value)


@pytest.mark.parametrize(
    ("solid", "words"),
    [
        ({"shape": "box", "lower": [-0.1, -0.1], "upper": [0.8, 0.8]}, r"fluid.0 has no particle"),
        ({"shape": "plane", "position": [0.5, 2.0], "normal": [0.0, 1.0]}, r"fluid.0 has no particle"),
        ({"shape": "sphere", "centre": [5.0, 5.0], "radius": 0.2}, "solid 'solid 0' has no surface that fluid"),
    ],
)
def test_a_solid_that_leaves_no_room_or_is_out_of_reach_is_said(solid, words):
    with pytest.raises(InputError, match=words):
        discretise(scene([solid]))


def test_positions_in_a_solid_are_refused():
    simulation = Simulation(scene([PILLAR]))
    places = simulation.positions.copy()
    places[3] = [0.6, 0.1]
    with pytest.raises(InputError, match="outside the container or in a solid"):
        simulation.run(1, {"initial_positions": places})


def wall(thickness):
    return {"shape": "box", "lower": [0.4, -0.1], "upper": [0.4 + 0.05 * thickness, 1.1]}


SHEET_OF_CORNERS = {"shape": "polygon", "corners": [[0.5, 0.2], [0.9, 0.2], [0.9, 0.27], [0.5, 0.27]]}
MOVED = {"motion": "path", "velocity": [0.0, 0.1]}
THIN = {
    "wall": wall(1.45),
    "polygon": SHEET_OF_CORNERS,
    "cup": {"shape": "cup", "base": [0.7, 0.2], "radius": 0.15, "height": 0.3, "thickness": 0.06},
    "capsule": {"shape": "capsule", "start": [0.5, 0.3], "end": [0.9, 0.5], "radius": 0.03},
    "moving": {"shape": "box", "lower": [0.6, 0.2], "upper": [0.66, 0.6], **MOVED},
    "free": {"shape": "box", "lower": [0.5, 0.3], "upper": [0.9, 0.36], "motion": "free", "density": 500.0},
    "leaning": {"shape": "box", "lower": [0.6, 0.2], "upper": [0.66, 0.7], "rotation": 0.4},
    "thin above": {"shape": "polygon", "corners": [[0.5, 0.0], [0.7, 0.0], [0.63, 0.9], [0.6, 0.9]]},
}
THICK = {
    "wall": wall(1.5),
    "on the floor": {"shape": "box", "lower": [0.5, 0.0], "upper": [0.9, 0.06]},
    "ramp": RAMP,
    "tank": TURNED_TANK,
    "disc": DISC,
    "moving": {"shape": "box", "lower": [0.6, 0.2], "upper": [0.675, 0.6], **MOVED},
}


def test_solids_that_are_too_thin_to_hold_fluid_are_warned_of():
    words = "the solid 'solid 0' is thinner than 0.075 m, 1.5 times the spacing, at"
    with pytest.warns(CortadoWarning, match=re.escape(words)):
        discretise(scene([SHEET_OF_CORNERS]))
    for name, table in THIN.items():
        assert [words in sentence for sentence in thin_sentences(scene([table]))] == [True], name


def test_those_that_are_thick_enough_or_have_fluid_on_one_side_are_not():
    for name, table in THICK.items():
        assert not list(thin_sentences(scene([table]))), name


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_walls_hold_water_from_the_thickness_on_that_is_said():
    auto = {"kind": "projection", "time_step": "auto"}
    run = Simulation(scene([wall(1.5)], solver=auto)).run(80, record_every=10)
    assert run.positions[..., 0].max() < 0.4 + 0.2 * 0.05
    with pytest.raises(DivergedError, match="entered the solid 'solid 0'"):
        Simulation(scene([wall(1.0)], solver=auto)).run(80)


def sheet(lower, upper):
    return {"shape": "polygon", "corners": [[lower, -0.1], [upper, -0.1], [upper, 1.1], [lower, 1.1]]}


LININGS = {
    "of the container": ([sheet(0.4, 0.4375)], 0.4375),
    "of a wall": ([sheet(0.4, 0.4375), {"shape": "box", "lower": [0.4375, -0.1], "upper": [0.6, 1.1]}], 1.0),
    "of another": ([sheet(0.4, 0.4375), sheet(0.4375, 0.475)], 1.0),
}


@pytest.mark.parametrize("name", LININGS)
@pytest.mark.filterwarnings("error:the solid:cortado.CortadoWarning")
def test_a_lining_thinner_than_a_spacing_has_the_wall_particles_of_what_is_behind_it(name):
    """At the same depths as one solid in the place of both, and about as heavy. No fluid is near: none is packed."""
    solids, upper = LININGS[name]
    whole = wall(1.5) if name == "of another" else wall(4.0)

    def layers(tables):
        apart = [box([0.1, 0.4], [0.2, 0.5], phase="water")]
        walls = discretise(scene(tables, container=box([0.0, 0.0], [upper, 1.0]), fluid=apart)).walls
        x, y = walls.positions.T
        beside = np.abs(y - 0.5) < 0.25
        return np.histogram(x[beside], [0.4, 0.43, 0.445, 0.5], weights=walls.weights[beside])[0]

    np.testing.assert_allclose(layers(solids), layers([whole]), rtol=0.4)


def test_a_paddle_stirs_and_nothing_enters_it():
    found = stirred(14, 330, thickness=0.14, precision="float64")
    assert found["turns"] > 0.6
    assert found["deepest"] < 0.5 and found["outside"] < 0.5


def test_a_cup_is_turned_upside_down_and_back_and_loses_what_it_pours_alone():
    found = cup_turned(30, 900)
    assert found["through its wall"] == 0 and found["deepest"] < 0.5
    assert found["poured"] > 0.8 * found["particles"] and found["poured"] + found["still in it"] == found["particles"]


@pytest.mark.parametrize("name", ["torus", "cup with a handle", "bodies that overlap"])
def test_a_mesh_holds_water(name):
    found = meshes(60, name, precision="float64", discretisation={"spacing": 0.05})  # which others compile too
    assert found["energy"] < 1.005 and found["deepest"] < 0.5 and found["lowest"] > 0.0


def test_a_cup_without_a_bottom_holds_none():
    assert meshes(100, "cup with a handle", bottom=False)["lowest"] < 0.0
