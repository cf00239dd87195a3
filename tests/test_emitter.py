"""Emitters: led particles move as the nozzle says, are let go without a jump, and every gradient is right."""

import warnings
from functools import cache

import numpy as np
import pytest

from bad_scenes import one_sentence
from cortado import CortadoWarning, InputError, Problem, Scene, Simulation, losses
from finite_differences import both_modes, decades, distance
from scenes import Weighed, box, jet, plane, pour, scene
from twins import nozzle_of

STEPS = 30

MAKERS = {"jet": jet, "pour": pour}
scenes = pytest.mark.parametrize("name", MAKERS)
SIZES = {"nozzle.path": 0.01, "nozzle.flow_rate": 0.1, "time_step": 1e-4}
"""Size of a direction of each parameter; of the flow rate relative to it."""
DISTURBED = {"gravity": 1.0, "initial_positions": 0.01, "initial_velocities": 0.1}


@cache
def problem_of(name):
    simulation = Simulation(MAKERS[name](), precision="float64")
    return Problem(simulation, STEPS, Weighed(simulation))


def point_of(problem):
    simulation, random = problem.simulation, np.random.default_rng(3)
    own = simulation.parameters()
    time = np.arange(STEPS)[:, None] / STEPS  # from its place at rest
    path = own["nozzle.path"] + 0.02 * np.sin(time * np.arange(2.0, 2.0 + len(own["nozzle.path"])))
    x = own["initial_positions"]
    own |= {"nozzle.path": path, "initial_positions": x + 0.001 * random.standard_normal(x.shape)}
    own["initial_velocities"] = own["initial_velocities"] + 0.1 * random.standard_normal(x.shape)
    names = ("nozzle.path", "nozzle.flow_rate", "time_step", "gravity", "initial_positions", "initial_velocities")
    return {name: own[name] for name in names}


def direction_of(name, value):
    direction = np.random.default_rng(4).standard_normal(value.shape)
    size = {**SIZES, **DISTURBED}[name] * (value if name == "nozzle.flow_rate" else 1.0)
    return size * direction / np.linalg.norm(direction)


def released(problem, point, frames):
    """(m,) distance before the opening [m] after a number of steps; negative once let go."""
    nozzle = nozzle_of(problem.simulation)
    return nozzle.sample.upstream - float(point["nozzle.flow_rate"]) / nozzle.area * frames * float(point["time_step"])


@scenes
@pytest.mark.parametrize("key", ["nozzle.path", "all"])
def test_gradient_equals_tangent_and_differences(name, key):
    """Of a path that has a row for each step; a place at rest is in tests/test_features.py. Some particles are let go,
    and none earlier or later over the steps of differences."""
    problem = problem_of(name)
    point = point_of(problem)
    left = released(problem, point, np.arange(STEPS + 1)[:, None])
    assert (left[-1] < 0.0).sum() >= 4 and (left[-1] > 0.0).sum() >= 4
    assert np.abs(left).min() > 1e-2 * -np.diff(left[:, 0])[0]
    directions = {k: direction_of(k, value) for k, value in point.items() if key in ("all", k)}
    gradient, tangent = both_modes(problem, point, directions)
    assert all(gradient[k].shape == value.shape for k, value in point.items())
    assert distance(problem.value, point, directions, tangent, decades(2.0, 7.0), enough=1e-7) < 1e-6


@scenes
def test_led_particles_follow_the_formula(name):
    problem = problem_of(name)
    point, simulation = point_of(problem), problem.simulation
    trajectory = problem.run(point)
    nozzle, dt = nozzle_of(simulation), float(point["time_step"])
    speed, path = float(point["nozzle.flow_rate"]) / nozzle.area, point["nozzle.path"]
    assert speed == pytest.approx(simulation.scene.emitter[0].speed(simulation.scene.discretisation.spacing))
    for n in range(1, STEPS + 1):
        left = released(problem, point, n)
        led = left > 0.0
        x, v = trajectory.positions[n][nozzle.first :], trajectory.velocities[n][nozzle.first :]
        place = path[n - 1] + nozzle.sample.offsets - left[:, None] * nozzle.direction
        before = path[max(n - 2, 0)]
        np.testing.assert_allclose(x[led], place[led], rtol=0, atol=1e-14)
        wanted = (path[n - 1] - before) / dt + speed * nozzle.direction
        np.testing.assert_allclose(v[led], np.broadcast_to(wanted, v[led].shape), rtol=0, atol=1e-12)


