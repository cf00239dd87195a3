"""Emitters: where their particles are, how fast, how many, and after which others they come."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from bad_scenes import plane
from cortado import CortadoWarning, Problem, Scene, SceneError, Simulation, losses
from cortado.discretise.shapes import disc
from cortado.scene.fluid_particles import fluid_particles
from finite_differences import central_difference
from scenes import bodies, box, stability_limit

SPACING = 0.05
NOZZLE = {"phase": "water", "outlet": [0.1, 0.6, 0.2], "radius": 0.12, "length": 0.3, "flow_rate": 2e-3}
SLOT = {"phase": "water", "outlet": [0.5, 2.0], "radius": 0.25, "length": 0.7, "flow_rate": 0.3}


def space(**emitter) -> Scene:
    block = box([0, 0, 0], [0.2, 0.1, 0.2], phase="oil", velocity=[1, 0, 0])
    phases = [{"name": name, "rest_density": 1000, "viscosity": 0.0} for name in ("water", "oil")]
    return bodies(3, [block], None, SPACING, phase=phases, emitter=[NOZZLE | emitter])


@pytest.mark.parametrize("direction", [[1, 0, 0], [0, 0, 3], [1, -2, 0.5], [-1, -1, -1]])
def test_a_column_is_a_lattice_along_its_axis(direction):
    scene = space(direction=direction)
    assert np.linalg.norm(scene.emitter[0].direction) == pytest.approx(1.0, rel=1e-15)
    assert Scene.from_json(scene.to_json()) == scene
    sample = scene.emitter[0].sample(SPACING)
    unit = np.array(direction) / np.linalg.norm(direction)
    from_outlet = sample.positions - NOZZLE["outlet"]
    np.testing.assert_allclose(-from_outlet @ unit, sample.upstream, atol=1e-14)
    np.testing.assert_allclose(from_outlet + np.outer(sample.upstream, unit), sample.offsets, atol=1e-14)
    np.testing.assert_allclose(sample.offsets @ unit, 0.0, atol=1e-14)
    np.testing.assert_allclose(sample.velocities, np.tile(sample.speed * unit, (len(from_outlet), 1)), rtol=1e-14)
    layers = np.split(sample.offsets, 6)
    np.testing.assert_allclose(sample.upstream, np.repeat(SPACING * (np.arange(6) + 0.5), sample.layer))
    assert all((layer == layers[0]).all() for layer in layers)
    np.testing.assert_allclose(cKDTree(from_outlet).query(from_outlet, k=2)[0][:, 1], SPACING)
    assert cKDTree(layers[0]).query(-layers[0])[0].max() < 1e-14  # symmetric about the axis
    assert 0.08 < np.linalg.norm(layers[0], axis=1).max() <= NOZZLE["radius"]


@pytest.mark.parametrize("radius, count", [(0.01, 1), (0.05, 4), (0.075, 9), (0.09, 9), (0.12, 16)])
def test_a_disc_has_a_particle_at_least(radius, count):
    assert len(disc(radius, SPACING, 2)) == count
    assert len(disc(radius, SPACING, 1)) == max(int(2 * radius / SPACING + 1e-6), 1)


@pytest.mark.parametrize("length, layers", [(0.026, 1), (0.05, 1), (0.075, 1), (0.076, 2), (0.3, 6), (0.33, 7)])
def test_a_layer_counts_if_its_middle_is_within_the_length(length, layers):
    assert space(length=length).emitter[0].sample(SPACING).upstream[-1] == pytest.approx(SPACING * (layers - 0.5))


@pytest.mark.parametrize("scene, spacing", [(space(), SPACING), (Scene(**plane(emitter=[SLOT])), 0.1)])
def test_the_volume_that_comes_out_is_exact(scene, spacing):
    (emitter,), cell = scene.emitter, spacing**scene.dimension
    sample = emitter.sample(spacing)
    duration = len(sample.upstream) // sample.layer * spacing / sample.speed
    assert len(sample.upstream) * cell == pytest.approx(emitter.flow_rate * duration, rel=1e-14)
    assert emitter.speed(spacing) == sample.speed
    assert emitter.count(spacing) >= len(sample.positions)
    lower, upper = emitter.extent(spacing)
    np.testing.assert_allclose(lower, sample.positions.min(axis=0), atol=1e-14)
    np.testing.assert_allclose(upper, sample.positions.max(axis=0), atol=1e-14)


def test_in_the_plane_the_cross_section_is_a_line():
    (emitter,) = Scene(**plane(emitter=[SLOT])).emitter
    sample = emitter.sample(0.1)
    assert emitter.direction == (0.0, -1.0)
    assert (sample.layer, sample.positions.shape, sample.offsets.shape) == (5, (35, 2), (35, 2))
    np.testing.assert_allclose(sample.positions[:5], [[0.5 + 0.1 * a, 2.05] for a in (-2, -1, 0, 1, 2)])
    np.testing.assert_allclose(sample.velocities, np.tile([0.0, -0.3 / 0.5], (35, 1)))


def test_emitted_particles_come_last():
    scene = space(direction=[1, -2, 0.5])
    sample = fluid_particles(scene)
    ((name, first, own),) = sample.emitters
    assert (name, first) == ("nozzle", 32) and sample.emitted == slice(32, 32 + len(own.upstream))
    np.testing.assert_array_equal(sample.positions[sample.emitted], own.positions)
    np.testing.assert_array_equal(sample.velocities[sample.emitted], own.velocities)
    np.testing.assert_array_equal(sample.velocities[:32], np.tile([1.0, 0.0, 0.0], (32, 1)))
    assert set(sample.phase[:32]) == {1} and set(sample.phase[sample.emitted]) == {0}
    assert len(sample.phase) == len(sample.velocities) == len(sample.positions)
    without = fluid_particles(Scene(**plane()))
    assert not without.emitters and len(without.positions[without.emitted]) == 0


def test_a_column_may_be_outside_upstream_but_not_beside():
    room = {"shape": "box", "lower": [0, 0, 0], "upper": [0.3, 0.6, 0.4]}
    inside = Scene(**(space().model_dump() | {"container": room}))
    assert fluid_particles(inside).positions[:, 1].max() > 0.8
    with pytest.raises(SceneError, match=r"emitter\[0\]\.radius is 0\.12, but must be so small that the opening is"):
        Scene(**(space(outlet=[0.05, 0.6, 0.2]).model_dump() | {"container": room}))


def test_an_emitter_counts_for_the_stability_limit():
    still = {"gravity": [0.0, 0.0], "viscosity": "none"}
    fast = SLOT | {"flow_rate": 2.0}
    assert stability_limit(Scene(**plane(emitter=[fast], forces=still))) == pytest.approx(0.4 * 0.2 / 4.0)
    fall = np.sqrt(2 * 9.81 * 2.0)  # from the outlet to the foot of the fluid
    assert stability_limit(Scene(**plane(emitter=[fast]))) == pytest.approx(0.4 * 0.2 / (4.0 + fall))
    honey = [{"name": "water", "rest_density": 1000, "viscosity": 0.0}]
    honey += [{"name": "honey", "rest_density": 1400, "viscosity": 1e5}]
    with pytest.warns(CortadoWarning, match="limit of stability"):
        scene = Scene(**plane(emitter=[SLOT | {"phase": "honey"}], phase=honey, forces={"viscosity": "pairwise"}))
        thick = [honey[0], honey[1] | {"viscosity": 2e5}]
        thicker = Scene(**plane(emitter=[SLOT | {"phase": "honey"}], phase=thick, forces={"viscosity": "pairwise"}))
    assert stability_limit(scene) == pytest.approx(2.0 * stability_limit(thicker))
    assert stability_limit(scene) < 0.06 * 0.2**2 * 1000 / 1e5


@pytest.mark.filterwarnings("ignore::cortado.errors.CortadoWarning")  # the jet does not converge
@pytest.mark.parametrize("container", [{"shape": "box", "lower": [0, 0], "upper": [1, 2]}, {"shape": "none"}])
def test_a_scene_may_be_filled_by_its_emitter_alone(container):
    tap, solver = SLOT | {"flow_rate": 0.5, "outlet": [0.5, 1.5]}, {"kind": "pcisph", "time_step": 0.004}
    scene = bodies(2, [], container, SPACING, 0.1, emitter=[tap], solver=solver)
    limits = {"none": 0.25 * np.sqrt(2 * SPACING / 9.81), "box": 0.8 * SPACING / (1.0 + np.sqrt(4 * 9.81))}
    assert stability_limit(scene) == pytest.approx(limits[container["shape"]])
    simulation = Simulation(scene, precision="float64")
    column = simulation.positions
    assert simulation.free_particles == 0 and len(column) == 140
    last = simulation.run(30)[-1].positions
    moved = np.linalg.norm(last - column, axis=1)
    assert (last[:, 1] < 1.5).sum() == 20 and moved.min() == pytest.approx(0.12)
    problem = Problem(simulation, 30, losses.FinalPositions(column))
    at = {"nozzle.flow_rate": np.array(0.51)}
    _, gradient = problem.value_and_gradient(at)
    difference = central_difference(problem.value, at, {"nozzle.flow_rate": 1.0}, 1e-6)
    assert gradient["nozzle.flow_rate"] == pytest.approx(difference, rel=1e-5)
