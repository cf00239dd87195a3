"""Quantities of particles that a state decides: their values against twins, and their derivatives."""

import numpy as np
import pytest

import cortado
from bad_tasks import TINY_SCENE
from cortado.cli import main
from cortado.errors import InputError
from cortado.scene.parameters import NAMES, QUANTITIES
from finite_differences import both_modes, distance
from scenes import Squares, jet, plane, scene, simulated, two_layers
from test_moving_solids import ROTOR

PROJECTION = {"kind": "projection", "time_step": 0.0021}
SCENES = {"plane": plane, "space": scene, "two fluids": two_layers, "jet": jet}
SCENES["projection"] = lambda: plane(solver=PROJECTION)

SIZES = [1e-4, 3e-5, 1e-5, 3e-6, 1e-6, 3e-7]


def problem_of(make, name, steps=6, precision="float64", seed=0):
    """A problem whose loss weighs a quantity, a point of it, and a direction there."""
    random = np.random.default_rng(seed)
    simulation = simulated(make(), precision)
    weights = random.uniform(size=simulation.quantity(name).shape)
    gravity, n = np.array(simulation.scene.forces.gravity), simulation.particles
    density = [phase.rest_density for phase in simulation.scene.phase]
    point = {
        "gravity": gravity + random.normal(size=(steps, len(gravity))),
        "initial_velocities": simulation.velocities + 0.3 * random.normal(size=(n, len(gravity))),
        "initial_positions": simulation.positions + 0.001 * random.normal(size=(n, len(gravity))),
        "rest_density": np.array(density if len(density) > 1 else density[0]),
        "time_step": np.array(0.0021),
    }
    if simulation.scene.emitter:
        del point["initial_positions"], point["initial_velocities"]
    sizes = {"gravity": 1.0, "initial_velocities": 0.1, "initial_positions": 1e-3, "rest_density": 3.0}
    along = {name: sizes.get(name, 1e-5) * random.normal(size=value.shape) for name, value in point.items()}
    return cortado.Problem(simulation, steps, Squares({name: weights})), point, along


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("make", SCENES.values(), ids=SCENES)
def test_the_gradient_of_a_quantity_is_that_of_forward_mode_and_of_differences(make, name):
    problem, point, along = problem_of(make, name, steps=4)
    _, derivative = both_modes(problem, point, along, 1e-11)
    assert distance(problem.value, point, along, derivative, SIZES, enough=1e-6) < 1e-6


@pytest.mark.parametrize("make", [plane, lambda: plane(solver=PROJECTION, solid=[ROTOR])])
def test_a_loss_of_several_quantities_has_the_sum_of_their_gradients(make):
    """Of a pressure and a speed: the adjoint of velocities at the start of a step is none of the forces in it."""
    problem, point, along = problem_of(make, "pressure", steps=3)
    both = cortado.Problem(problem.simulation, 3, Squares({**problem.loss.weights, "speed": 1e4}))
    _, derivative = both_modes(both, point, along, 1e-11)
    assert distance(both.value, point, along, derivative, SIZES, enough=1e-6) < 1e-6


@pytest.mark.parametrize(("make", "name"), [("plane", name) for name in NAMES] + [("projection", "pressure")])
def test_in_float32_the_gradient_is_near_that_of_float64(make, name):
    problem, point, _ = problem_of(SCENES[make], name)
    single, _, _ = problem_of(SCENES[make], name, precision="float32")
    (value, wanted), (near, found) = (one.value_and_gradient(point) for one in (problem, single))
    assert near == pytest.approx(value, rel=1e-4)
    bound = 1e-3 if make == "projection" else 2e-3
    assert np.linalg.norm(found["gravity"] - wanted["gravity"]) < bound * np.linalg.norm(wanted["gravity"])


def test_each_scene_of_a_batch_has_its_own():
    problem, point, _ = problem_of(plane, "pressure", steps=4)
    problem.loss.weights |= {"vorticity": 1e3, "wall_force": 1.0}
    batch = cortado.Problem(problem.simulation.batch_of(2), problem.steps, problem.loss)
    other = {**point, "gravity": 0.7 * point["gravity"]}
    both = {key: np.stack([point[key], other[key]]) for key in point}
    values, gradient = batch.value_and_gradient(both)
    along = {key: np.ones_like(value) for key, value in both.items()}
    tangents = batch.tangent(both, along)
    for b, own in enumerate((point, other)):
        value, alone = problem.value_and_gradient(own)
        assert values[b] == value
        for key in alone:
            np.testing.assert_allclose(gradient[key][b], alone[key], rtol=1e-12, atol=1e-12 * np.abs(alone[key]).max())
        wanted = problem.tangent(own, {key: np.ones_like(value) for key, value in own.items()})
        assert tangents[b] == pytest.approx(wanted, rel=1e-11)


