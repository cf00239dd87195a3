"""Walls: wall particles against sums over a lattice, densities in whole containers, and planes as solids."""

import itertools
from typing import Any

import numpy as np
import pytest

from cortado import Scene, SceneError, Simulation
from cortado.discretise.primitives import cut_box_faces
from cortado.discretise.smoothing import KERNELS, SLACK
from cortado.discretise.walls import RestLattice
from cortado.pictures.shown_solids import solid_outline
from cortado.scene.discrete_scene import DiscreteScene, discretise
from cortado.scene.shape_tables import BoxContainer, Container
from scenes import bodies
from scenes import box as corners
from test_packing import densities
from test_solids import volume_and_middle, winding

SPACING, FULL = 0.05, 1.0 - SLACK


class FlatWall:
    """Fluid on the lattice above a flat wall at height 0; the first axis of space is the height."""

    def __init__(self, name: str, support: float, dimension: int):
        self.kernel, self.support, self.dimension = KERNELS[name], support * SPACING, dimension
        self.layers = RestLattice(self.kernel, SPACING, self.support, dimension).layers
        self.plane = SPACING * np.array(list(itertools.product(range(-4, 5), repeat=dimension - 1)), dtype=np.float64)
        whole = np.array(list(itertools.product(range(-4, 5), repeat=dimension)), dtype=np.float64)
        self.total = self.weight(SPACING * whole).sum()

    def weight(self, separations: np.ndarray) -> np.ndarray:
        return self.kernel.weight(np.linalg.norm(separations, axis=-1), self.dimension, self.support)

    def to_plane(self, distance: float) -> np.ndarray:
        return np.column_stack([np.full(len(self.plane), distance), self.plane])

    def of_wall(self, height: float) -> float:
        """What the wall adds to the density of a particle at a height [m], over the rest density."""
        pairs = zip(self.layers.depths, self.layers.weights, strict=True)
        return sum(w * self.weight(self.to_plane(height + depth)).sum() for depth, w in pairs) / self.total

    def missing(self, layer: int) -> float:
        """What a particle of a layer misses of the lattice below height 0."""
        return sum(self.weight(self.to_plane(SPACING * k)).sum() for k in range(layer + 1, 6)) / self.total


@pytest.mark.parametrize("support", [1.2, 2.05, 2.6, 4.0])
@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_flat_wall_completes_the_lattice_and_stops_a_particle_alone(name, dimension, support):
    """In the layers that see it: exactly in the first two, and within 0.3 % in a third. A uniform pressure q pushes no
    particle, with -q (2 sum_j G_ij + sum_b w_b G_ib). One alone has the rest density, and from there on a pressure,
    before it reaches the surface of the container."""
    wall, step = FlatWall(name, support, dimension), 1e-6 * SPACING
    errors = [wall.of_wall((layer + 0.5) * SPACING) - wall.missing(layer) for layer in range(4)]
    np.testing.assert_allclose(errors[:2], 0.0, atol=1e-7)
    assert max(map(abs, errors)) < 0.003
    assert wall.missing(0) > 1e-3 or support < 1.5
    slope_of_wall = (wall.of_wall(0.5 * SPACING + step) - wall.of_wall(0.5 * SPACING - step)) / (2.0 * step)
    above = np.concatenate([wall.to_plane(-SPACING * k) for k in range(6)])  # from its neighbours to the particle
    slope_of_fluid = wall.kernel.gradient(above, wall.support)[:, 0].sum() / wall.total
    assert slope_of_fluid > 0.0
    assert slope_of_wall == pytest.approx(-2.0 * slope_of_fluid, rel=1e-6)
    alone = wall.weight(np.zeros((1, dimension))).sum() / wall.total
    assert alone + wall.of_wall(0.5 * SPACING) < FULL < alone + wall.of_wall(0.0)


def filled(container: dict[str, Any], kernel: str, support: float, solid: Any = (), **fluid: Any) -> DiscreteScene:
    """A container full of water, around solids."""
    body = {key: value for key, value in container.items() if key not in ("periodic", "lid")}
    cut = {"spacing": SPACING, "support": support, "kernel": kernel}
    dimension = len(container.get("lower", container.get("base")))
    return discretise(bodies(dimension, [{**body, **fluid}], container, discretisation=cut, solid=list(solid)))


def box(upper: list[float], **more: Any) -> dict[str, Any]:
    return corners([0.0] * len(upper), [SPACING * x for x in upper], **more)


