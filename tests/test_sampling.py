"""From scenes to particles: where they are and how fast, how many, and that none is there twice."""

import pickle
import warnings
from itertools import product

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cortado import CortadoWarning, Scene, SceneError, Simulation
from cortado.discretise.shapes import EXCESS, block_filling
from cortado.errors import InputError, unwarned
from cortado.scene.discrete_scene import discretise
from cortado.scene.fluid_particles import fluid_particles
from cortado.scene.stability import stability_limits
from scenes import bodies, box
from test_packing import densities

SPACING = 0.05


def scene_of(dimension: int, fluid, container=None, spacing: float = SPACING) -> Scene:
    phases = [{"name": name, "rest_density": 1000, "viscosity": 0.0} for name in ("oil", "water")]
    return bodies(dimension, fluid, container, spacing, phase=phases)


def nearest(points: np.ndarray) -> float:
    return cKDTree(points).query(points, k=2)[0][:, 1].min()


def one_layer(scene: Scene, depth: float) -> np.ndarray:
    return scene.container.walls(scene.dimension, scene.discretisation.spacing, depth)


def test_a_box_is_filled_from_its_lower_corner():
    sample = fluid_particles(scene_of(3, [box([0.1, 0.0, -0.1], [0.35, 0.1, 0.05])]))
    indices = np.array(list(product(range(5), range(2), range(3))))
    np.testing.assert_allclose(sample.positions, [0.1, 0.0, -0.1] + (indices + 0.5) * SPACING, atol=1e-14)
    for lower in (0.0, 0.1, 0.7, -3.3, 100.1):  # round-off neither adds nor loses a layer
        for cells in (1, 3, 5, 7):
            scene = scene_of(2, [box([lower, 0.0], [lower + cells * SPACING, SPACING])])
            assert len(fluid_particles(scene).positions) == cells


@pytest.mark.parametrize("upper", [[1.025, 2.0], [1.01, 1.98], [1.025, 1.0, 2.0]])
def test_a_lattice_is_stretched_a_little_to_fill_a_box_that_is_no_multiple_of_the_spacing(upper):
    """Its particles are as many as its volume holds, half a cell from its faces."""
    dimension = len(upper)
    sample = fluid_particles(scene_of(dimension, [box([0.0] * dimension, upper)]))
    x = sample.positions
    assert not sample.is_packed.any()
    assert len(x) * SPACING**dimension == pytest.approx(np.prod(upper), rel=0.003)
    apart = np.array([np.diff(np.unique(x[:, axis])).max() for axis in range(dimension)])
    np.testing.assert_allclose(x.min(axis=0), 0.5 * apart)
    np.testing.assert_allclose(upper - x.max(axis=0), 0.5 * apart)
    assert np.abs(np.log(apart / SPACING)).max() < 0.031


@pytest.mark.parametrize("upper", [[0.24, 0.17], [0.41, 0.41], [0.63, 0.48, 1.01], [0.72, 0.57, 0.87]])
def test_a_box_that_no_such_lattice_fills_is_packed(upper):
    """As round bodies are, with somewhat less than its mass, and not with a layer too few."""
    dimension = len(upper)
    sample = fluid_particles(scene_of(dimension, [box([0.0] * dimension, upper)]))
    count, wanted = len(sample.positions), np.prod(upper) / SPACING**dimension
    assert sample.is_packed.all() and 0.991 * wanted - 0.6 < count < 1.003 * wanted


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("radius", [0.23, 0.3, 0.5])
def test_a_sphere_begins_on_a_lattice_about_its_centre(dimension, radius):
    centre = np.array([0.3, -0.2, 1.0])[:dimension]
    fluid = {"shape": "sphere", "centre": centre.tolist(), "radius": radius}
    sample = fluid_particles(scene_of(dimension, [fluid]))
    from_centre = sample.positions - centre
    assert sample.is_packed.all() and np.linalg.norm(from_centre, axis=1).max() <= radius + 0.1 * SPACING
    np.testing.assert_allclose(nearest(from_centre), SPACING)
    volume = np.pi * radius**2 if dimension == 2 else 4.0 / 3.0 * np.pi * radius**3
    assert len(from_centre) * SPACING**dimension == pytest.approx(volume, rel=0.02 if radius < 0.3 else 0.01)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("height", [0.1, 0.12])