def around(simulation, positions):
    """Of all pairs of positions (n, d), and of them and the walls: W and its gradient."""
    lattice, kernel, d = simulation.lattice, simulation.smoothing, simulation.dimension
    for others in (positions, simulation.solver.search.walls["wall_positions"].numpy()[:, :d]):
        apart = positions[:, None] - others[None]
        slope = kernel.gradient(apart.reshape(-1, d), lattice.support).reshape(apart.shape)
        yield kernel.weight(np.linalg.norm(apart, axis=-1), d, lattice.support), slope


@pytest.mark.parametrize("make", [plane, scene])
def test_values_are_those_of_sums_over_all_pairs(make):
    simulation = cortado.Simulation(make(), precision="float64")
    state = simulation.run(5, {"initial_velocities": np.random.default_rng(1).normal(size=simulation.velocities.shape)})
    state, volume = state.last_state, simulation.lattice.volume
    x, v, weights = state["positions"], state["velocities"], simulation.solver.search.walls["wall_weights"].numpy()
    (w, slope), (wall_w, wall_slope) = around(simulation, x)
    n = volume * (w.sum(axis=1) + wall_w @ weights)
    density = simulation.quantity("density", state)
    np.testing.assert_allclose(density, n * state["reference_density"], rtol=1e-12)
    np.testing.assert_allclose(simulation.quantity("speed", state), np.linalg.norm(v, axis=1), rtol=1e-14)

    pressure = simulation.quantity("pressure", state)
    push = simulation.lattice.cell * volume * (pressure / n**2)[:, None] * np.einsum("b,nbd->nd", weights, wall_slope)
    np.testing.assert_allclose(simulation.quantity("wall_force", state), push, atol=1e-12 * np.abs(push).max())

    in_space = ((0, 0), (0, 0), (0, 3 - v.shape[1]))
    crossed = np.cross(np.pad(v[:, None] - v[None], in_space), np.pad(slope, in_space))
    curl = volume * crossed.sum(axis=1) / n[:, None]
    found = simulation.quantity("vorticity", state)
    shown = curl if simulation.dimension == 3 else curl[:, 2]
    factor = (shown * found).sum() / (found**2).sum()
    np.testing.assert_allclose(shown / factor, found, atol=1e-12 * np.abs(found).max())
    assert 0.8 < factor < 1.2


def test_fluid_that_turns_as_a_whole_has_twice_its_rate():
    simulation = cortado.Simulation(plane(container={"shape": "none"}), precision="float64")
    turning = 3.0 * np.stack([-simulation.positions[:, 1], simulation.positions[:, 0]], axis=1)
    state = simulation.state({"initial_velocities": turning})
    inner = np.all(np.abs(simulation.positions - 0.2) < 0.09, axis=1)
    assert inner.any()
    np.testing.assert_allclose(simulation.quantity("vorticity", state)[inner], 6.0, rtol=1e-12)


def test_a_wrong_name_is_told_those_that_there_are():
    simulation = cortado.Simulation(plane())
    known = "positions, velocities, mass_fractions, reference_density, density, pressure, speed"
    with pytest.raises(InputError, match=f"quantity is 'presure', but must be one of {known}"):
        simulation.quantity("presure")
    with pytest.raises(InputError, match="computes no pressure"):
        cortado.Simulation(plane(forces={"pressure": False})).quantity("pressure")
    end = cortado.Problem(simulation, 1, Squares({"density": 1.0})).end({})
    with pytest.raises(InputError, match="a field of a state is 'rho', but must be one of positions, velocities"):
        end["rho"]
    assert np.array_equal(end["velocities"], end.velocities)
    assert end["reference_density"].shape == (simulation.particles,)


def test_a_wrong_adjoint_is_told_what_it_must_be():
    for bar in [{"rho": np.zeros(64)}, {"density": np.zeros(3)}]:
        loss = Squares({"density": 1.0})
        loss.adjoint = lambda end, bar=bar: bar
        problem = cortado.Problem(cortado.Simulation(plane()), 1, loss)
        with pytest.raises(InputError, match="the loss's adjoint"):
            problem.value_and_gradient({"gravity": np.array([0.0, -9.81])})