@scenes
def test_particles_are_let_go_without_a_jump(name):
    """High above the pool they go on with the velocity that they were led with, but for one step of small forces."""
    low = MAKERS[name]().emitter[0].model_dump()
    high = {**low, "outlet": [*low["outlet"][:1], 0.45, *low["outlet"][2:]]}
    simulation = Simulation(MAKERS[name](emitter=[high], container={"shape": "none"}), precision="float64")
    problem = Problem(simulation, STEPS, Weighed(simulation))
    point = {key: value for key, value in simulation.parameters().items() if key in SIZES}
    trajectory = problem.run(point)
    first, dt = nozzle_of(problem.simulation).first, float(point["time_step"])
    seen = 0
    for n in range(1, STEPS + 1):
        free = (released(problem, point, n - 1) > 0.0) & (released(problem, point, n) <= 0.0)
        x_before, x = trajectory.positions[n - 1 : n + 1, first:][:, free]
        v_before, v = trajectory.velocities[n - 1 : n + 1, first:][:, free]
        np.testing.assert_allclose(x - x_before, dt * v, rtol=0, atol=1e-14)
        assert np.linalg.norm(v - v_before, axis=1).max(initial=0.0) < 0.05 * np.linalg.norm(v, axis=1).max(initial=1.0)
        seen += free.sum()
    assert seen >= 4


@pytest.mark.parametrize("direction", [[0.0, -1.0, 0.0], [1.0, 2.0, -0.5]])
def test_without_forces_the_column_goes_straight_on(direction):
    nozzle = {"phase": "water", "outlet": [0.1, 0.6, 0.2], "radius": 0.06, "length": 0.2, "flow_rate": 0.01}
    made = scene(
        emitter=[{**nozzle, "direction": direction}],
        container={"shape": "none"},
        forces={"gravity": [0.0, 0.0, 0.0], "viscosity": "none", "pressure": False},
    )
    simulation = Simulation(made, precision="float64")
    sample, emitter = made.emitter[0].sample(0.05), nozzle_of(simulation)
    trajectory = simulation.run(40)
    unit = np.array(direction) / np.linalg.norm(direction)
    travelled = sample.speed * trajectory.times[:, None, None] * unit
    assert sample.speed * trajectory.times[-1] > 0.075
    x, v = trajectory.positions[:, emitter.first :], trajectory.velocities[:, emitter.first :]
    np.testing.assert_allclose(x, sample.positions + travelled, rtol=0, atol=1e-13)
    np.testing.assert_allclose(v - sample.speed * unit, 0.0, rtol=0, atol=1e-12)


def supplied(**emitter):
    """A slower jet with two layers in line, which are out after 0.15 s, or with other keys."""
    return jet(emitter=[{**jet().emitter[0].model_dump(), "length": 0.1, "flow_rate": 0.1, **emitter}])


def test_a_reserve_joins_the_column_for_as_long_as_the_run_goes():
    dry, time = supplied(), 0.252
    made = dry.lasting(time)
    assert made.lasting(2.0) is made and dry.lasting(0.15) is dry
    sample, spacing = made.emitter[0].sample(0.05), 0.05
    came = made.emitter[0].flow_rate * time / spacing**2
    with pytest.warns(CortadoWarning, match=r"nozzle runs dry at 0.15 s of a run to 0.252 s, .*: scene.lasting\(0.252"):
        Simulation(dry, precision="float64").run(time=time)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulation = Simulation(made, precision="float64")
        trajectory = simulation.run(time=time)
    gone = sample.upstream <= float(trajectory.others["nozzle.emitted"][-1, 0]) * (1.0 + 1e-9)
    assert came - sample.layer <= gone.sum() <= came and len(gone) >= came + 2 * sample.layer
    led = trajectory.positions[:, nozzle_of(simulation).first :]
    line = sample.upstream - sample.speed * trajectory.times[:, None]
    place = np.add(made.emitter[0].outlet, sample.offsets) - line[..., None] * np.array(made.emitter[0].direction)
    aside = nozzle_of(simulation).places[nozzle_of(simulation).first :]
    place = np.where((line > sample.column + 1e-9)[..., None], aside, place)
    np.testing.assert_allclose(led[line > 1e-9], place[line > 1e-9], rtol=0, atol=1e-12)
    waiting = led[line > sample.column + 1e-9]
    assert (np.abs(waiting - 0.5 * np.array(made.container.upper)) > 0.5 * np.array(made.container.upper)).all()