def test_whole_layers_of_a_cylinder_stand_on_its_base(axis, height):
    base, along = np.array([0.1, 0.2, 0.3]), "xyz".index(axis)
    fluid = {"shape": "cylinder", "base": base.tolist(), "radius": 0.5, "height": height, "axis": axis}
    from_base = fluid_particles(scene_of(3, [fluid])).positions - base
    np.testing.assert_allclose(np.unique(from_base[:, along].round(9)), [0.25 * height, 0.75 * height])
    across = np.delete(from_base, along, axis=1)
    assert 0.45 < np.linalg.norm(across, axis=1).max() < 0.505
    assert len(from_base) * SPACING**3 == pytest.approx(np.pi * 0.5**2 * height, rel=0.01)


L_SHAPE = [[0.0, 0.0], [0.6, 0.0], [0.6, 0.2], [0.2, 0.2], [0.2, 0.6], [0.0, 0.6]]
IN_WATER = {"solid": [box([0.43, 0.0], [0.57, 0.3], name="pillar")]}
SHAPES = {
    "on cells": (2, {"shape": "polygon", "corners": L_SHAPE}, 0.2),
    "triangle": (2, {"shape": "polygon", "corners": [[0.0, 0.0], [0.7, 0.0], [0.0, 0.5]]}, 0.175),
    "disc": (2, {"shape": "sphere", "centre": [0.1, 0.2], "radius": 0.2}, np.pi * 0.04),
    "ball": (3, {"shape": "sphere", "centre": [0.1, 0.2, 0.3], "radius": 0.12}, 4.0 / 3.0 * np.pi * 0.12**3),
    "rod": (3, {"shape": "cylinder", "base": [0, 0, 0], "radius": 0.06, "height": 0.9}, np.pi * 0.06**2 * 0.9),
    "turned": (3, box([0.0] * 3, [0.3, 0.2, 0.25], rotation=[0.3, 0.2, 0.5]), 0.015),
    "box": (2, box([0.0, 0.0], [0.52, 0.33]), 0.52 * 0.33),
}


@pytest.mark.parametrize("name", SHAPES)
def test_what_a_body_is_asked_to_hold_is_the_volume_of_its_shape(name):
    """To round-off, and not that of cells that measure it, nor of the box around it; less what a solid takes of it."""
    dimension, fluid, volume = SHAPES[name]
    assert fluid_particles(scene_of(dimension, [fluid])).asked == pytest.approx([volume], rel=1e-12)
    if name == "box":
        scene = scene_of(2, [box([0.0, 0.0], [1.0, 0.5])]).model_dump(exclude_unset=True)
        assert fluid_particles(Scene(**scene, **IN_WATER)).asked == pytest.approx([0.5 - 0.14 * 0.3], rel=1e-3)


