"""Round bodies of fluid: their volume, their density, their outline, and that they are at rest."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

import cortado
from cortado.discretise.packing import Linearised, PointsAround, Relaxation
from cortado.discretise.pairs import apart, pairs_among, pairs_within
from cortado.discretise.room import Region
from cortado.discretise.smoothing import CUBIC_SPLINE
from cortado.discretise.walls import RestLattice
from cortado.scene.discrete_scene import DiscreteScene, discretise
from cortado.scene.fluid_particles import period
from cortado.scene.scene import Scene

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
    return Scene(
        dimension=dimension,
        discretisation={"spacing": SPACING, "kernel": kernel, "support": support},
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.1}],
        fluid=[{"phase": "water"} | body for body in fluid],
        solver={"kind": "pcisph", "time_step": 5e-4},
        **({} if container is None else {"container": container}),
    )


def densities(scene: Scene, found: DiscreteScene) -> np.ndarray:
    """(n,) over the rest density: all pairs within the support, and the walls with their weights."""
    x, walls, support, kernel = found.fluid.positions, found.walls, found.lattice.support, found.kernel
    i, _, distances = pairs_within(x, x, support, *period(scene))
    k, b, to_walls = pairs_within(x, walls.positions, support, *period(scene))
    total = np.bincount(i, kernel.weight(distances, scene.dimension, support), len(x))
    total += np.bincount(k, walls.weights[b] * kernel.weight(to_walls, scene.dimension, support), len(x))
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
    lower, lengths = period(scene)
    return np.isin(np.arange(len(x)), pairs_within(x, places[empty], reach, lower, lengths)[0])


CASES = {
    "disc": (2, [DISC], None, AREA),
    "ball": (3, [BALL], None, 4.0 / 3.0 * np.pi * 0.125),
    "cylinder": (3, [CYLINDER], None, VOLUME),
    "cup": (3, [CYLINDER], CUP, VOLUME),
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
    seen, sees_air = densities(scene, found), near_air(scene, found)
    assert seen.max() < 1.01 and seen[found.fluid.is_packed].max() < 1.0001
    assert np.count_nonzero(~sees_air) > 50 and seen[~sees_air].min() > 0.99
    i, j = pairs_among(x, SPACING, *period(scene))
    assert np.linalg.norm(apart(x[i] - x[j], period(scene)[1]), axis=1).min() > 0.7 * SPACING


@pytest.mark.parametrize(("kernel", "support"), [("wendland_c2", 2.5), ("wendland_c4", 3.0), ("cubic_spline", 3.0)])
def test_other_kernels(kernel, support):
    scene = scene_of(2, [DISC], None, kernel, support)
    found = discretise(scene)
    assert len(found.fluid.positions) * SPACING**2 == pytest.approx(AREA, rel=0.01)
    assert densities(scene, found).max() < 1.0


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
    height = 0.4
    simulation = cortado.Simulation(scene_of(3, [CYLINDER | {"height": height}], CUP))
    last = simulation.run(200, record_every=200).positions[-1]
    assert last[:, 1].mean() == pytest.approx(0.5 * height, rel=0.01)


def test_a_free_drop_does_not_move():
    simulation = cortado.Simulation(scene_of(2, [DISC]).replaced("forces.gravity=[0,0]"), precision="float64")
    assert simulation.run(20, record_every=20).velocities[-1].max() == 0.0


def test_packed_particles_are_the_same_every_time_and_few_move():
    """What is deep in the body stays on the lattice."""
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
    for radius in (0.04, 0.06, 0.1, 0.14):
        found = discretise(scene_of(2, [DISC | {"radius": radius}])).fluid.positions
        assert abs(len(found) - np.pi * radius**2 / SPACING**2) <= 1.0
        assert np.isfinite(found).all()


def test_distances_from_a_region():
    points = np.array([[0.0, 0.2, 0.0], [0.0, 0.9, 0.0], [0.6, 0.5, 0.0], [0.0, -0.1, 0.45]])
    cylinder = Region.cylinder(np.zeros(3), 0.5, 0.8, 1)
    np.testing.assert_allclose(cylinder.distance(points), [-0.2, 0.1, 0.1, 0.1])
    np.testing.assert_allclose(Region.ball(np.zeros(3), 0.5).distance(points), np.linalg.norm(points, axis=1) - 0.5)
    assert (Region.everywhere(3).distance(points) == -np.inf).all()


def around(points: np.ndarray, air: tuple[int, int], lengths: np.ndarray, reach: float) -> PointsAround:
    lattice = RestLattice(CUBIC_SPLINE, 0.1, 0.2, len(lengths))
    weights = np.where(np.arange(len(points)) < 100, 1.0, 0.7)
    return PointsAround(lattice, points, weights, air, lengths, reach)


@pytest.mark.parametrize("lengths", [[0.0, 0.0, 0.0], [0.0, 0.5, 1.1], [0.0, 0.0], [1.0, 0.0]])
def test_what_is_around_particles_is_what_pairs_are(lengths):
    """Of 100 particles every other one is blind, so that it does not see the air behind them; some periods are so short
    that a particle would see two images."""
    lengths = np.array(lengths)
    points, blind = np.random.default_rng(3).uniform(-0.3, 1.6, size=(400, len(lengths))), np.arange(100) % 2 == 0
    found = around(points, (100, 250), lengths, 0.26)
    i, j, distances = pairs_within(points[:100], points, 0.26, 0.0, lengths)
    seen = ~(blind[i] & (j >= 100) & (j < 250))
    later = seen & (j > i)
    starts, ends, others = found.lists(points[:100], blind)
    listed = {(n, other) for n in range(100) for other in others[starts[n] : ends[n]]}
    assert listed == {*zip(i[later], j[later], strict=True)} and ends.sum() - starts.sum() == len(listed) > 50
    sums = np.bincount(i, seen * found.weights[j] * CUBIC_SPLINE.weight(distances, len(lengths), 0.2), 100)
    np.testing.assert_allclose(found.sums(points[:100], blind), sums, rtol=1e-13)
    some = around(points[:3], (0, 0), lengths, 0.26)
    np.testing.assert_array_equal(some.near(points[:100]), np.isin(np.arange(100), i[j < 3]))


@pytest.mark.parametrize("dimension", [2, 3])
def test_derivatives_of_densities_and_distances(dimension):
    """Against differences, and the product with the transpose against that with the derivatives."""
    generator = np.random.default_rng(4)
    points, free = generator.uniform(size=(300, dimension)), np.arange(100) % 3 > 0
    blind, lengths = np.arange(100) % 2 == 0, np.array([0.0, 1.0, 0.0])[:dimension]

    def linearised(moves: np.ndarray | float = 0.0) -> Linearised:
        moved = points.copy()
        moved[:100] += moves
        return Relaxation(around(moved, (100, 200), lengths, 0.25), blind, free).linearised(0.09)

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


def test_pairs_of_one_set_are_those_of_two():
    points = np.random.default_rng(2).uniform(size=(200, 2))
    for lengths in (np.zeros(2), np.array([1.0, 0.0])):
        i, j, _ = pairs_within(points, points, 0.1, 0.0, lengths)
        a, b = pairs_among(points, 0.1, 0.0, lengths)
        assert {*zip(i[i < j], j[i < j], strict=True)} == {*zip(a, b, strict=True)} and len(a) > 100
