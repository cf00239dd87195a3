"""The surface of a fluid: closed, outwards, where its particles are, and the same wherever they are."""

import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial import cKDTree

import cortado
from cortado.device import launching
from cortado.device.launching import BandLauncher
from cortado.errors import ComputationError
from cortado.pictures.exported import contained_liquid, enclosed, with_volume
from cortado.pictures.painter import stage_of
from cortado.pictures.tracing import liquid_surface as liquid_module
from cortado.pictures.tracing.liquid_surface import Mesh, liquid_surface
from cortado.pictures.tracing.near_particles import Particles
from cortado.pictures.tracing.surface_net import Neighbours, smoothed
from scenes import box, scene

SPACING = 0.1


def ball(radius=0.6, centre=(0.0, 0.0, 0.0)):
    axis = np.arange(-radius, radius + SPACING, SPACING)
    lattice = np.stack([one.ravel() for one in np.meshgrid(axis, axis, axis)], axis=1)
    return lattice[np.linalg.norm(lattice, axis=1) < radius] + centre


def surface_of(positions, colours=None):
    colours = np.ones_like(positions) if colours is None else colours
    launch = BandLauncher(wp.get_device("cpu"))
    found = liquid_surface(Particles.on(launch.device, positions, colours), SPACING, launch)
    each = (found.points, found.triangles, found.normals, found.colours)
    points, corners, normals, colours = (one.numpy() for one in each)
    return Mesh(points, corners.reshape(-1, 3), normals, colours)


def mesh_of(surface):
    return trimesh.Trimesh(surface.points, surface.triangles, process=False)


def test_the_surface_of_a_ball_is_round_and_closed():
    positions = ball()
    found = surface_of(positions)
    mesh, away = mesh_of(found), np.linalg.norm(found.points, axis=1)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.euler_number == 2
    volume = len(positions) * SPACING**3
    assert 0.75 * volume < mesh.volume < volume  # it lies up to half a spacing within the fluid
    assert np.ptp(away) < 0.5 * SPACING
    outwards = np.einsum("pk,pk->p", found.normals, found.points / away[:, None])
    assert outwards.min() > 0.97
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0, atol=1e-5)
    assert np.einsum("tk,tk->t", mesh.face_normals, found.normals[found.triangles[:, 0]]).min() > 0.9


def test_every_particle_that_is_alone_is_a_drop():
    places = np.random.default_rng(0).uniform(-4.0, 4.0, (40, 3))
    mesh = mesh_of(surface_of(places))
    assert mesh.body_count == len(places) and mesh.is_watertight
    sizes = [part.volume / SPACING**3 for part in mesh.split()]
    assert min(sizes) > 0.5 and max(sizes) < 3.0


@pytest.mark.parametrize("count", [40, 400])
def test_a_spray_has_no_holes(count):
    """Each side of a triangle is that of another, the other way round; several sheets may share one."""
    found = surface_of(np.random.default_rng(1).random((count, 3)))
    sides = found.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    here, there = (np.sort(one @ [len(found.points), 1]) for one in (sides, sides[:, ::-1]))
    np.testing.assert_array_equal(here, there)


def test_the_lattice_is_fixed_in_space():
    """Other fluid far away does not change a surface; nor does a shift by so many blocks."""
    positions = ball(0.4)
    alone = surface_of(positions)
    both = surface_of(np.concatenate([positions, ball(0.3, (-1.234, 1.1, 0.3))]))
    assert cKDTree(both.points).query(alone.points)[0].max() < 1e-5
    block = 4 * liquid_module.CUBE_WIDTHS[0][1] * SPACING
    moved = surface_of(positions + 7 * block)
    np.testing.assert_allclose(moved.points, alone.points + 7 * block, atol=1e-5)


