"""Meshes as solids: distances against closed forms, and a sentence for each file that is none."""

import warnings
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from bad_scenes import assert_one_sentence, one_sentence
from cortado.discretise.mesh import Mesh
from cortado.discretise.mesh_files import mesh_in_file, read_mesh, read_triangles
from cortado.discretise.primitives import Box, Round
from cortado.discretise.solid import Hollow, Mass, Placed
from cortado.discretise.solid_walls import surface_feet, surface_points
from cortado.errors import CortadoWarning, InputError
from cortado.scene.solid_shapes import MeshSolid

MAJOR, MINOR = 0.25, 0.1
SPACING, SUPPORT = 0.05, 0.1
ROOM = (np.zeros(3), np.ones(3))
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])


def solid(mesh: trimesh.Trimesh) -> Mesh:
    return Mesh(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64))


def torus(around: int = 90, across: int = 40) -> trimesh.Trimesh:
    return trimesh.creation.torus(MAJOR, MINOR, major_sections=around, minor_sections=across)


def from_torus(points: np.ndarray) -> np.ndarray:
    return np.hypot(np.hypot(points[:, 0], points[:, 1]) - MAJOR, points[:, 2]) - MINOR


def box(lower, upper) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[lower, upper])


def joined(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.util.concatenate(meshes)


def turned_over(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, np.asarray(mesh.faces)[:, ::-1], process=False)


def written(folder: Path, mesh: trimesh.Trimesh, name: str = "mesh.stl") -> str:
    mesh.export(folder / name)
    return str(folder / name)


def read(path: str, scale: float = 1.0, container=ROOM, support: float = SUPPORT) -> Mesh:
    return read_mesh(path, scale, SPACING, support, container)


def quietly_read(path: str) -> Mesh:
    with warnings.catch_warnings():
        warnings.simplefilter("error", CortadoWarning)
        return read(path, support=SPACING)


@contextmanager
def told_of(words: str):
    with pytest.warns(CortadoWarning, match=words) as told:
        yield
    assert_one_sentence(str(told[0].message))


def cloud(count: int = 4000, reach: float = 0.6) -> np.ndarray:
    return np.random.default_rng(5).uniform(-reach, reach, size=(count, 3))


def test_a_box_of_triangles_is_a_box():
    half, points = np.array([0.2, 0.3, 0.1]), cloud()
    mesh, same = solid(box(-half, half)), Box(half)
    position = np.array([0.1, -0.2, 0.05])
    for one, other in ((mesh, same), (Placed(mesh, position, TURN), Placed(same, position, TURN))):
        np.testing.assert_allclose(one.distance(points), other.distance(points), atol=1e-15)
        np.testing.assert_allclose(one.nearest(points), other.nearest(points), atol=1e-15)
        np.testing.assert_allclose(one.outward(points), other.outward(points), atol=1e-10)
        np.testing.assert_allclose(one.extent(), other.extent(), atol=1e-15)
    inside = np.abs(points) < half
    assert 50 < inside.all(axis=1).sum() < 3950
    np.testing.assert_array_equal(mesh.holds(points), inside.all(axis=1))


@pytest.mark.parametrize(("subdivisions", "error"), [(2, 1.7e-2), (4, 1.1e-3)])
def test_a_ball_of_triangles_is_within_its_sphere(subdivisions, error):
    points, sphere = cloud(), Round(np.zeros(3), 0.4)
    found = solid(trimesh.creation.icosphere(subdivisions, 0.4)).distance(points) - sphere.distance(points)
    assert found.min() > -1e-12 and error / 4 < found.max() < error


def test_a_torus_has_its_distances_nearest_points_and_hole():
    points, mesh = cloud(), solid(torus(500, 200))
    exact = from_torus(points)
    np.testing.assert_allclose(mesh.distance(points), exact, atol=3e-5)
    assert mesh.distance(np.zeros((1, 3)))[0] > 0.14
    feet = mesh.nearest(points)
    np.testing.assert_allclose(from_torus(feet), 0.0, atol=3e-5)
    np.testing.assert_allclose(np.linalg.norm(points - feet, axis=1), np.abs(mesh.distance(points)), atol=1e-15)
    bounded = mesh.distance_up_to(points, 0.05)
    np.testing.assert_array_equal(bounded, np.clip(mesh.distance(points), -0.05, 0.05))


def test_points_beside_corners_edges_and_columns_of_vertices_have_the_right_sign():
    """Rays that find what is inside go through vertices and along edges here."""
    mesh = solid(joined(box([-0.2] * 3, [0.2] * 3), trimesh.creation.icosphere(3, 0.1).apply_translation([0.5, 0, 0])))
    axis = np.linspace(-0.4, 0.7, 45)
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    ball = np.linalg.norm(points - np.array([0.5, 0, 0]), axis=1) - 0.1
    exact = np.minimum(Box(np.full(3, 0.2)).distance(points), ball)
    clear = np.abs(exact) > 1e-3
    np.testing.assert_array_equal(mesh.holds(points)[clear], exact[clear] < 0.0)


def test_points_in_the_planes_of_upright_faces_have_the_right_sign():
    """Seen along a ray these faces are lines, and round-off may find a ray within them, wherever it begins."""
    angles = 2.0 * np.pi * np.arange(30) / 30
    rim = 0.3 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    upright = trimesh.creation.extrude_triangulation(
        np.append(rim, [[0.0, 0.0]], axis=0), [[k, (k + 1) % 30, 30] for k in range(30)], 0.5
    )
    finer, edges, random = upright.subdivide().subdivide(), np.roll(rim, -1, axis=0) - rim, np.random.default_rng(3)
    vertices = np.array(finer.vertices)
    for start, edge in zip(rim, edges, strict=True):  # moved along the upright faces that they are in
        along = (vertices[:, :2] - start) @ edge / (edge @ edge)
        off = np.linalg.norm(vertices[:, :2] - start - along[:, None] * edge, axis=1)
        moved = (off < 1e-9) & (along > 1e-3) & (along < 1.0 - 1e-3)
        vertices[moved, :2] += random.uniform(-0.1, 0.1, size=(moved.sum(), 1)) * edge
    mesh = Mesh(vertices, np.array(finer.faces, dtype=np.int64))
    points = (rim + random.uniform(size=(300, 30, 1)) * edges).reshape(-1, 2)
    for height in (-2.0, -0.1, 0.6, 2.0):
        assert not mesh.holds(np.column_stack([points, np.full(len(points), height)])).any()


def test_the_number_of_cores_changes_no_bit(monkeypatch):
    mesh, points, found = solid(torus()), cloud(30_000), []
    for cores in ("1", "2"):
        monkeypatch.setenv("CORTADO_CORES", cores)
        found.append((mesh.distance(points), mesh.nearest(points), surface_points(mesh, 0.02, 0.0).points))
    for one, other in zip(*found, strict=True):
        assert one.tobytes() == other.tobytes()


def cup_with_a_handle() -> trimesh.Trimesh:
    """Up along z, 0.3 high and 0.2 in radius; its walls are 0.06 thick, and its handle is three bars that overlap."""
    profile = [[0.0, 0.0], [0.2, 0.0], [0.2, 0.3], [0.14, 0.3], [0.14, 0.06], [0.0, 0.06]]
    bars = [box([0.17, -0.03, z], [0.4, 0.03, z + 0.06]) for z in (0.05, 0.2)]
    return joined(trimesh.creation.revolve(profile, sections=64), *bars, box([0.34, -0.03, 0.05], [0.4, 0.03, 0.26]))


def test_a_cup_with_a_handle_is_one_solid(tmp_path):
    cup = read(written(tmp_path, cup_with_a_handle()), support=SPACING)
    points = np.array([[0, 0, 0.2], [0.17, 0, 0.1], [0, -0.17, 0.2], [0.3, 0, 0.155], [0.37, 0, 0.155], [0, 0, 0.03]])
    # in the cup; in its wall, where the handle is too, and elsewhere; in the hole of the handle; in it; in the bottom
    np.testing.assert_array_equal(cup.holds(points), [False, True, True, False, True, True])
    np.testing.assert_allclose(cup.distance(points[[0, 3, 4]]), [0.14, 0.04, -0.03], atol=2e-3)
    feet, _ = cup.own_feet(0.01)
    assert cup.distance(feet).min() > -1e-6  # none where bars go through the wall
    assert len(cup.parts) == 2  # the upright bar does not reach the cup


def test_boxes_that_overlap_or_touch_are_their_union(tmp_path):
    first, second = ([-0.3, -0.1, -0.1], [0.2, 0.1, 0.1]), ([0.05, -0.3, -0.2], [0.25, 0.2, 0.05])
    beside = ([0.2, -0.1, -0.1], [0.4, 0.05, 0.05])
    points = cloud()
    plate, bar = ([-0.4, -0.05, -0.4], [0.4, 0.05, 0.4]), ([-0.04, -0.5, -0.04], [0.04, 0.5, 0.04])
    for ends in ((first, second), (first, beside), (plate, bar)):
        mesh = quietly_read(written(tmp_path, joined(*(box(*end) for end in ends))))
        halves = [(np.array(end[1]) - end[0]) / 2 for end in ends]
        boxes = [Placed(Box(half), end[0] + half, np.eye(3)) for half, end in zip(halves, np.array(ends), strict=True)]
        distances, places = np.array([one.distance(points) for one in boxes]), [one.nearest(points) for one in boxes]
        np.testing.assert_allclose(mesh.distance(points), distances.min(axis=0), atol=1e-7)
        nearest = np.array(places)[distances.argmin(axis=0), np.arange(len(points))]
        np.testing.assert_allclose(mesh.nearest(points), nearest, atol=1e-7)


def test_where_bodies_touch_there_is_no_surface(tmp_path):
    first, second = box([-0.3, -0.1, -0.1], [0.2, 0.1, 0.1]), box([0.2, -0.1, -0.1], [0.5, 0.1, 0.1])
    across = trimesh.Trimesh(second.vertices * [-1, 1, 1] + [0.7, 0, 0], np.asarray(second.faces)[:, ::-1])
    for other in (second, across):  # whose triangles meet those of the first, or cross them
        mesh = quietly_read(written(tmp_path, joined(first, other)))
        feet, _ = mesh.own_feet(0.01)
        assert not (np.abs(feet - [0.2, 0.0, 0.0]) < [1e-3, 0.099, 0.099]).all(axis=1).any()
        assert len(feet) == pytest.approx(4 * 0.8 * 0.2 / 0.01**2 + 2 * 0.2**2 / 0.01**2, rel=0.01)
        assert mesh.holds(np.array([[0.1, 0.0, 0.0], [0.3, 0.0, 0.0]])).all()


def test_a_cavity_is_outside_and_what_is_in_it_inside(tmp_path):
    shell = joined(trimesh.creation.icosphere(3, 0.5), turned_over(trimesh.creation.icosphere(3, 0.35)))
    mesh = quietly_read(written(tmp_path, joined(shell, trimesh.creation.icosphere(3, 0.15))))
    assert not mesh.parts
    along = np.zeros((3, 3))
    along[:, 0] = [0.0, 0.25, 0.42]
    np.testing.assert_array_equal(mesh.holds(along), [True, False, True])


def test_a_body_within_another_is_told(tmp_path):
    path = written(tmp_path, joined(trimesh.creation.icosphere(3, 0.5), trimesh.creation.icosphere(3, 0.3)))
    with told_of("lies inside another one"):
        mesh = read(path)
    np.testing.assert_allclose(mesh.distance(np.zeros((1, 3))), -0.5, atol=5e-3)


PLANK = ([0.0, 0.0, 0.0], [0.8, 0.1, 0.2])
UNIONS = {  # boxes of a file, and boxes with signs that sum up to their union
    "nested": ([PLANK, ([0.6, 0.02, 0.05], [0.7, 0.08, 0.15])], [(1, PLANK)]),
    "touching": ([PLANK, ([0.8, 0.0, 0.0], [1.2, 0.1, 0.2])], [(1, ([0.0, 0.0, 0.0], [1.2, 0.1, 0.2]))]),
    "crossing": (
        [([-0.4, -0.05, -0.4], [0.4, 0.05, 0.4]), ([-0.04, -0.5, -0.04], [0.04, 0.2, 0.04])],
        [
            *((1, ([-0.4, -0.05, -0.4], [0.4, 0.05, 0.4])), (1, ([-0.04, -0.5, -0.04], [0.04, -0.05, 0.04]))),
            (1, ([-0.04, 0.05, -0.04], [0.04, 0.2, 0.04])),
        ],
    ),
    "three": (
        [PLANK, ([0.5, -0.2, 0.0], [0.6, 0.3, 0.2]), ([0.55, -0.1, 0.05], [0.9, 0.2, 0.15])],
        [
            *((1, PLANK), (1, ([0.5, -0.2, 0.0], [0.6, 0.0, 0.2])), (1, ([0.5, 0.1, 0.0], [0.6, 0.3, 0.2]))),
            *((1, ([0.6, -0.1, 0.05], [0.9, 0.2, 0.15])), (-1, ([0.6, 0.0, 0.05], [0.8, 0.1, 0.15]))),
        ],
    ),
}


@pytest.mark.parametrize("name", UNIONS)
@pytest.mark.parametrize("turn", [np.eye(3), TURN], ids=["along the axes", "turned"])
def test_the_moments_of_bodies_are_those_of_their_union(tmp_path, name, turn):
    bodies, parts = UNIONS[name]
    mesh = joined(*(box(*ends) for ends in bodies))
    mesh.vertices = mesh.vertices @ turn.T
    mesh.export(tmp_path / "mesh.obj", digits=17)
    found = mesh_in_file(str(tmp_path / "mesh.obj")).mesh.moments()
    volumes = np.array([sign * np.prod(np.subtract(*ends[::-1])) for sign, ends in parts])
    middles = np.array([np.mean(ends, axis=0) for _, ends in parts])
    centre = volumes @ middles / volumes.sum()
    second = sum(
        volume * (np.diag(np.subtract(*ends) ** 2) / 12.0 + np.outer(middle - centre, middle - centre))
        for volume, middle, (_, ends) in zip(volumes, middles, parts, strict=True)
    )
    assert found.volume == pytest.approx(volumes.sum(), rel=1e-12)
    np.testing.assert_allclose(found.centre, turn @ centre, atol=1e-12)
    np.testing.assert_allclose(found.second, turn @ second @ turn.T, atol=1e-12 * np.abs(second).max())


FAR = {"1e5 m": [1e5, 1e5, 1e5], "on a map": [512345.0, 5412345.0, 100.0]}


def test_far_from_the_origin_a_solid_is_as_near_it(tmp_path):
    shape, places = joined(torus(30, 16), box([0.2, -0.2, -0.2], [0.6, 0.2, 0.2])), []
    for name, shift in (("near", np.zeros(3)), ("far", np.array(FAR["on a map"]))):
        far = trimesh.Trimesh(shape.vertices + shift, shape.faces, process=False)
        far.export(tmp_path / f"{name}.obj", digits=12)
        path = str(tmp_path / f"{name}.obj")
        table = MeshSolid(name=name, shape="mesh", file=path, position=(0.0, 0.0, 0.0))
        own, points = table.own_solid(), cloud(500)
        mass = Mass.of(own)
        middle = MeshSolid(name=name, shape="mesh", file=path).middle() - shift
        places.append([middle, mass.volume, mass.inertia, own.distance(points), own.nearest(points)])
    for near, far in zip(*places, strict=True):
        np.testing.assert_allclose(far, near, atol=3e-9)


@pytest.mark.parametrize("name", ["ball.stl", "ball.glb"])
def test_a_file_of_float32_far_from_the_origin_is_a_sentence(tmp_path, name):
    ball = trimesh.creation.icosphere(3, 0.4)
    with one_sentence("far from the origin: move it before it is exported"):
        read(written(tmp_path, ball.copy().apply_translation(FAR["on a map"]), name))
    with told_of("far from the origin.*rounds its coordinates to 0.0078"):
        read(written(tmp_path, ball.copy().apply_translation(FAR["1e5 m"]), name), support=SPACING)


def quads(places: np.ndarray, flipped: bool = False) -> trimesh.Trimesh:
    """A surface through (rows, columns, 3) points, closed along both."""
    numbers, steps = np.arange(places.size // 3).reshape(places.shape[:2]), [(0, 0), (0, 1), (1, 1), (1, 0)]
    corners = [np.roll(numbers, (-i, -j), axis=(0, 1)) for i, j in (steps[::-1] if flipped else steps)]
    faces = np.stack(corners, axis=-1).reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return trimesh.Trimesh(places.reshape(-1, 3), faces, process=False)


def crossed_tube() -> trimesh.Trimesh:
    """A tube along a figure of eight, whose two branches go through one another in the middle."""
    t, angle = np.linspace(0, 2 * np.pi, 160, endpoint=False), np.linspace(0, 2 * np.pi, 24, endpoint=False)
    path = 0.4 * np.stack([np.sin(t), 0.5 * np.sin(2 * t), 0 * t], axis=1)
    along = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    aside, up = np.stack([-along[:, 1], along[:, 0], 0 * t], axis=1), np.array([0.0, 0.0, 1.0])
    circle = np.cos(angle)[:, None, None] * aside + np.sin(angle)[:, None, None] * up
    mesh = quads(path + 0.07 * circle)
    return mesh if mesh.volume > 0 else turned_over(mesh)


def test_a_mesh_that_crosses_itself_is_told_and_holds_what_it_goes_around_twice(tmp_path):
    path = written(tmp_path, crossed_tube())
    with told_of("crosses itself, for example at"):
        mesh = read(path)
    assert mesh.holds(np.zeros((1, 3))).all()
    feet, _ = mesh.own_feet(0.01)
    assert np.linalg.norm(feet, axis=1).min() > 0.06  # none in the middle, where the branches go through one another


@pytest.mark.parametrize("name", ["a.STL", "ascii.stl", "a.obj", "a.ply", "ascii.ply", "a.glb"])
def test_all_kinds_of_files_hold_the_same(tmp_path, name):
    mesh = torus(20, 12)
    kinds = {"ascii.stl": {"file_type": "stl_ascii"}, "ascii.ply": {"encoding": "ascii"}, "a.STL": {"file_type": "stl"}}
    mesh.export(tmp_path / name, **kinds.get(name, {}))
    found = mesh_in_file(str(tmp_path / name))
    assert found.mesh.triangles.shape == mesh.faces.shape and found.left_out == 0 and not found.notes
    points = cloud(500)
    np.testing.assert_allclose(found.mesh.distance(points), solid(mesh).distance(points), atol=1e-6)


def test_bodies_are_where_the_scene_of_a_file_puts_them(tmp_path):
    mirrored = np.diag([-2.0, 1.0, 1.0, 1.0])
    mirrored[:3, 3] = [5.0, 0.0, 0.0]
    scene = trimesh.Scene([trimesh.creation.icosphere(3, 0.5)])
    scene.add_geometry(box([0, 0, 0], [1, 2, 3]), transform=mirrored)
    scene.export(str(tmp_path / "two.glb"))
    for name, content in trimesh.exchange.gltf.export_gltf(scene).items():
        (tmp_path / name).write_bytes(content)
    for name in ("two.glb", "model.gltf"):
        found = mesh_in_file(str(tmp_path / name)).mesh
        np.testing.assert_allclose(found.extent(), [[-0.5, -0.5, -0.5], [5.0, 2.0, 3.0]], atol=1e-6)
        inside = found.holds(np.array([[4.0, 1.0, 1.0], [0.0, 0.0, 0.0], [5.5, 1.0, 1.0], [2.0, 1.0, 1.0]]))
        np.testing.assert_array_equal(inside, [True, True, False, False])


def test_vertices_that_float32_rounds_apart_are_one(tmp_path):
    ball = trimesh.creation.icosphere(3, 0.4)
    corners = np.array(ball.vertices)[ball.faces].reshape(-1, 3)
    loose = corners + np.random.default_rng(1).uniform(-1e-8, 1e-8, size=corners.shape)
    assert len(np.unique(loose, axis=0)) > 2 * len(ball.vertices)
    path = written(tmp_path, trimesh.Trimesh(loose, np.arange(len(loose)).reshape(-1, 3), process=False), "loose.ply")
    found = quietly_read(path)
    assert found.vertices.shape == ball.vertices.shape


def test_triangles_without_area_or_that_come_twice_are_left_out_and_counted(tmp_path):
    ball = trimesh.creation.icosphere(2, 0.4)
    faces = np.concatenate([ball.faces, ball.faces[:3], [[0, 0, 1], [5, 6, 5]]])
    found = mesh_in_file(written(tmp_path, trimesh.Trimesh(ball.vertices, faces, process=False), "more.obj"))
    assert found.left_out == 5 and len(found.mesh.triangles) == len(ball.faces)


def test_a_mesh_is_scaled_and_read_again_when_its_file_changes(tmp_path):
    path = written(tmp_path, torus().apply_scale(1000.0))
    np.testing.assert_allclose(read(path, 0.001).extent(), solid(torus()).extent(), rtol=1e-6)
    first = read(written(tmp_path, torus(), "a.ply")).extent()
    second = read(written(tmp_path, torus().apply_scale(0.9), "a.ply")).extent()
    np.testing.assert_allclose(np.multiply(first, 0.9), second, rtol=1e-6)


@pytest.mark.parametrize("name", ["torus", "box", "ball"])
@pytest.mark.parametrize("depth", [0.0, 0.5, -0.5])
def test_points_of_a_surface_are_even(name, depth):
    spacing = 0.025
    makers = {"torus": torus(200, 80), "box": box([-0.2, -0.3, -0.1], [0.2, 0.3, 0.1])}
    mesh = solid(makers[name] if name in makers else trimesh.creation.icosphere(5, 0.3))
    found = surface_points(mesh, spacing, depth * spacing)
    np.testing.assert_allclose(mesh.distance(found.points).min(), -depth * spacing, atol=0.3 * spacing)
    if depth == 0.0:
        assert found.shares.sum() * spacing**2 == pytest.approx(mesh.areas().sum(), rel=0.01)
    nearest = cKDTree(found.points).query(found.points, k=2)[0][:, 1]
    assert nearest.min() > 0.6 * spacing
    feet, away = surface_feet(mesh, spacing / 5)
    surface = feet - depth * spacing * away
    surface = surface[np.abs(mesh.distance(surface) + depth * spacing) < 1e-3 * spacing]
    assert cKDTree(found.points).query(surface)[0].max() < spacing
    assert 0.85 < found.shares.mean() < 1.4


def test_feet_stand_for_equal_areas_and_point_outwards():
    mesh = solid(box([-0.2, -0.3, -0.1], [0.2, 0.3, 0.1]))
    feet, outward = mesh.own_feet(0.01)
    assert len(feet) == 8800
    face = np.argmax(np.abs(outward), axis=1)
    np.testing.assert_allclose(np.bincount(face) / 8800, np.array([0.24, 0.16, 0.48]) / 0.88, atol=1e-3)
    np.testing.assert_allclose(mesh.distance(feet + 0.01 * outward), 0.01, atol=1e-12)
    np.testing.assert_allclose(Hollow(mesh).own_feet(0.01)[1], -outward)
    placed, turned = Placed(mesh, np.array([1.0, 2.0, 3.0]), TURN).own_feet(0.01)
    np.testing.assert_allclose(placed, [1.0, 2.0, 3.0] + feet @ TURN.T, atol=1e-14)
    np.testing.assert_allclose(turned, outward @ TURN.T, atol=1e-14)


def half_turned(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    faces = np.array(mesh.faces)
    faces[7] = faces[7, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def with_a_fin() -> trimesh.Trimesh:
    fin = trimesh.Trimesh([[0.2, 0.2, 0.2], [0.2, 0.2, -0.2], [0.4, 0.4, 0.0]], [[0, 1, 2]])
    return joined(box([-0.2] * 3, [0.2] * 3), fin)


def figure_of_eight() -> trimesh.Trimesh:
    """Turned around an axis: one of its two loops is inside out."""
    t, around = np.linspace(0, 2 * np.pi, 60, endpoint=False), np.linspace(0, 2 * np.pi, 80, endpoint=False)
    radius, height = 0.4 + 0.1 * np.sin(t), 0.1 * np.sin(2 * t)
    ring = np.stack([np.cos(around), np.sin(around)], axis=1)
    places = np.concatenate([radius[None, :, None] * ring[:, None], np.tile(height[:, None], (80, 1, 1))], axis=2)
    return quads(places, flipped=True)


SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
BALL = trimesh.creation.icosphere(3, 0.4)
BAD = {
    "a hole": (
        trimesh.Trimesh(BALL.vertices, BALL.faces[1:], process=False),
        r"is not closed.* 3 open edges, the first at \(.*in the file; close its holes",
    ),
    "a sheet": (
        trimesh.Trimesh(SQUARE, [[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]], process=False),
        "holds no volume: all of its 4 triangles",
    ),
    "normals inwards": (turned_over(BALL), r"^The normals of .* point inwards, .*all of its triangles over"),
    "a body inside out": (
        joined(BALL, turned_over(box([1, 1, 1], [1.3, 1.3, 1.3]))),
        r"1 of the 2 bodies of .* point inwards, for example at \(1",
    ),
    "a triangle turned": (half_turned(BALL), "inwards at some triangles.* change at 3 edges, the first at"),
    "a fin": (with_a_fin(), r"1 edge at which three triangles or more meet.* \(0.2, 0.2, 0\) in the file"),
    "a loop inside out": (figure_of_eight(), "of a part of .* point inwards"),
    "bodies that touch at an edge": (
        joined(box([0, 0, 0], [0.3, 0.3, 0.3]), box([0.3, 0.3, 0], [0.6, 0.6, 0.3])),
        r"an edge that more than two triangles share, at \(0.3, 0.3, 0.15\) in the file",
    ),
    "millimetres": (box([0, 0, 0], [300.0, 200.0, 200.0]), "300 times the container; .*millimetres: .*scale = 0.001"),
    "metres as millimetres": (box([0, 0, 0], [3e-4, 2e-4, 2e-4]), "less than a spacing, 0.05 m; .*larger scale than 1"),
    "too thin": (
        box([0, 0, 0], [0.5, 0.5, 0.01]),
        r"thinner than half a spacing, 0.025 m, at 9[67]% .* make it thicker",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_mesh_is_a_sentence_that_says_which_where_and_what_to_do(tmp_path, name):
    mesh, sentence = BAD[name]
    path = written(tmp_path, mesh)
    with one_sentence(sentence) as caught:
        read(path)
    assert repr(path) in str(caught.value)


def test_vertices_that_are_not_finite_and_files_that_cannot_be_meant_are_sentences(tmp_path):
    lost = box([-0.2] * 3, [0.2] * 3)
    lost.vertices[3, 1] = np.nan
    with one_sentence(r"1 vertex with coordinates that are not finite.* number \d+"):
        read(written(tmp_path, trimesh.Trimesh(lost.vertices, lost.faces, process=False), "nan.ply"))
    (tmp_path / "a.step").write_text("")
    (tmp_path / "line.obj").write_text("v 0 0 0\nv 1 0 0\nl 1 2\n")
    for call, name, trouble in [
        (read, "a.step", "does not end in one of .stl, "),
        (read, "none.stl", "No such file"),
        (read_triangles, "line.obj", "points or lines, but no triangles"),
    ]:
        with one_sentence(trouble):
            call(str(tmp_path / name))


def test_without_a_container_a_mesh_is_held_against_the_spacing(tmp_path):
    path = written(tmp_path, box([0, 0, 0], [600.0, 200.0, 200.0]))
    with pytest.raises(InputError, match="12,000 spacings; it looks like millimetres"):
        read(path, container=None)
    read(path, scale=0.001, container=None)


def test_what_is_thinner_than_the_support_and_sharp_edges_are_told_and_kept(tmp_path):
    with told_of(r"thinner than the support, 0.1 m, at 81% .* 0.06 m at"):
        read(written(tmp_path, box([0, 0, 0], [0.5, 0.5, 0.06])))
    wedge = [[0, 0, 0], [0.5, 0, 0], [0.5, 0, 0.3], [0, 0.5, 0], [0.5, 0.5, 0], [0.5, 0.5, 0.3]]
    with told_of("edges so sharp that it is thinner than half a spacing"):
        read(written(tmp_path, trimesh.convex.convex_hull(wedge)))


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".glb", ".gltf"])
@pytest.mark.parametrize(
    "content", [b"", b"rubbish\n\x00\xff" * 20, b"solid x\nendsolid x\n", b"v 0 0 0\nf 1 2 9\n", b"{}"]
)
def test_files_of_rubbish_are_a_sentence(tmp_path, suffix, content, capfd):
    (tmp_path / f"bad{suffix}").write_bytes(content)
    with one_sentence() as caught:
        read(str(tmp_path / f"bad{suffix}"))
    assert f"bad{suffix}" in str(caught.value)
    assert "is empty" in str(caught.value) if not content else "is empty" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("cut", [0.2, 0.9])
def test_files_that_are_cut_off_are_a_sentence(tmp_path, cut):
    for name in ("a.stl", "a.ply", "a.glb"):
        content = Path(written(tmp_path, box([0, 0, 0], [1, 1, 1]), name)).read_bytes()
        (tmp_path / f"cut_{name}").write_bytes(content[: int(cut * len(content))])
        with one_sentence("may be damaged"):
            read(str(tmp_path / f"cut_{name}"))


# ---- a large one -------------------------------------------------------------------------------------------------