def test_a_run_says_when_its_emitter_runs_dry():
    """One with a volume, and one where all axes are periodic, which leaves no place for a reserve."""
    room = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.6, 0.8], "periodic": [True, True]}
    slot = {**supplied().emitter[0].model_dump(), "direction": [1.0, 0.0]}
    for made, name in ((supplied(volume=0.02), "volume"), (jet(emitter=[slot], fluid=[], container=room), "length")):
        assert made.lasting(1.0) is made
        with pytest.warns(CortadoWarning, match=f"runs dry at .*: a larger emitter\\[0\\].{name} gives more fluid"):
            Simulation(made, precision="float64").run(time=0.252)


def test_a_run_goes_on_with_the_reserve_of_the_run_before():
    made = supplied().lasting(0.2)
    simulation = Simulation(made)
    whole, half = simulation.run(STEPS), simulation.run(STEPS // 2)
    again = Simulation(supplied().going_on(half.last_state))
    rest = again.run(STEPS - STEPS // 2, state=half.last_state)
    assert rest.positions[-1].tobytes() == whole.positions[-1].tobytes()


MISTAKES = {
    "parameter nozzle.path has shape (3,), but must be (2,) or (30, 2) in m": {"nozzle.path": [0.1, 0.2, 0.3]},
    "parameter nozzle.flow_rate is -0.1, but must be at least 0": {"nozzle.flow_rate": -0.1},
}


@pytest.mark.parametrize("words", MISTAKES)
def test_a_mistake_is_a_sentence(words):
    with one_sentence() as caught:
        problem_of("jet").value(MISTAKES[words])
    assert str(caught.value).startswith(words)


@pytest.mark.parametrize("value", [{"nozzle.path": [0.1, 0.2]}, {"nozzle.flow_rate": 0.1}])
def test_without_an_emitter_its_parameters_are_a_sentence(value):
    simulation = Simulation(plane(), precision="float64")
    problem = Problem(simulation, 2, losses.FinalPositions(simulation.positions))
    gravity = {"gravity": [0.0, -9.81]}
    for use in (problem.value, lambda own: problem.tangent(gravity, own), lambda own: simulation.run(2, controls=own)):
        with pytest.raises(InputError, match="nozzle"):
            use(value)
    assert value.keys().isdisjoint(simulation.parameters())


def test_a_column_in_a_wall_is_named_where_the_pressure_does_not_converge():
    """Its particles cannot move away from a wall that presses on them."""
    nozzle = {"phase": "water", "outlet": [0.25, 0.3], "radius": 0.03, "flow_rate": 0.06}
    water = [{"name": "water", "rest_density": 1000.0, "viscosity": 0.05}]
    tables = {"discretisation": {"spacing": 0.01}, "phase": water, "solver": {"kind": "pcisph", "time_step": 0.001}}
    tables |= {"fluid": [], "container": box([0.0, 0.0], [0.5, 0.4])}
    with pytest.warns(CortadoWarning, match=r"did not converge.*Shorten emitter\[0\]\.length"):
        Simulation(plane(**tables, emitter=[{**nozzle, "length": 0.3}])).run(3)
    with warnings.catch_warnings():
        warnings.simplefilter("error", CortadoWarning)
        Simulation(plane(**tables, emitter=[{**nozzle, "length": 0.1}])).run(3)


def test_a_column_is_jittered_along_its_opening_with_the_projection_alone_or_as_it_is_given():
    lattice, projected = (pour(**solver) for solver in ({}, {"solver": {"kind": "projection", "time_step": 0.002}}))
    spacing = lattice.discretisation.spacing
    assert (lattice.emitter[0].jitter, projected.emitter[0].jitter) == (0.0, 0.05)
    known, found = (one.emitter[0].sample(spacing) for one in (lattice, projected))
    np.testing.assert_array_equal(found.upstream, known.upstream)
    moved = found.offsets - known.offsets
    np.testing.assert_allclose(moved @ np.array(lattice.emitter[0].direction), 0.0, atol=1e-15)
    assert 0.03 * spacing < np.linalg.norm(moved, axis=1).max() <= 0.05 * np.sqrt(2.0) * spacing
    np.testing.assert_array_equal(projected.emitter[0].sample(spacing).positions, found.positions)
    lower, upper = projected.emitter[0].extent(spacing)
    assert (lower <= found.positions + 1e-12).all() and (found.positions <= upper + 1e-12).all()
    assert Scene.from_json(projected.to_json()) == projected
    solver = {"kind": "projection", "time_step": 0.002}
    nozzle = pour().emitter[0].model_dump(exclude={"jitter"})
    assert pour(solver=solver, emitter=[{**nozzle, "jitter": 0.0}]).emitter[0].jitter == 0.0
    assert pour(emitter=[{**nozzle, "jitter": 0.1}]).emitter[0].jitter == 0.1