KINDS = pytest.mark.parametrize(
    ("kernel", "support"), [("cubic_spline", 2.0), ("wendland_c2", 2.6), ("wendland_c4", 3.0)]
)
BOXES = {
    "plane": box([12, 9]),
    "space": box([8, 9, 10]),
    "channel": box([12, 8], periodic=[True, False]),
    "duct": box([12, 8, 9], periodic=[True, False, False]),
    "slit": box([12, 12, 7], periodic=[True, True, False]),
}


@KINDS
@pytest.mark.parametrize("name", BOXES)
def test_water_that_fills_a_box_has_the_rest_density_everywhere(name, kernel, support):
    """At faces, edges, corners, and where a period begins."""
    discrete = filled(BOXES[name], kernel, support)
    found = densities(discrete) / FULL
    assert np.abs(found - 1.0).max() < 0.003
    assert found.max() < 1.001


@pytest.mark.parametrize("width", [1, 2, 3])
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_gap_of_a_few_spacings_between_walls_has_the_rest_density(width, dimension):
    found = densities(filled(box([8, 8, width][-dimension:]), "cubic_spline", 2.0)) / FULL
    assert found.max() < 1.003 and found.min() > 0.99


def test_in_a_box_that_is_no_multiple_of_the_spacing_nothing_starts_compressed():
    for stretch in [0.97, 1.02, 1.045]:
        discrete = filled(box([8 * stretch, 9, 8]), "cubic_spline", 2.0)
        found = densities(discrete) / FULL
        assert found.max() < 1.003 and found[discrete.fluid.positions[:, 0] < SPACING].min() > 0.99


@pytest.mark.parametrize(
    ("radius", "lid", "kernel", "support"),
    [
        (6.5, True, "wendland_c4", 3.5),
        (8.0, True, "wendland_c2", 2.6),
        (10.3, False, "cubic_spline", 2.0),
    ],
)
def test_water_that_fills_a_cup_starts_nowhere_compressed(radius, lid, kernel, support):
    """Beside the round side it starts as dense as in the middle."""
    cup = {"shape": "cylinder", "base": [0, 0, 0], "radius": radius * SPACING, "height": 8 * SPACING, "axis": "z"}
    discrete = filled({**cup, "lid": lid}, kernel, support)
    found, positions = densities(discrete) / FULL, discrete.fluid.positions
    assert found.max() < 1.003
    below = positions[:, 2] < (8.0 - support) * SPACING
    np.testing.assert_allclose(found[below], 1.0, atol=0.01)
    assert (discrete.walls.weights > 0.0).all()


def test_a_saucer_has_walls_too():
    """It is so shallow that there is no place within at which its walls could be judged."""
    for height in [2, 3]:
        cup = {"shape": "cylinder", "base": [0, 0, 0], "radius": 5 * SPACING, "height": height * SPACING, "lid": False}
        discrete = filled({**cup, "axis": "z"}, "cubic_spline", 2.0)
        assert 0.9 < densities(discrete).max() / FULL < 1.003 and (discrete.walls.weights > 0.0).all()


@KINDS
def test_the_side_of_a_cup_stops_a_particle_alone(kernel, support):
    """As a flat wall does, between its wall particles and beside them."""
    radius, angles = 6.5 * SPACING, np.linspace(0.0, 0.3, 31)
    cup = {"shape": "cylinder", "base": [0, 0, 0], "radius": radius, "height": 8 * SPACING, "axis": "z"}
    discrete = filled(cup, kernel, support)
    places = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.full(len(angles), 4 * SPACING)])
    apart = np.linalg.norm(places[:, None] - discrete.walls.positions, axis=-1)
    alone = discrete.kernel.weight(np.zeros(1), 3, discrete.lattice.support)
    of_wall = discrete.kernel.weight(apart, 3, discrete.lattice.support) @ discrete.walls.weights
    assert (discrete.lattice.volume * (alone + of_wall)).min() > 1.0