def test_points_have_the_colours_of_particles_near_them():
    positions = ball()
    colours = np.where(positions[:, :1] > 0.01, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    found = surface_of(positions, colours)
    right, left = found.points[:, 0] > 0.25, found.points[:, 0] < -0.25
    np.testing.assert_allclose(found.colours[right], np.tile((1.0, 0.0, 0.0), (right.sum(), 1)), atol=1e-5)
    np.testing.assert_allclose(found.colours[left], np.tile((0.0, 0.0, 1.0), (left.sum(), 1)), atol=1e-5)
    np.testing.assert_allclose(found.colours.sum(axis=1), 1.0, atol=1e-5)


def test_what_is_far_away_is_left_out_and_what_is_no_number_is_a_sentence():
    positions = ball(0.3)
    alone = surface_of(positions)
    found = surface_of(np.concatenate([positions, [[1e7, 0.0, 0.0], [0.0, -1e9, 0.0]]]))
    np.testing.assert_allclose(found.points, alone.points, atol=1e-6)
    with pytest.raises(ComputationError, match="2 particles cannot be drawn, as their positions are not finite"):
        surface_of(np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [0.0, np.inf, 0.0]]))


def resting(shape, container):
    size = SPACING * np.array(shape)
    if container == "cylinder":
        place = {"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": 0.5 * size[0]}
        fluid, held = {**place, "height": size[1]}, {**place, "height": 2.0 * size[1]}
    else:
        wide = {"pool": [1.0, 2.0, 1.0], "dam": [2.0, 2.0, 1.0]}[container]
        fluid, held = (box([0.0, 0.0, 0.0], (size * times).tolist()) for times in (1.0, np.array(wide)))
    return scene(discretisation={"spacing": SPACING}, fluid=[{**fluid, "phase": "water"}], container=held)


@pytest.mark.parametrize(
    "shape, container",
    [((10, 5, 10), "pool"), ((13, 13, 13), "dam"), ((20, 20, 20), "dam"), ((11, 11, 11), "cylinder")],
)
@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_fluid_at_rest_ends_at_walls_and_has_its_volume(shape, container):
    simulation = cortado.Simulation(resting(shape, container))
    positions = simulation.positions
    found = contained_liquid(stage_of(simulation.scene, positions), positions, np.ones_like(positions))
    mesh = mesh_of(found)
    assert mesh.is_watertight and mesh.volume == pytest.approx(len(positions) * simulation.lattice.cell, rel=0.002)
    size = SPACING * np.array(shape)
    if container == "cylinder":
        np.testing.assert_allclose(np.linalg.norm(found.points[:, ::2], axis=1).max(), 0.5 * size[0], rtol=1e-5)
        assert found.points[:, 1].min() == pytest.approx(0.0, abs=1e-6)
        return
    np.testing.assert_allclose(found.points.min(axis=0), 0.0, atol=1e-6)
    assert found.points[:, 2].max() == pytest.approx(size[2], rel=1e-5)
    on_floor = np.abs(found.points[:, 1]) < 1e-6
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0, atol=1e-5)
    assert np.median(found.normals[on_floor, 1]) == pytest.approx(-1.0, abs=1e-6)


def lattice(*counts):
    axes = [SPACING * (np.arange(count) + 0.13) for count in counts]
    return np.stack([one.ravel() for one in np.meshgrid(*axes, indexing="ij")], axis=1)


RANDOM = np.random.default_rng(0)
APART = 11.3 * lattice(4, 4, 4) + RANDOM.uniform(0.0, 2.0 * SPACING, (64, 3))
FLUIDS = {
    "drops of one particle": APART,
    "sheet": lattice(12, 12, 1),
    "cube": lattice(8, 8, 8),
    "spray in a twentieth of space": RANDOM.uniform(0.0, 16.0 * SPACING, (200, 3)),
    "spray in half of space": RANDOM.uniform(0.0, 12.0 * SPACING, (864, 3)),
    "slab and spray": np.concatenate([lattice(12, 4, 12), RANDOM.uniform([0, 0.5, 0], [1.2, 1.5, 1.2], (200, 3))]),
}


