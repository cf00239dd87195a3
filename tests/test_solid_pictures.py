"""Solids in pictures: seen where they are, in front of what is behind them, without changing scenes that have none."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import cortado
from cortado.device.launching import BandLauncher
from cortado.discretise.shapes import corners
from cortado.pictures.pages import container_outline, outline, scene_view
from cortado.pictures.painter import colours_of, painter
from cortado.pictures.plots import particles
from cortado.pictures.shown_solids import FAR, SolidMesh, shown_solids, solid_outline
from cortado.pictures.stage import Stage, screen_axes
from cortado.pictures.tracing.solid_surfaces import NODES, REACH, FloorShadow, SolidSurfaces
from cortado.pictures.tracing.space import mirrored
from scenes import bodies, box

BLUE, ORANGE = (0.05, 0.1, 0.8), (0.7, 0.3, 0.05)
PILLAR = {"name": "pillar", "shape": "box", "lower": [0.35, 0.0, 0.15], "upper": [0.45, 0.4, 0.25], "colour": ORANGE}
BALL = {"name": "ball", "shape": "sphere", "centre": [0.4, 0.2, 0.2], "radius": 0.1, "colour": ORANGE}
CAVITY = {"name": "tank", "shape": "box", "lower": [0.0] * 3, "upper": [0.6, 0.5, 0.4], "side": "inside"}
CUP = {"name": "cup", "shape": "cup", "base": [0.3, 0.0, 0.2], "radius": 0.2, "height": 0.4, "thickness": 0.05}
SHAPES = [
    PILLAR,
    BALL,
    CUP,
    {"name": "rod", "shape": "capsule", "start": [0.3, 0.2, 0.2], "end": [0.5, 0.3, 0.2], "radius": 0.08},
    {"name": "drum", "shape": "cylinder", "base": [0.4, 0.0, 0.2], "radius": 0.1, "height": 0.3, "axis": "x"},
]


def scene_of(dimension, *solids, picture=None, **tables):
    """A box with a column of blue fluid on its left, and solids."""
    d = dimension
    cut = [{k: v[:d] if isinstance(v, list) and k != "rotation" else v for k, v in one.items()} for one in solids]
    given = {
        "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 0.05, "colour": BLUE}],
        "container": box([0.0] * d, [0.6, 0.5, 0.4][:d]),
        "solid": cut,
        "solver": {"kind": "pcisph", "time_step": 0.002},
        "picture": {"width": 240, "height": 160, **(picture or {})},
    }
    fluid = tables.pop("fluid", [box([0.0] * d, [0.2, 0.3, 0.4][:d])])
    return bodies(d, fluid, **{**given, **tables})


def lattice(lower, upper, spacing=0.05):
    """Particles that fill a box, half a spacing from its sides."""
    axes = [np.arange(low + 0.5 * spacing, high, spacing) for low, high in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def drawn(scene, positions):
    positions = np.asarray(positions, dtype=float)
    return painter(scene, positions).image(positions, colours_of(scene, None, len(positions)))


def pixel_of(scene, positions, place):
    """Row and column where a place (d,) [m] is seen."""
    artist = painter(scene, np.asarray(positions, dtype=float))
    stage, picture = artist.stage, artist.stage.picture
    if scene.dimension == 2:
        x, y = stage.pixels
        return int(np.argmin(np.abs(y[:, 0] - place[1]))), int(np.argmin(np.abs(x[0] - place[0])))
    off = stage.placed(np.asarray(place)) - stage.eye
    forward = stage.look_at - stage.eye
    forward /= np.linalg.norm(forward)
    right, up = screen_axes(forward)
    half = np.tan(0.5 * np.radians(picture.field_of_view)) * (off @ forward)
    column = 0.5 * picture.width * (1.0 + off @ right / half)
    return round(0.5 * picture.height - 0.5 * picture.width * (off @ up / half)), round(column)


def seen(scene, positions, place):
    """(3,) the light from a place (d,) [m]."""
    return drawn(scene, positions)[pixel_of(scene, positions, place)]


def is_orange(light):
    return light[..., 0] > 1.5 * light[..., 2]


def is_blue(light):
    return light[..., 2] > 1.5 * light[..., 0]


FRONT = {"camera": [0.4, 0.25, 3.0], "look_at": [0.4, 0.25, 0.2]}
COLUMN = {2: lattice([0.0, 0.0], [0.2, 0.3]), 3: lattice([0.0] * 3, [0.2, 0.3, 0.4])}


def test_a_solid_in_the_plane_has_its_colour_where_it_is():
    scene = scene_of(2, PILLAR, picture={"width": 480, "height": 320})
    image = drawn(scene, COLUMN[2])
    row, column = pixel_of(scene, COLUMN[2], (0.4, 0.2))
    np.testing.assert_allclose(image[row, column], ORANGE, atol=0.02)
    x, y = painter(scene, COLUMN[2]).stage.pixels
    off = np.maximum(np.abs(x - 0.4) - 0.05, np.abs(y - 0.2) - 0.2)
    assert is_orange(image)[off < -0.005].all() and not is_orange(image)[off > 0.005].any()


def test_what_is_spilt_in_the_plane_takes_no_room():
    """The grid of the fluid ends with the picture: else it would have 10^12 nodes here."""
    scene, spilt = scene_of(2, PILLAR), [[0.1, -1e9], [3.0, 0.1]]
    np.testing.assert_allclose(drawn(scene, [*COLUMN[2], *spilt]), drawn(scene, COLUMN[2]), atol=1e-12)
    assert not is_blue(drawn(scene, spilt)).any()


def test_a_solid_in_space_has_its_colour_where_it_is():
    scene = scene_of(3, BALL, picture=FRONT)
    image = is_orange(drawn(scene, COLUMN[3]))
    row, column = pixel_of(scene, COLUMN[3], (0.4, 0.2, 0.2))
    radius = pixel_of(scene, COLUMN[3], (0.5, 0.2, 0.2))[1] - column
    rows, columns = np.mgrid[:160, :240]
    off = np.hypot(rows - row, columns - column)
    assert radius > 10 and image[off < radius - 2].all()
    assert not image[(off > radius + 2) & (rows < row)].any()  # below it the floor shows its image


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_solid_hides_what_is_behind_it(dimension):
    behind = lattice([0.35, 0.1, 0.0][:dimension], [0.45, 0.3, 0.1][:dimension], 0.04)
    place, positions = (0.4, 0.2, 0.25)[:dimension], np.concatenate([COLUMN[dimension], behind])
    picture = FRONT if dimension == 3 else {}
    with_it, without = scene_of(dimension, PILLAR, picture=picture), scene_of(dimension, picture=picture)
    assert is_blue(seen(without, positions, place)) and is_orange(seen(with_it, positions, place))


def test_a_solid_is_seen_through_fluid():
    before = np.concatenate([COLUMN[3], lattice([0.3, 0.0, 0.3], [0.5, 0.3, 0.4])])
    scene = scene_of(3, PILLAR, picture=FRONT)
    wet, dry = seen(scene, before, (0.4, 0.15, 0.25)), seen(scene, before, (0.4, 0.38, 0.25))
    assert is_orange(dry) and wet[2] / wet[0] > 2.0 * dry[2] / dry[0]
    without = seen(scene_of(3, picture=FRONT), before, (0.4, 0.15, 0.25))
    assert without[1] > wet[1] + 0.1


def test_light_goes_no_further_than_to_a_solid(monkeypatch):
    """However far behind its sides fluid goes on, what is before them looks the same."""
    before, light = np.concatenate([COLUMN[3], lattice([0.3, 0.0, 0.25], [0.5, 0.3, 0.4])]), []
    for depth in (1.0, 0.1):
        monkeypatch.setattr("cortado.pictures.tracing.space.DEPTHS", (depth,))
        light.append(seen(scene_of(3, PILLAR, picture=FRONT), before, (0.4, 0.15, 0.25)))
    np.testing.assert_allclose(light[0], light[1], atol=0.004)


@pytest.mark.parametrize(("dimension", "place"), [(2, (0.0, -9.0, 0.0)), (3, (0.0, 0.0, -0.7))])
def test_a_solid_that_is_not_seen_changes_no_bit(dimension, place):
    """Far below a closed container, or behind it: what draws solids draws the rest as it is drawn without any."""
    away = {**PILLAR, **{end: (np.array(PILLAR[end]) + place).tolist() for end in ("lower", "upper")}}
    images = [drawn(scene_of(dimension, *solids), COLUMN[dimension]) for solids in ((), (away,))]
    np.testing.assert_array_equal(images[0], images[1])


def test_fluid_touches_a_solid_without_a_gap():
    scene = scene_of(2, PILLAR, picture={"width": 480, "height": 320})
    image = drawn(scene, lattice([0.0, 0.0], [0.35, 0.3]) - (0.01, 0.0))
    row, column = pixel_of(scene, COLUMN[2], (0.35, 0.15))
    beside = image[row - 30 : row + 30, column - 12 : column + 12]
    assert beside.min(axis=2).max() < 0.4  # neither paper nor the inside of the container


@pytest.mark.parametrize(
    ("flush", "shift"), [({}, 0.0), ({"lower": [0.35, 0.0, 0.3], "upper": [0.45, 0.4, 0.4]}, 0.013)]
)
def test_a_side_in_a_wall_does_not_flicker(flush, shift):
    """The side of a pillar that stands on the floor, and lies in a pane of the container: it is of one colour, whatever
    the camera, though the wall, the floor and fluid that touches it are as far off as the side."""
    around = np.concatenate([lattice([0.0, 0.0, 0.0], [0.35, 0.3, 0.4]), lattice([0.45, 0.0, 0.0], [0.6, 0.3, 0.4])])
    picture = {"camera": [0.4 + shift, 0.25 + shift, 3.0], "look_at": [0.4, 0.25, 0.2], "transparency": 0.0}
    scene = scene_of(3, {**PILLAR, **flush}, picture=picture)
    if not flush:
        around = COLUMN[3]
    image, front = drawn(scene, around), 0.4 if flush else 0.25
    (bottom, left), (top, right) = (pixel_of(scene, around, (x, y, front)) for x, y in ((0.36, 0.01), (0.44, 0.39)))
    side = image[top:bottom, left:right]
    assert side.size > 1000 and is_orange(side).all()
    assert np.abs(np.diff(side, axis=0)).max() < 0.05 and np.abs(np.diff(side, axis=1)).max() < 0.05


def test_a_solid_is_cut_at_the_walls_of_a_closed_container():
    through = {**PILLAR, "lower": [0.5, 0.1, 0.1], "upper": [0.9, 0.3, 0.3]}
    for d, picture in ((3, {"camera": [0.6, 0.2, 3.0], "look_at": [0.6, 0.2, 0.2]}), (2, {})):
        scene = scene_of(d, through, picture=picture)
        image = is_orange(drawn(scene, COLUMN[d]))
        row, wall = pixel_of(scene, COLUMN[d], (0.6, 0.2, 0.3)[:d])
        assert image[row, wall - 10 : wall - 2].all() and not image[row, wall + 2 :].any()


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_tank_shows_what_is_in_it(dimension):
    """As a container of the same shape does."""
    tank, container = scene_of(dimension, CAVITY, container={"shape": "none"}), scene_of(dimension)
    for scene in (tank, container):
        assert is_blue(seen(scene, COLUMN[dimension], (0.1, 0.1, 0.4)[:dimension]))
    alike = np.abs(drawn(tank, COLUMN[dimension]) - drawn(container, COLUMN[dimension])).max(axis=2)
    assert np.mean(alike > 0.1) < 0.02


def test_fluid_ends_at_the_sides_of_a_tank():
    turned = {**CAVITY, "rotation": [0.0, 0.0, 0.3]}
    scene = scene_of(3, turned, container={"shape": "none"}, picture={"transparency": 0.0, **FRONT})
    (shown,) = shown_solids(scene)
    full = shown.position + lattice([-0.3, -0.25, -0.2], [0.3, 0.05, 0.2]) @ shown.turn.T
    image = is_blue(drawn(scene, full))
    cavity = np.array([pixel_of(scene, full, shown.position + shown.turn @ (x, -0.1, 0.2)) for x in (-0.3, 0.3)])
    (row, left), (other, right) = cavity
    slope = (other - row) / (right - left)
    on_it = [image[round(row + slope * (column - left)), column] for column in range(left - 15, right + 15)]
    assert np.flatnonzero(on_it).min() == pytest.approx(15, abs=2)
    assert np.flatnonzero(on_it).max() == pytest.approx(15 + right - left, abs=2)


def test_a_transparent_solid_lets_light_through():
    behind = np.concatenate([COLUMN[3], lattice([0.3, 0.1, 0.0], [0.5, 0.3, 0.1])])
    place, light = (0.4, 0.2, 0.25), []
    for clear in (0.0, 0.5, 1.0):
        scene = scene_of(3, {**PILLAR, "transparency": clear}, picture={"transparency": 0.0, **FRONT})
        light.append(seen(scene, behind, place))
    assert is_orange(light[0]) and is_blue(light[2])
    red = [float(one[0]) for one in light]
    assert red[1] == pytest.approx(0.5 * (red[0] + red[2]), abs=0.15 * (red[0] - red[2]))
    plane = [seen(scene_of(2, {**PILLAR, "transparency": c}), COLUMN[2], (0.4, 0.2)) for c in (0.0, 0.5)]
    assert plane[1][2] > plane[0][2] + 0.2


def test_fluid_in_a_cup_of_glass_is_cut_at_its_inside():
    """Also behind its side, where mirror images of particles are, no fluid is seen beyond the inner radius."""
    glass, water = {**CUP, "transparency": 1.0}, lattice([0.1, 0.05, 0.0], [0.5, 0.3, 0.4], 0.04)
    water = water[np.hypot(water[:, 0] - 0.3, water[:, 2] - 0.2) < 0.19]
    picture = {"camera": [0.3, 0.2, 30.0], "look_at": [0.3, 0.2, 0.2], "field_of_view": 1.6, "transparency": 0.0}
    scene = scene_of(3, glass, container={"shape": "none"}, picture=picture)
    row, middle = pixel_of(scene, water, (0.3, 0.15, 0.2))
    reach = pixel_of(scene, water, (0.5, 0.15, 0.2))[1] - middle
    blue = np.flatnonzero(is_blue(drawn(scene, water)[row]))
    assert reach > 20 and blue.max() - middle == pytest.approx(reach, abs=4)
    assert middle - blue.min() == pytest.approx(reach, abs=4)


def shadow_of(stage, solids):
    """(nodes, nodes, 3) the light that solids leave on the floor."""
    shadow = FloorShadow(stage, BandLauncher(wp.get_device("cpu")))
    SolidSurfaces(stage, "cpu").cast(shadow, solids)
    return shadow.light.numpy()


def test_solids_cast_a_shadow_on_the_floor():
    stage = Stage.of(scene_of(3, BALL), COLUMN[3])
    light = shadow_of(stage, stage.solids)
    assert 0.1 < light.min() < 0.5 and light[0, 0].min() == 1.0
    (ball,) = stage.solids
    moved = shadow_of(stage, [replace(ball, position=ball.position - (0.2, 0.0, 0.0))])
    places = [np.array(np.nonzero(one[..., 0] < 0.6)).mean(axis=1) for one in (light, moved)]
    cell = 2.0 * REACH * stage.size / (NODES - 1)
    np.testing.assert_allclose((places[0] - places[1]) * cell, [0.2, 0.0], atol=cell)
    clear = Stage.of(scene_of(3, {**BALL, "transparency": 1.0}), COLUMN[3])
    assert shadow_of(clear, clear.solids).min() == 1.0


def test_a_solid_lies_in_the_shadow_of_another():
    roof = {**PILLAR, "name": "roof", "lower": [0.0, 0.42, 0.0], "upper": [0.6, 0.48, 0.4]}
    scenes = scene_of(3, PILLAR, picture=FRONT), scene_of(3, PILLAR, roof, picture=FRONT)
    bright, dark = (seen(scene, COLUMN[3], (0.4, 0.2, 0.25))[0] for scene in scenes)
    assert 0.1 < dark < 0.85 * bright


def test_a_solid_comes_again_with_every_period():
    """One that leaves on the right comes in on the left."""
    tables = {"container": box([0.0, 0.0], [0.6, 0.5], periodic=[True, False]), "fluid": [box([0.1, 0.0], [0.3, 0.3])]}
    scene = scene_of(2, {**PILLAR, "lower": [0.55, 0.1], "upper": [0.65, 0.3]}, **tables)
    water = lattice([0.1, 0.0], [0.3, 0.3])
    for x in (0.03, 0.57):
        assert is_orange(seen(scene, water, (x, 0.2)))
    assert len(shown_solids(scene)) == 2


@pytest.mark.parametrize("dimension", [2, 3])
def test_solids_are_drawn_in_their_poses_from_one_place(dimension):
    """Of a solid that moves, without a container: where it will be is in the picture from the start."""
    pose = {"position": [1.5, 0.4, 0.2], "rotation": [0.0, 0.0, 1.2] if dimension == 3 else 1.2}
    before, after = (scene_of(dimension, PILLAR | own, container={"shape": "none"}) for own in ({}, pose))
    positions = COLUMN[dimension]
    artist, colours = painter(before, positions, poses=[after]), colours_of(before, None, len(positions))
    images = [artist.image(positions, colours, pose) for pose in (None, before, after)]
    np.testing.assert_array_equal(images[0], images[1])
    far = painter(after, positions, poses=[before]).image(positions, colours)
    np.testing.assert_array_equal(images[2], far)
    there = [np.argwhere(is_orange(image)).mean(axis=0) for image in (images[0], images[2])]
    assert there[1][1] - there[0][1] > 0.4 * 240 and (is_orange(images[0]) & is_orange(images[2])).sum() == 0


@pytest.mark.parametrize("table", SHAPES, ids=lambda table: table["shape"])
def test_a_mesh_is_closed_smooth_and_fine(table):
    far = {"container": {"shape": "none"}, "fluid": [box([2.0] * 3, [2.2] * 3)]}
    (shown,) = shown_solids(scene_of(3, table, **far))
    faces = shown.shape.faces(0.02)
    mesh = SolidMesh.of(faces, 0.03)
    a, b, c = mesh.points[mesh.triangles].transpose(1, 0, 2)
    places = np.unique(np.rint(mesh.points * 1e7), axis=0, return_inverse=True)[1].reshape(-1)[mesh.triangles]
    sides = places[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    there, back = (np.unique(one, axis=0, return_counts=True) for one in (sides, sides[:, ::-1]))
    np.testing.assert_array_equal(there[0], back[0])  # triangles on either hand of a side turn the other way
    assert (there[1] == 1).all()
    lengths = [np.linalg.norm(b - a, axis=1), np.linalg.norm(c - b, axis=1), np.linalg.norm(a - c, axis=1)]
    assert np.max(lengths) <= 2.0**0.5 * 0.03
    x, y, z = faces.vertices[faces.corners].transpose(1, 0, 2)
    volumes = [np.einsum("tk,tk->", one, np.cross(two, three)) / 6.0 for one, two, three in ((a, b, c), (x, y, z))]
    assert volumes[0] == pytest.approx(volumes[1], rel=1e-9) and volumes[0] > 0.0
    flat = np.cross(b - a, c - a)
    flat /= np.linalg.norm(flat, axis=1)[:, None]
    assert np.einsum("tck,tk->tc", mesh.normals[mesh.triangles], flat).min() > 0.9
    off = np.abs(shown.shape.distance(mesh.points + 0.01 * mesh.normals) - 0.01)
    assert np.mean(off < 0.002) > 0.97  # normals are those of the solid, not of its faces
    assert table is CUP or (off < 0.002).all()  # in which a side goes on along another


def test_edges_are_found_where_a_solid_is_sharp():
    stage = scene_of(3, PILLAR, BALL)
    box, ball = (SolidMesh.of(one.shape.faces(0.02), 0.03) for one in shown_solids(stage))
    assert (ball.from_edges == FAR).all()
    a, b, c = box.points[box.triangles].transpose(1, 0, 2)
    middle, half = (a + b + c) / 3.0, np.array([0.05, 0.2, 0.05])
    from_sides = half - np.abs(middle)
    wanted = np.sort(from_sides, axis=1)[:, 1]  # the first is how far it is from its own face: 0
    found = box.from_edges.mean(axis=2).min(axis=1)
    assert (found >= wanted - 1e-12).all() and np.mean(found < wanted + 1e-12) > 0.8


def images_of(points, table, **changes):
    scene = scene_of(len(points[0]), {**table, **changes}, container={"shape": "none"})
    return mirrored(np.asarray(points, dtype=float), shown_solids(scene), 0.9 * 0.05, 0.05)


def test_fluid_is_mirrored_behind_sides_and_corners():
    beside, of = images_of([[0.33, 0.2], [0.1, 0.2]], {**PILLAR, "upper": [0.55, 0.4, 0.25]})
    np.testing.assert_allclose(beside, [[0.37, 0.2]])
    assert of.tolist() == [0]
    corner, of = images_of([[0.02, 0.03]], CAVITY)
    assert {tuple(np.round(one, 9)) for one in corner} == {(-0.02, 0.03), (0.02, -0.03), (-0.02, -0.03)}
    assert of.tolist() == [0, 0, 0]
    edge, _ = images_of([[0.02, 0.03, 0.01]], CAVITY)
    assert len(edge) == 7


def test_thin_solids_hide_what_is_mirrored_behind_them():
    """Fluid is drawn some 0.7 spacings beyond particles."""
    solids = shown_solids(scene_of(2, {**PILLAR, "upper": [0.4, 0.4]}))
    for spacing in (0.02, 0.05, 0.1):
        found, _ = mirrored(np.array([[0.335, 0.2]]), solids, 0.9 * spacing, spacing)
        assert len(found) == 0 if spacing == 0.1 else 0.0 < found[0, 0] - 0.35 <= 0.015 + 1e-12


def test_outlines_are_the_edges_and_the_cuts_of_solids():
    assert solid_outline(scene_of(2)).shape == (0, 2, 2) and solid_outline(scene_of(3)).shape == (0, 2, 3)
    turned = scene_of(2, {**PILLAR, "rotation": 0.4})
    (shown,) = shown_solids(turned)
    wanted = shown.position + corners(np.array([-0.05, -0.2]), np.array([0.05, 0.2])) @ shown.turn.T
    found = np.unique(np.round(solid_outline(turned).reshape(-1, 2), 9), axis=0)
    np.testing.assert_allclose(found, np.unique(np.round(wanted, 9), axis=0))
    assert solid_outline(scene_of(3, PILLAR)).shape == (12, 2, 3)
    circles = solid_outline(scene_of(3, BALL)) - np.array([0.4, 0.2, 0.2])
    np.testing.assert_allclose(np.linalg.norm(circles, axis=2), 0.1, atol=1e-3)
    assert (np.abs(circles).min(axis=2) < 1e-9).all()  # of three great circles
    scene = scene_of(3, PILLAR)
    np.testing.assert_array_equal(outline(scene), np.concatenate([container_outline(scene), solid_outline(scene)]))


def test_figures_and_views_have_the_lines_of_solids(tmp_path):
    images, views = [], []
    for scene in (scene_of(2, PILLAR), scene_of(2)):
        extent, lines = scene.container.extent(), [solid_outline(scene)]
        path = particles([COLUMN[2]], ["now"], tmp_path / "a.png", container=extent, lines=lines)
        images.append(cortado.pictures.read_picture(path))
        views.append(scene_view(scene, {"run": [cortado.Simulation(scene).run(1)[0]]}, [0.0]))
    assert images[0].shape == images[1].shape and 1e-4 < (images[0] != images[1]).any(axis=2).mean() < 0.05
    assert views[0].count("[[") >= views[1].count("[[") and len(views[0]) > len(views[1])