@pytest.mark.parametrize(("kernel", "support"), [("cubic_spline", 2.0), ("wendland_c2", 2.6), ("wendland_c4", 4.0)])
@pytest.mark.parametrize("periodic", [False, True])
def test_a_long_box_has_the_weights_that_are_found_for_all_of_it(monkeypatch, kernel, support, periodic):
    """Of which one side is longer than the shorter box's and the other no multiple of the spacing."""
    long = box([60, 12.2], periodic=[periodic, False])
    found = filled(long, kernel, support).walls
    monkeypatch.setattr(BoxContainer, "shortened", Container.shortened)
    whole = filled(long, kernel, support).walls
    np.testing.assert_array_equal(found.positions, whole.positions)
    np.testing.assert_allclose(found.weights, whole.weights, rtol=1e-6)


def test_a_container_clear_of_solids_has_the_walls_that_it_has_without_them():
    """And one that is not has others."""
    alone = filled(box([24, 24]), "wendland_c2", 2.6).walls
    ball = {"name": "ball", "shape": "sphere", "radius": 0.2}
    for height, same in ((0.6, True), (0.5, False)):
        walls = filled(box([24, 24]), "wendland_c2", 2.6, solid=[{**ball, "centre": [0.6, height]}]).walls
        own = walls.weights[walls.solid == -1]
        assert (len(own) == len(alone.weights) and np.array_equal(own, alone.weights)) is same


BOX = {"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0]}
SLOPE = {"name": "slope", "shape": "plane", "position": [0.5, 0.3], "normal": [-1.0, 2.0]}
UNIT = np.array([-1.0, 2.0]) / np.sqrt(5.0)


def scene(solids: list, fluid: tuple = ([0.0, 0.0], [1.0, 0.6]), container: dict | None = BOX, **more) -> Scene:
    """By default all of a tank below 0.6 m is full of water, but for what is solid."""
    solver = {"kind": "projection", "time_step": 0.001}
    return bodies(len(fluid[0]), [corners(*fluid)], container, viscosity=1e-3, solid=solids, solver=solver, **more)


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
    density = densities(discretise(table))
    assert density.max() < 1.012
    x = discretise(table).fluid.positions
    assert len(x) * SPACING**2 == pytest.approx(0.3, rel=0.04)  # the slope goes from 0.05 to 0.55
    run = Simulation(table, precision="float64").run(300, record_every=50)
    assert energies(run).max() < 1.002 * energies(run)[0]  # 0.17 %, from repairs of a density that is uneven at first
    assert ((run.positions - SLOPE["position"]) @ UNIT).min() > 0.2 * SPACING


def test_a_plane_beside_a_period_is_one_wall_without_an_end():
    container = BOX | {"periodic": [True, False], "lower": [0.0, -0.5]}
    floor = {"name": "floor", "shape": "plane", "position": [0.3, 0.02], "normal": [0.0, 1.0]}
    table = scene([floor], ([0.0, 0.0], [1.0, 0.5]), container)
    found = discretise(table)
    walls = found.walls.positions
    walls = walls[np.abs(walls[:, 1]) < 0.2]
    assert (walls[:, 0] >= 0.0).all() and (walls[:, 0] < 1.0).all() and walls[:, 1].max() < 0.02
    density = densities(found)
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
    assert densities(found).max() < 1.02


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


def test_a_wrong_plane_is_a_sentence():
    for change, container, sentence in [
        ({"normal": [0.0, 0.0]}, BOX, "solid[0].normal is [0.0, 0.0], but must be a vector that is not zero"),
        ({"side": "inside"}, BOX, "fluid is where the normal of a plane points"),
        ({"rotation": 0.1}, BOX, "normal says how a plane is turned"),
        ({"motion": "path", "velocity": [1.0, 0.0]}, BOX, "a plane is at rest"),
        ({}, None, "as a plane has no end: give it a [container] to cut"),
        ({}, BOX | {"periodic": [True, False]}, "0 along axis 0, where the container is periodic"),
        ({"position": [0.5, -2.0]}, BOX, "outside of the container, all of which is in front of it"),
    ]:
        with pytest.raises(SceneError) as error:
            scene([SLOPE | change], container=container)
        assert sentence in str(error.value) and "solid[0]" in str(error.value)


def test_a_plane_is_in_pictures_as_far_as_the_container_goes_and_in_json():
    table = scene([SLOPE])
    lines = solid_outline(table)
    assert lines.min() == pytest.approx(0.0, abs=1e-12) and lines.max() == pytest.approx(1.0)
    assert np.abs((lines - SLOPE["position"]) @ UNIT).min() < 1e-12
    again = Scene.from_json(table.to_json())
    np.testing.assert_array_equal(discretise(again).walls.positions, discretise(table).walls.positions)