def test_a_trajectory_is_looked_at_frame_by_frame():
    simulation = cortado.Simulation(plane(), precision="float64")
    gravity = np.linspace(-9.0, -1.0, 7)[:, None] * [0.0, 1.0]
    trajectory = simulation.run(7, {"gravity": gravity}, record_every=3)
    ends = cortado.Problem(simulation, 7, Squares(dict.fromkeys(NAMES, 1.0))).states({"gravity": gravity}, [0, 3, 6, 7])
    for name in NAMES:
        found = simulation.quantity(name, trajectory, {"gravity": gravity})
        assert found.shape == (4, *QUANTITIES[name].shape(simulation.particles, 2))
        for own, end in zip(found, ends.values(), strict=True):
            np.testing.assert_array_equal(own, end[name])
        assert simulation.quantity(name, trajectory[:0]).shape[0] == 0


@pytest.mark.parametrize("make", [plane, two_layers])
def test_recorded_quantities_are_those_of_the_states_and_change_no_other_bit(make, tmp_path):
    simulation = cortado.Simulation(make(), precision="float64")
    bare, found = simulation.run(4, record_every=2), simulation.run(4, record_every=2, record=NAMES)
    assert np.array_equal(bare.positions, found.positions) and not bare.quantities
    for name in NAMES:
        np.testing.assert_array_equal(found.quantity(name), simulation.quantity(name, found))
        np.testing.assert_array_equal(found[2][name], found[1:].quantity(name)[1])
    found.save(tmp_path / "run.vtkhdf")
    read = cortado.Trajectory.load(tmp_path / "run.vtkhdf")
    assert read.quantities.keys() == set(NAMES)
    for name in NAMES:
        np.testing.assert_array_equal(read.quantity(name), found.quantity(name))
    bare.save(tmp_path / "bare.vtkhdf")
    assert not cortado.Trajectory.load(tmp_path / "bare.vtkhdf").quantities
    np.testing.assert_array_equal(simulation.run(1, state=read.last_state).positions[0], found.positions[-1])


def test_recorded_quantities_of_a_batch_beside_a_rotor_are_those_of_its_scenes():
    simulation = cortado.Simulation(plane(solver=PROJECTION, solid=[ROTOR]), precision="float64")
    found = simulation.batch_of(2).run(2, {"gravity": [[[0.0, -9.81]], [[1.0, -5.0]]]}, record=["pressure"])
    for own, gravity in zip(found, ([0.0, -9.81], [1.0, -5.0]), strict=True):
        alone = simulation.run(2, {"gravity": gravity}, record=["pressure"])
        np.testing.assert_array_equal(own.quantity("pressure"), alone.quantity("pressure"))


def test_what_was_not_recorded_is_told_how():
    simulation = cortado.Simulation(plane())
    trajectory = simulation.run(1)
    np.testing.assert_allclose(trajectory[1]["speed"], np.linalg.norm(trajectory.velocities[1], axis=1))
    for call, words in [
        (lambda: trajectory[0]["density"], r'density was not recorded.*record=\["density"\]'),
        (lambda: trajectory.quantity("rho"), "quantity is 'rho', but must be one of positions, velocities, density"),
        (lambda: simulation.run(1, record=["rho"]), "record is 'rho', but must be one of density"),
        (lambda: simulation.run(1, record="density"), "record is 'density', but must be a list of names"),
    ]:
        with pytest.raises(InputError, match=words):
            call()


def test_pictures_are_coloured_by_a_quantity_on_a_scale():
    simulation = cortado.Simulation(plane(picture={"width": 160, "height": 120, "colour": "vorticity"}))
    frame = simulation.run(5, record=["vorticity"])[-1]
    found, plain = simulation.picture(frame), simulation.picture(frame, colour="phase")
    assert found.shape == plain.shape == (120, 160, 3)
    assert np.abs(found - plain).max() > 0.1
    bar = found[41:84, 160 - 4 - 27 - 3]
    assert np.linalg.norm(bar[0] - bar[-1]) > 0.5
    with pytest.raises(InputError, match="density was not recorded"):
        simulation.picture(frame, colour="density")
    with pytest.raises(cortado.SceneError, match="colour"):
        simulation.picture(frame, colour="rho")


def test_the_pictures_of_a_run_are_coloured_by_what_was_not_recorded_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(TINY_SCENE)
    main(["run", "scene.toml", "--steps", "2", "--no-pictures", "--out", "run"])
    small = [word for key in ("width=64", "height=64", "quality=quick") for word in ("--set", f"picture.{key}")]
    for name in ("phase", "speed", "pressure"):
        main(["picture", "run", "--out", f"{name}.png", *small, "--set", f"picture.colour={name}"])
    assert len({(tmp_path / f"{name}.png").read_bytes() for name in ("phase", "speed", "pressure")}) == 3