def test_another_mass_than_was_asked_for_is_warned_of_once():
    """When a simulation is made, and not when it is made once more for a batch or in another process."""
    packed, full = (scene_of(2, [box([0.0, 0.0], [side, side])]) for side in (0.33, 0.35))
    with pytest.warns(CortadoWarning, match=r"107.5 kg of water, where 108.9 kg were asked for") as told:
        simulation = Simulation(packed)
        simulation.batch_of(2)
        pickle.loads(pickle.dumps(simulation))
    assert len(told) == 1 and told[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Simulation(full)


SEAMS = {
    "halves": ([box([0.0, 0.0], [0.31, 0.5]), box([0.31, 0.0], [1.0, 0.5])], [1.5, 1.0], [0.31, 0.15]),
    "stretched": ([box([0.0, 0.0], [1.184, 0.81]), box([1.184, 0.0], [2.514, 0.81])], [3.0, 1.0], [1.184, 0.4]),
    "on top": ([box([0.0, 0.0], [1.17, 0.32]), box([0.71, 0.32], [1.17, 0.54])], [1.17, 0.74], [1.0, 0.3]),
    "layers": ([box([0.0, 0.0], [0.42, 0.49]), box([0.0, 0.49], [0.42, 0.71], phase="oil")], None, [0.21, 0.49]),
    "period": ([box([0.0, 0.0], [0.5, 0.43]), box([0.5, 0.0], [1.03, 0.43])], [1.03, 0.6], [0.5, 0.15]),
}
"""Boxes of fluid, the upper corner of their container, and a place on the seam."""


@pytest.mark.parametrize("name", SEAMS)
def test_fluid_is_neither_compressed_nor_torn_along_a_seam(name):
    """Of two boxes, whatever lattices or packed particles they have."""
    fluids, upper, place = SEAMS[name]
    container = None if upper is None else box([0.0, 0.0], upper, periodic=[name == "period", False])
    kernel = "wendland_c2" if name in ("on top", "layers") else "cubic_spline"
    scene = scene_of(2, fluids, container).replaced(f"discretisation.kernel={kernel}", "discretisation.support=2.0")
    with unwarned():
        discrete = discretise(scene)
    sample, found = discrete.fluid, densities(discrete)
    assert found.max() < 1.03
    assert found[np.abs(sample.positions - place).max(axis=1) < 2.0 * SPACING].min() > 0.97
    assert sum(sample.sizes) == len(found) and 0.985 < len(found) * SPACING**2 / sum(sample.asked) < 1.003


def test_particles_come_in_the_order_of_the_fluids(tmp_path):
    np.save(tmp_path / "three.npy", [[3.0, 3.0], [2.0, 2.0], [4.0, 4.0]])
    fluids = [
        box([0.5, 0.5], [0.6, 0.6], velocity=[1.0, 2.0]),
        {"shape": "points", "file": str(tmp_path / "three.npy"), "velocity": [3.0, 4.0]},
        box([0.0, 0.0], [0.05, 0.05]),
    ]
    sample = fluid_particles(scene_of(2, fluids))
    np.testing.assert_allclose(sample.positions[[0, 4, 5, 7]], [[0.525, 0.525], [3, 3], [2, 2], [0.025, 0.025]])
    np.testing.assert_array_equal(sample.velocities, np.repeat([[1, 2], [3, 4], [0, 0]], [4, 3, 1], axis=0))
    assert sample.phase.tolist() == 8 * [1] and sample.positions.dtype == np.float64


@pytest.mark.parametrize("cells", [(4, 3), (4, 3, 2)])
def test_a_box_has_each_wall_particle_once(cells):
    upper = SPACING * np.array(cells)
    dimension = len(cells)
    scene = scene_of(dimension, [box([0.0] * dimension, upper)], box([0.0] * dimension, upper))
    walls = one_layer(scene, 0.5 * SPACING)
    lattice = np.array(list(product(*[range(-1, n + 1) for n in cells])))
    wanted = lattice[((lattice < 0) | (lattice >= cells)).any(axis=1)]
    found = walls / SPACING - 0.5
    np.testing.assert_allclose(found[np.lexsort(found.round().T[::-1])], wanted, atol=1e-9)


def test_a_box_between_multiples_of_the_spacing_is_stretched():
    scene = scene_of(2, [box([0.0, 0.0], [0.1, 0.1])], box([0.0, 0.0], [0.23, 0.26]))
    walls = one_layer(scene, 0.025)
    assert len(walls) == 7 * 7 - 5 * 5
    inner = np.unique(walls[:, 0].round(12))
    np.testing.assert_allclose(inner, [-0.025, 0.023, 0.069, 0.115, 0.161, 0.207, 0.255])


def test_a_periodic_axis_has_no_wall():
    container = box([0.1, 0.0], [0.5, 0.2], periodic=[True, False])
    scene = scene_of(2, [box([0.1, 0.0], [0.5, 0.2])], container)
    walls = one_layer(scene, 0.03)
    np.testing.assert_allclose(np.unique(walls[:, 0].round(9)), 0.1 + SPACING * (np.arange(8) + 0.5))
    np.testing.assert_allclose(np.unique(walls[:, 1].round(9)), [-0.03, 0.23])
    lower, lengths = scene.periods
    np.testing.assert_allclose((lower, lengths), ([0.1, 0.0], [0.4, 0.0]))
    everywhere = scene_of(2, [box([0.1, 0.0], [0.5, 0.2])], container | {"upper": [0.5, 0.3], "periodic": [True, True]})
    assert one_layer(everywhere, 0.025).shape == (0, 2)
    assert one_layer(scene_of(3, [box([0, 0, 0], [0.1, 0.1, 0.1])]), 0.025).shape == (0, 3)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("lid", [True, False])
@pytest.mark.parametrize("depth", [0.5 * SPACING, 0.8 * SPACING])
def test_a_cup_is_lined_all_round(axis, lid, depth):
    base, radius, height, along = np.array([0.1, 0.2, 0.3]), 0.21, 0.32, "xyz".index(axis)
    cup = {"shape": "cylinder", "base": base, "radius": radius, "height": height, "axis": axis, "lid": lid}
    fluid = {"shape": "cylinder", "base": base, "radius": radius, "height": 0.3, "axis": axis}
    scene = scene_of(3, [fluid], cup)
    walls = one_layer(scene, depth) - base
    levels = walls[:, along]
    from_axis = np.linalg.norm(np.delete(walls, along, axis=1), axis=1)
    below, above = levels < 0, levels > height
    side = ~below & ~above
    np.testing.assert_allclose(levels[below].max(), -depth)
    assert above.any() == lid and below.sum() == (above.sum() if lid else below.sum())
    np.testing.assert_allclose(np.unique(from_axis[side].round(9)), [radius + depth])
    np.testing.assert_allclose(from_axis[below].max(), radius + depth)
    fluid = fluid_particles(scene).positions - base
    bottom = np.delete(walls[below], along, axis=1)
    across = np.delete(fluid, along, axis=1)
    to_bottom = cKDTree(bottom).query(across[np.linalg.norm(across, axis=1) < radius - SPACING])[0]
    assert to_bottom.max() < 1e-9  # the lattice goes on below the base
    assert nearest(walls) > 0.4 * SPACING
    packed = discretise(scene).fluid.positions - base
    assert depth + 0.25 * SPACING < cKDTree(walls).query(packed)[0].min() < depth + 0.6 * SPACING


def test_a_box_keeps_half_a_spacing_from_the_side_of_a_cup():
    """Those of the lattice that has no container, less the ones that are nearer to its side, and no other."""
    cup = {"shape": "cylinder", "base": [0, 0, 0], "radius": 0.31, "height": 0.4, "axis": "z"}
    square = box([-0.23, -0.23, 0.0], [0.22, 0.22, 0.1])
    free = fluid_particles(scene_of(3, [square])).positions
    room = 0.31 - np.linalg.norm(free[:, :2], axis=1)
    assert (room < 0.5 * SPACING).any()
    held = fluid_particles(scene_of(3, [square], cup))
    np.testing.assert_array_equal(held.positions, free[room >= 0.5 * SPACING])
    assert not held.is_packed.any()


def test_a_fluid_that_walls_leave_no_room_for_is_refused():
    drop, tank = {"shape": "sphere", "centre": [0.3, 0.02], "radius": 0.026}, box([0.0, 0.0], [1.0, 1.0])
    assert len(fluid_particles(scene_of(2, [drop], tank)).positions) == 1
    with pytest.raises(InputError, match=r"fluid\.0 has no particle, as the volume that walls leave it is 0\.4\d of"):
        fluid_particles(scene_of(2, [drop | {"centre": [0.3, 0.0]}], tank))
    layer = box([0.1, 0.1], [0.2, 0.15])
    with pytest.raises(InputError, match=r"fluid\.0 has no particle that is half a spacing, 0\.025 m, or more"):
        fluid_particles(scene_of(2, [layer], box([0.0, 0.11], [1.0, 1.0])))


def test_a_first_lattice_can_be_jittered(tmp_path):
    """Particles of bodies alone, not points of a file or those in a nozzle; the same in every run."""
    points = tmp_path / "points.npy"
    np.save(points, [[0.9, 0.1], [0.9, 0.3]])
    nozzle = 'emitter=[{phase="oil", outlet=[0.7, 1.0], radius=0.1, length=0.2, flow_rate=0.01}]'
    fluid = [box([0.0, 0.0], [0.5, 0.5]), {"shape": "points", "file": str(points)}]
    even = scene_of(2, fluid).replaced(nozzle)
    stirred = even.replaced("discretisation.jitter=0.2")
    moves = discretise(stirred).fluid.positions - discretise(even).fluid.positions
    assert np.abs(moves[:100]).max() <= 0.2 * SPACING and np.abs(moves[:100]).std() > 0.05 * SPACING
    assert not moves[100:].any() and len(moves) > 102
    assert discretise(stirred).fluid.positions.tobytes() == discretise(stirred).fluid.positions.tobytes()
    assert stirred.computed_json() != even.computed_json() and "jitter" not in even.computed_json().split("emitter")[0]
    with pytest.raises(SceneError, match=r"discretisation.jitter is 0\.4, but must be at least 0 and at most 0"):
        even.replaced("discretisation.jitter=0.4")


def boxes_of_fluid(dimension, *corners):
    """Boxes of fluid, each from a lower to an upper corner."""
    return scene_of(dimension, [box(*pair) for pair in corners], box([0.0] * dimension, [2.0] * dimension))


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("offset", np.arange(5) / 5.0 + 0.1)
def test_a_box_within_another_is_refused(dimension, offset):
    """At any place of its particles between those of the other, and in either order; and one that is half in it."""
    low = 0.4 + offset * SPACING
    large, small = ([0.0] * dimension, [1.0] * dimension), ([low] * dimension, [low + 0.1] * dimension)
    half = [0.6 + offset * SPACING] * dimension, [1.1 + offset * SPACING] * dimension
    for pair in ((large, small), (small, large), (large, half)):
        with pytest.raises(SceneError, match=r"fluid\[1\] is overlapping fluid\[0\] at"):
            boxes_of_fluid(dimension, *pair)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("gap", [0.0, -0.4, 0.3])
def test_a_box_may_stand_in_a_corner_of_others(dimension, gap):
    """Nearer than a lattice by some of a spacing, or further away; the floor and the walls are boxes of fluid."""
    side, at = 0.5, 0.5 + gap * SPACING
    boxes = [
        ([0.0] * dimension, [1.0, side, 1.0][:dimension]),
        ([0.0, side, 0.0][:dimension], [side, 1.0, 1.0][:dimension]),
    ]
    if dimension == 3:
        boxes.append(([side, side, 0.0], [1.0, 1.0, side]))
    boxes_of_fluid(dimension, *boxes, ([at] * dimension, [at + 0.3] * dimension))


def spinning_bodies(dimension, *fluid):
    forces = {"gravity": [0.0] * dimension, "viscosity": "none"}
    return bodies(dimension, fluid, spacing=0.1, forces=forces, solver={"kind": "pcisph", "time_step": 0.001})


def test_a_rectangle_spins_counterclockwise_besides_its_velocity():
    turning = box([1.0, 0.0], [2.0, 0.6], velocity=[0.3, 0.0], angular_velocity=2.0)
    simulation = Simulation(spinning_bodies(2, turning, box([3.0, 0.0], [3.4, 0.4])), precision="float64")
    arms = simulation.positions[:60] - [1.5, 0.3]
    wanted = np.stack([0.3 - 2.0 * arms[:, 1], 2.0 * arms[:, 0]], axis=1)
    np.testing.assert_allclose(simulation.velocities[:60], wanted, atol=1e-12)
    assert not simulation.velocities[60:].any()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_sphere_spins_where_its_particles_were_packed(axis):
    spin = 3.0 * np.eye(3)[axis]
    ball = {"shape": "sphere", "centre": [1.0, 2.0, 3.0], "radius": 0.3, "angular_velocity": spin.tolist()}
    simulation = Simulation(spinning_bodies(3, ball), precision="float64")
    arms = simulation.positions - simulation.positions.mean(axis=0)
    np.testing.assert_allclose(simulation.velocities, np.cross(spin, arms), atol=1e-12)
    momentum = np.cross(arms, simulation.velocities).sum(axis=0)
    assert momentum[axis] > 0.0 and np.abs(simulation.velocities.mean(axis=0)).max() < 1e-12


def test_the_time_step_knows_how_fast_the_fastest_particle_is():
    still, spinning = (spinning_bodies(2, box([0.0, 0.0], [1.0, 1.0], angular_velocity=w)) for w in (0.0, 50.0))
    assert stability_limits(spinning)["speed"] < stability_limits(still)["speed"]
    greatest = np.linalg.norm(Simulation(spinning).velocities, axis=1).max()
    assert spinning.fluid[0].greatest_speed(0.1) >= (1.0 - 1e-12) * greatest


@pytest.mark.parametrize(
    ("dimension", "spin", "words"), [(2, [1.0, 0.0, 0.0], "one number in 2-D"), (3, 1.0, "a list of 3 components")]
)
def test_wrong_spins_are_sentences(dimension, spin, words):
    with pytest.raises(SceneError, match=words):
        spinning_bodies(dimension, box([0.0] * dimension, [1.0] * dimension, angular_velocity=spin))


def test_a_lattice_that_is_stretched_has_no_more_points_than_its_box_holds():
    """A flume of 13.63 m began with 25 particles too many at a spacing of 0.02 m, and packing moved all of them."""
    for long, spacing, layers in ((13.63, 0.02, 681), (6.97, 0.05, 139), (6.96, 0.05, 139)):
        block = block_filling([0.0, 0.0], [long, 1.0], spacing)
        assert block.counts.tolist() == [layers, round(1.0 / spacing)]
        assert block.size * spacing**2 == pytest.approx(long, rel=EXCESS) and block.size * spacing**2 <= long + 1e-9