@pytest.mark.parametrize("fluid", FLUIDS)
def test_exported_surfaces_enclose_the_volume_of_the_fluid(fluid):
    positions = FLUIDS[fluid] - 2.0
    stage = stage_of(scene(discretisation={"spacing": SPACING}, container=box([-9.0] * 3, [9.0] * 3)), positions)
    found = contained_liquid(stage, positions, np.ones_like(positions))
    mesh, wanted = mesh_of(found), SPACING**3
    assert mesh.volume == pytest.approx(len(positions) * wanted, rel=0.01)
    assert enclosed(found.points, found.triangles) == pytest.approx(mesh.volume, rel=1e-6)
    if "drops" in fluid:
        each = [part.volume for part in mesh.split()]
        np.testing.assert_allclose(each, len(positions) / 64 * wanted, rtol=0.01)


def test_bodies_of_fluid_are_moved_each_by_its_own_distance():
    """A ball around 100 particles, a block with a hollow, and a flat side that stays; in closed forms."""
    ball = trimesh.creation.icosphere(4, 0.35)
    outer, inner = trimesh.creation.box((1.0, 1.0, 1.0)), trimesh.creation.box((0.4, 0.4, 0.4))
    inner.invert()
    middles = lattice(10, 10, 10) + 0.037 - 0.5
    solid = middles[np.abs(middles).max(axis=1) > 0.25]
    within = middles[np.linalg.norm(middles, axis=1) < 0.3][:100]
    parts = [(ball, [9.0, 0.0, 0.0]), (outer, [0.0, 0.0, 0.0]), (inner, [0.0, 0.0, 0.0])]
    points = np.concatenate([mesh.vertices + shift for mesh, shift in parts])
    ways = np.concatenate([mesh.vertex_normals for mesh, _ in parts])
    ways[-8:] = 0.0
    ways[-16:-8] *= np.sqrt(3.0)  # each side by the same
    begins = np.cumsum([0, len(ball.vertices), 8])
    triangles = np.concatenate([mesh.faces + begin for (mesh, _), begin in zip(parts, begins, strict=True)])
    places = np.concatenate([within + [9.0, 0.0, 0.0], solid])
    moved = with_volume(points, triangles, ways, places, SPACING, lambda points: points)
    radius = (len(within) * SPACING**3 / (ball.volume / 0.35**3)) ** (1.0 / 3.0)
    away = np.linalg.norm(moved[: len(ball.vertices)] - [9.0, 0.0, 0.0], axis=1)
    np.testing.assert_allclose(away, radius, rtol=2e-3)
    side = (len(solid) * SPACING**3 + 0.4**3) ** (1.0 / 3.0)
    np.testing.assert_allclose(np.abs(moved[-16:-8]), 0.5 * side, rtol=1e-9)
    np.testing.assert_array_equal(moved[-8:], points[-8:])


@pytest.mark.parametrize("rounds", [0, 5])
def test_values_are_smoothed_to_and_fro_however_launches_are_made(rounds, monkeypatch):
    """Towards the mean of neighbours on a ring, as NumPy does; what is given stays as it is."""
    launch, given = BandLauncher(wp.get_device("cpu")), np.random.default_rng(0).random((50, 3)).astype(np.float32)
    ring = np.full((50, 6), -1, dtype=np.int32)
    ring[:, 0], ring[:, 3] = np.roll(np.arange(50), 1), np.roll(np.arange(50), -1)
    neighbours, halves = wp.array(ring, dtype=Neighbours), wp.full(50, 0.5, dtype=wp.float32)
    wanted = given
    for _ in range(rounds):
        wanted = 0.5 * wanted + 0.25 * (np.roll(wanted, 1, axis=0) + np.roll(wanted, -1, axis=0))
    for least in (0, 1000):
        monkeypatch.setattr(launching, "LEAST_SHARED_OFTEN", least)
        values = wp.array(given, dtype=wp.vec3)
        np.testing.assert_allclose(smoothed(values, neighbours, halves, rounds, launch).numpy(), wanted, atol=1e-6)
        np.testing.assert_array_equal(values.numpy(), given)
