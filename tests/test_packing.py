"""Bodies of fluid that are round, turned, or fill a mesh or a polygon: their volume, outline, density and rest."""

import itertools
from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

import cortado
from cortado import Scene, SceneError, Simulation
from cortado.discretise import packing
from cortado.discretise.packing import PointsAround, Relaxation
from cortado.discretise.room import Region
from cortado.discretise.shapes import pairs_within
from cortado.discretise.smoothing import CUBIC_SPLINE
from cortado.discretise.solid import rotation_matrix
from cortado.discretise.walls import RestLattice
from cortado.scene import discrete_scene
from cortado.scene.discrete_scene import DiscreteScene, discretise
from scenes import bodies, box

SPACING = 0.05
DISC = {"shape": "sphere", "centre": [0.31, -0.2], "radius": 0.5}
BALL = {"shape": "sphere", "centre": [0.1, 0.2, 0.3], "radius": 0.5}
CYLINDER = {"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": 0.5, "height": 0.42}
CUP = {**CYLINDER, "height": 0.8}
AREA, VOLUME = np.pi * 0.25, np.pi * 0.25 * 0.42
POOL = {"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [1.0, 0.3, 1.0]}
TANK = {"shape": "box", "lower": [0.0, 0.0, 0.0], "upper": [1.0, 1.0, 1.0]}
COLUMN = {"shape": "cylinder", "base": [0.5, 0.3, 0.5], "radius": 0.22, "height": 0.4}
JET = {"shape": "cylinder", "base": [0.0, 0.5, 0.5], "radius": 0.3, "height": 1.0, "axis": "x"}
PIPE = {**TANK, "periodic": [True, False, False]}


def scene_of(dimension: int, fluid, container=None, kernel="cubic_spline", support=2.0) -> Scene:
    cut = {"spacing": SPACING, "kernel": kernel, "support": support}
    return bodies(dimension, fluid, container, viscosity=0.1, discretisation=cut)


def densities(found: DiscreteScene) -> np.ndarray:
    """(n,) over the rest density: all pairs within the support, across periods too, and walls with their weights."""
    kernel, support, fluid = found.kernel, found.lattice.support, found.fluid.positions
    turns = itertools.product(*[(0, -1, 1) if period else (0,) for period in found.periods])
    images = [np.array(turn) * found.periods for turn in turns]
    total = np.zeros(len(fluid))
    for points, weights in ((fluid, np.ones(len(fluid))), (found.walls.positions, found.walls.weights)):
        tree, repeated = cKDTree(np.concatenate([points + image for image in images])), np.tile(weights, len(images))
        for i, near in enumerate(tree.query_ball_point(fluid, support)):
            apart = np.linalg.norm(tree.data[near] - fluid[i], axis=1)
            total[i] += repeated[near] @ kernel.weight(apart, fluid.shape[1], support)
    return found.lattice.volume * total


def near_air(scene: Scene, found: DiscreteScene) -> np.ndarray:
    """(n,) whether a particle sees a place that is neither fluid nor behind a wall."""
    x, reach = found.fluid.positions, found.lattice.support
    ends = zip(x.min(axis=0) - reach, x.max(axis=0) + reach, strict=True)
    places = np.stack(np.meshgrid(*[np.arange(a, b, SPACING / 2) for a, b in ends]), axis=-1).reshape(-1, x.shape[1])
    empty = scene.container.region(scene.dimension).distance(places) < 0.0
    for fluid in scene.fluid:
        ends = (np.array(fluid.lower), np.array(fluid.upper)) if fluid.shape == "box" else None
        outside = fluid.distance(places, SPACING) if ends is None else Region.between(*ends).distance(places)
        empty &= outside > 0.0
    lower, lengths = scene.periods
    return np.isin(np.arange(len(x)), pairs_within(x, places[empty], reach, lower, lengths)[0])


CASES = {
    "disc": (2, [DISC], None, AREA),
    "ball": (3, [BALL], None, 4.0 / 3.0 * np.pi * 0.125),
    "cup that lies": (3, [CYLINDER | {"axis": "x"}], CUP | {"axis": "x"}, VOLUME),
    "full cup": (3, [CUP], CUP, np.pi * 0.25 * 0.8),
    "open cup": (3, [CYLINDER], CUP | {"lid": False}, VOLUME),
    "column on a pool": (3, [POOL, COLUMN], TANK, 0.3 + np.pi * 0.22**2 * 0.4),
    "jet through a period": (3, [JET], PIPE, np.pi * 0.09),
}


@cache
def discretised(case: str) -> tuple[Scene, DiscreteScene]:
    dimension, fluid, container, _ = CASES[case]
    scene = scene_of(dimension, fluid, container)
    return scene, discretise(scene)


@pytest.mark.parametrize("case", CASES)
def test_a_round_body_has_its_volume_and_the_rest_density(case):
    dimension, _, _, volume = CASES[case]
    scene, found = discretised(case)
    x = found.fluid.positions
    assert len(x) * SPACING**dimension == pytest.approx(volume, rel=0.01)
    seen, sees_air = densities(found), near_air(scene, found)
    assert seen.max() < 1.01 and seen[found.fluid.is_packed].max() < 1.0001
    assert np.count_nonzero(~sees_air) > 50 and seen[~sees_air].min() > 0.99
    i, j, distances = pairs_within(x, x, SPACING, *scene.periods)
    assert distances[i != j].min() > 0.7 * SPACING


@pytest.mark.parametrize(("kernel", "support"), [("wendland_c2", 2.5), ("cubic_spline", 3.0)])
def test_other_kernels(kernel, support):
    scene = scene_of(2, [DISC], None, kernel, support)
    found = discretise(scene)
    assert len(found.fluid.positions) * SPACING**2 == pytest.approx(AREA, rel=0.01)
    assert densities(found).max() < 1.0


@pytest.mark.parametrize("case", ["disc", "ball"])
def test_the_first_frame_of_a_drop_is_round(case):
    """No direction from the middle in which the outermost particles are far from the surface."""
    dimension, (body,), _, _ = CASES[case]
    x = discretised(case)[1].fluid.positions - body["centre"]
    radius = np.linalg.norm(x, axis=1)
    outer = x[radius > 0.5 - 0.95 * SPACING]
    directions = np.random.default_rng(1).normal(size=(400, dimension))
    on_surface = 0.5 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    assert cKDTree(outer).query(on_surface)[0].max() < 1.1 * SPACING
    assert radius.max() < 0.5 + 0.2 * SPACING


def test_fluid_in_a_round_cup_stays_at_its_height():
    """It sank by a tenth when it was filled with whole cells."""
    simulation = cortado.Simulation(scene_of(3, [CYLINDER | {"height": 0.4}], CUP))
    last = simulation.run(200, record_every=200).positions[-1]
    assert last[:, 1].mean() == pytest.approx(0.2, rel=0.01)


def test_packed_particles_are_the_same_every_time_and_few_move(monkeypatch):
    """What is deep in the body stays on the lattice."""
    for module, name in ((discrete_scene, "_settled"), (packing, "_packed")):  # which tests make once otherwise
        monkeypatch.setattr(module, name, getattr(module, name).__wrapped__)
    scene = scene_of(2, [DISC | {"radius": 1.0}])
    first, again = (discretise(scene).fluid.positions for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert first is not again and first.flags.writeable
    cells = (first - DISC["centre"]) / SPACING - 0.5
    deep = np.linalg.norm(first - DISC["centre"], axis=1) < 0.5
    np.testing.assert_allclose(cells[deep], cells[deep].round(), atol=1e-9)


def test_small_bodies_have_the_particles_that_fit():
    one = discretise(scene_of(3, [CYLINDER | {"radius": 0.025, "height": 0.05}])).fluid.positions
    np.testing.assert_allclose(one, [[0.0, 0.025, 0.0]], atol=1e-9)
    for radius in (0.04, 0.1, 0.14):
        found = discretise(scene_of(2, [DISC | {"radius": radius}])).fluid.positions
        assert abs(len(found) - np.pi * radius**2 / SPACING**2) <= 1.0
        assert np.isfinite(found).all()


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_round_solid_in_a_tank_leaves_layers_along_its_walls_whole(dimension):
    """There was a hole along the last wall before: all particles of flat faces counted as if they were round."""
    upper, middle = [1.2, 0.8, 0.4][:dimension], [0.43, 0.4, 0.2][:dimension]
    ball = {"name": "ball", "shape": "sphere", "centre": middle, "radius": 0.16}
    tank = {"shape": "box", "lower": [0.0] * dimension, "upper": upper}
    found = discretise(bodies(dimension, [tank], {**tank, "upper": [upper[0], 1.0, *upper[2:]]}, solid=[ball]))
    layers = np.bincount((found.fluid.positions[:, 0] / SPACING).astype(int), minlength=24)
    assert len(layers) == 24 and (layers[13:] == 16 * 8 ** (dimension - 2)).all()
    surface = {2: 2.0 * np.pi * 0.16, 3: 4.0 * np.pi * 0.16**2}[dimension]
    lacking = np.prod(upper) - surface * 0.16 / dimension - layers.sum() * SPACING**dimension
    assert abs(lacking) < 0.15 * surface * SPACING


def around(points: np.ndarray, air: tuple[int, int], lengths: np.ndarray, reach: float) -> PointsAround:
    lattice = RestLattice(CUBIC_SPLINE, 0.1, 0.2, len(lengths))
    weights = np.where(np.arange(len(points)) < 100, 1.0, 0.7)
    return PointsAround(lattice, points, weights, air, lengths, reach)


@pytest.mark.parametrize("dimension", [2, 3])
def test_derivatives_of_densities_and_distances(dimension):
    """Against differences, and the product with the transpose against that with the derivatives."""
    generator = np.random.default_rng(4)
    points, free = generator.uniform(size=(300, dimension)), np.arange(100) % 3 > 0
    blind, lengths = np.arange(100) % 2 == 0, np.array([0.0, 1.0, 0.0])[:dimension]

    def linearised(moves: np.ndarray | float = 0.0) -> Relaxation:
        moved = points.copy()
        moved[:100] += moves
        made = Relaxation(around(moved, (100, 200), lengths, 0.25), blind, free)
        made.linearise(0.09)
        return made

    moves = free[:, None] * generator.normal(size=(100, dimension))
    found, step = linearised(), 1e-6
    changes, approaches = found.multiply(np.pad(moves, [(0, 0), (0, 3 - dimension)]))
    forward, back = linearised(step * moves), linearised(-step * moves)
    for product, after, before in ((changes, forward.sums, back.sums), (approaches, forward.distances, back.distances)):
        quotient = (after - before) / (2.0 * step)
        np.testing.assert_allclose(product, quotient, atol=1e-7 * np.abs(quotient).max())
    a, b = generator.normal(size=100), generator.normal(size=len(approaches))
    assert len(b) > 10
    transposed = (found.multiply_back(a, b)[:, :dimension] * moves).sum()
    assert transposed == pytest.approx(changes @ a + approaches @ b, rel=1e-12)


MAJOR, MINOR = 0.2, 0.1
BAR = {"shape": "box", "lower": [0.2, 0.3], "upper": [0.7, 0.5]}
CAN = {"shape": "cylinder", "base": [0.5, 0.2, 0.4], "radius": 0.2, "height": 0.4}
TRIANGLE = {"shape": "polygon", "corners": [[0.0, 0.0], [0.6, 0.0], [0.3, 0.7]]}


def scene(fluid: dict, dimension: int, **more) -> Scene:
    solver = {"kind": "projection", "time_step": 0.001}
    return bodies(dimension, [fluid], viscosity=0.001, solver=solver, **more)


def filled(table: Scene, size: float, tolerance: float, middle: list[float]) -> np.ndarray:
    """(n, d) particles of one body, of which there is as much as its size says, at the rest density, about a middle."""
    found = discretise(table)
    x = found.fluid.positions
    assert len(x) * SPACING**table.dimension == pytest.approx(size, rel=tolerance)
    assert densities(found).max() < 1.005
    np.testing.assert_allclose(x.mean(axis=0), middle, atol=0.1 * SPACING)
    return x


def torus(folder) -> dict:
    trimesh.creation.torus(MAJOR, MINOR, major_sections=60, minor_sections=30).export(folder / "torus.stl")
    return {"shape": "mesh", "file": str(folder / "torus.stl")}


def test_a_polygon_is_filled_and_turned():
    table = scene({**TRIANGLE, "position": [1.0, 0.5], "rotation": 0.4}, 2)
    x = filled(table, 0.21, 0.03, [1.0, 0.5])
    assert table.fluid[0].distance(x, SPACING).max() < 0.0
    upright = np.array([[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]]) @ (x - [1.0, 0.5]).T
    assert -0.7 / 3.0 < upright[1].min() < -0.7 / 3.0 + 0.5 * SPACING  # its lowest side was turned with it


def test_a_mesh_is_filled_and_its_hole_is_not(tmp_path):
    table = scene({**torus(tmp_path), "rotation": [np.pi / 2.0, 0.0, 0.0], "position": [0.0, 0.6, 0.1]}, 3)
    x = filled(table, 2.0 * np.pi**2 * MAJOR * MINOR**2, 0.03, [0.0, 0.6, 0.1])
    away = np.hypot(np.hypot(x[:, 0], x[:, 2] - 0.1) - MAJOR, x[:, 1] - 0.6)  # its axis is along y now
    assert away.max() < MINOR + 0.1 * SPACING  # as of a ball, whose particles are up to 0.09 spacings outside


def test_what_is_along_the_lattice_is_as_a_box_to_the_bit(tmp_path):
    trimesh.creation.box(bounds=[[0.0, 0.0, 0.0], [300.0, 400.0, 200.0]]).export(tmp_path / "box.ply")
    mesh = {"shape": "mesh", "file": str(tmp_path / "box.ply"), "scale": 0.001}
    as_box, as_mesh = (discretise(scene(one, 3)).fluid.positions for one in (box([0.0] * 3, [0.3, 0.4, 0.2]), mesh))
    np.testing.assert_allclose(as_mesh, as_box, atol=1e-12)


@pytest.mark.parametrize(
    ("fluid", "rotation", "middle", "half", "volume"),
    [
        (BAR, 0.5, [0.45, 0.4], [0.25, 0.1], 0.1),
        (CAN, [0.0, 0.0, 0.9], [0.5, 0.4, 0.4], [0.2, 0.2, 0.2], 0.016 * np.pi),
    ],
    ids=["box", "cylinder"],
)
def test_a_box_and_a_cylinder_are_turned_about_their_middle(fluid, rotation, middle, half, volume):
    """Turned back, all particles are within the shape; the can is as wide as it is high."""
    table = scene({**fluid, "rotation": rotation}, len(middle))
    x = filled(table, volume, 0.05, middle)
    back = (x - middle) @ rotation_matrix(np.atleast_1d(rotation))
    assert (np.abs(back).max(axis=0) < np.array(half) + 0.1 * SPACING).all()
    assert (np.abs(x - middle).max(axis=0) > np.array(half) + 0.1 * SPACING).any()  # as it is, it is not
    assert table.replaced(f"fluid.0.rotation={rotation}").fluid[0] == table.fluid[0]  # by way of a file


def test_a_box_turned_by_a_right_angle_is_on_its_lattice_still():
    turned = discretise(scene({**BAR, "rotation": np.pi / 2.0}, 2)).fluid.positions
    straight = discretise(scene({**BAR, "lower": [0.35, 0.15], "upper": [0.55, 0.65]}, 2)).fluid.positions
    np.testing.assert_allclose(turned, straight, atol=1e-12)


def test_a_polygon_fills_a_tank_of_its_shape_and_stays():
    """All of the fluid begins at the rest density between walls that lean; it gains no energy and stays inside.

    From one 20th of a second to the next, repairs of the density of the 82 particles lift it now and then: by up to
    4.4e-4, in steps of half and of twice the length too and with four iterations (PCISPH 7e-4).
    """
    tank = {"name": "tank", "side": "inside", **TRIANGLE}
    container = {"shape": "box", "lower": [-0.1, -0.1], "upper": [0.7, 0.8]}
    table = scene(TRIANGLE, 2, solid=[tank], container=container)
    density = densities(discretise(table))
    assert density.min() > 0.97 and density.max() < 1.01
    run = Simulation(table.replaced("solver.time_step=0.0005"), precision="float64").run(600, record_every=100)
    energies = 0.5 * (run.velocities**2).sum(axis=2).mean(axis=1) + 9.81 * run.positions[:, :, 1].mean(axis=1)
    assert energies.argmax() == 0 and energies[-1] > 0.99 * energies[0]
    assert np.diff(energies).max() < 5e-4 * energies[0]
    assert min(table.solid[0].solid().distance(x).min() for x in run.positions) > 0.25 * SPACING


@pytest.mark.parametrize(
    ("fluid", "dimension", "sentence"),
    [
        ({**TRIANGLE, "rotation": [0.1, 0.2, 0.3]}, 2, "one number in 2-D"),
        ({**TRIANGLE, "position": [0.1, 0.2, 0.3]}, 2, "a list of 2 components"),
        ({**TRIANGLE, "corners": [[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]]}, 2, "sides that do not cross"),
        ({**TRIANGLE, "corners": [[0.0, 0.0], [0.02, 0.0], [0.0, 0.02]]}, 2, "too thin to hold a particle"),
        (TRIANGLE, 3, "fluid[0].shape"),
        ({**CAN, "rotation": 0.1}, 3, "fluid[0].rotation is [0.1], but must be a list of 3 components in 3-D"),
        ({"shape": "mesh", "file": "no.stl"}, 3, "fluid[0].file cannot be used: "),
    ],
)
def test_a_bad_one_is_a_sentence(fluid, dimension, sentence):
    with pytest.raises(SceneError) as error:
        scene(fluid, dimension)
    assert sentence in str(error.value) and "fluid[0]" in str(error.value)


def test_bad_meshes_have_the_sentences_of_solids(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    trimesh.Trimesh(mesh.vertices, mesh.faces[1:], process=False).export(tmp_path / "hole.stl")
    with pytest.raises(SceneError, match="is not closed"):
        scene({"shape": "mesh", "file": str(tmp_path / "hole.stl")}, 3)
    with pytest.raises(SceneError, match=r"fluid\[0\] is partly outside, for example at"):
        scene(torus(tmp_path), 3, container=box([-0.2] * 3, [0.2] * 3))
