"""Runs, restarts, gradients, files and reports know solvers by their protocol, and not PCISPH."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

import cortado
from cortado import InputError, Problem, Simulation, Trajectory, gradients, losses, reference
from cortado.cli.run import RunRequest, run_scene
from cortado.runs.recording import EverySteps
from cortado.scene.parameters import Axis, Parameter
from cortado.scene.solvers import PackageSolver
from cortado.solvers.build import particle_system
from cortado.solvers.particles import ParticleSolver
from finite_differences import both_modes, central_difference
from own_forces import Breeze
from packages import on_path
from scenes import plane, scene, two_layers
from solvers import Falling, MakeExplicit, MakeFalling, MakeRemembering

STEPS = 30
NAMES = ["iterations", "density_errors", "greatest_density_errors"]
MEMORY_NAMES = ["memory_iterations", "memory_errors", "greatest_memory_errors"]


def moving(**changes):
    """Fluid that pushes towards a wall, so that its memory has something to forget."""
    block = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.4], "phase": "water", "velocity": [0.8, 0.1]}
    solver = {"kind": "pcisph", "time_step": 0.0021, "minimum_iterations": 2, "maximum_iterations": 20}
    return plane(**{"fluid": [block], "solver": solver, **changes})


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("make", [moving, two_layers])
def test_a_run_goes_on_with_what_the_solver_carries(make, precision, tmp_path):
    simulation = Simulation(make(), precision=precision, solver=MakeRemembering())
    whole = simulation.run(STEPS)
    assert list(whole.diagnostics) == [*NAMES, *MEMORY_NAMES, "converged"]
    assert len(set(whole.diagnostics["memory_iterations"])) > 1
    assert whole.others["memory"].shape == whole.positions.shape
    first = simulation.run(11)
    first.save(tmp_path / "first.vtkhdf")
    loaded = Trajectory.load(tmp_path / "first.vtkhdf")
    assert loaded.diagnostics.keys() == whole.diagnostics.keys()
    for state in (first.last_state, loaded.last_state):
        rest = simulation.run(STEPS - 11, state=state)
        for name in ("positions", "velocities"):
            assert getattr(rest, name).tobytes() == getattr(whole, name)[11:].tobytes()
        assert rest.others["memory"].tobytes() == whole.others["memory"][11:].tobytes()
        for name, column in rest.diagnostics.items():
            assert column.tobytes() == whole.diagnostics[name][11:].tobytes(), name


def test_what_the_solver_carries_cannot_be_left_out():
    simulation = Simulation(moving(), solver=MakeRemembering())
    state = simulation.run(11).last_state
    forgetful = replace(state, fields={**state.fields, "memory": np.zeros_like(state["memory"])})
    assert simulation.run(5, state=forgetful).positions.tobytes() != simulation.run(5, state=state).positions.tobytes()
    without = replace(state, fields={name: state[name] for name in state.fields if name != "memory"})
    with pytest.raises(InputError, match=r"must have positions, velocities, .*memory"):
        simulation.run(5, state=without)


def number(name):
    return Parameter(name, "", "", Axis.SCALAR, lambda source: 1.0)


def problem_of(steps=12, solver=None, **options):
    simulation = Simulation(moving(), precision="float64", solver=solver or MakeRemembering())
    target = simulation.positions + 0.05 * np.sin(np.arange(simulation.positions.size)).reshape(-1, 2)
    loss = losses.Frames(dict.fromkeys((7, steps), losses.FinalPositions(target)))
    return Problem(simulation, steps, loss, **options)


SCENE = """
dimension = 2
discretisation = {spacing = 0.05}
phase = [{name = "water", rest_density = 1000.0, viscosity = 0.05}]
fluid = [{shape = "box", lower = [0.0, 0.0], upper = [0.4, 0.4], phase = "water", velocity = [0.8, 0.1]}]
container = {shape = "box", lower = [0.0, 0.0], upper = [0.7, 0.8]}
solver = {kind = "KIND", time_step = 0.0021}
"""
POINT = {
    "gravity": np.array([0.4, -9.5]),
    **{"viscosity": np.array(0.06), "time_step": np.array(0.002), "memory.rate": np.array(0.25)},
}


def test_derivatives_go_through_what_the_solver_carries():
    problem = problem_of()
    random = np.random.default_rng(4)
    velocities = problem.simulation.velocities + 0.05 * random.standard_normal((64, 2))
    at = {**POINT, "initial_velocities": velocities}
    along = {"gravity": [1.0, -2.0], "viscosity": 0.01, "time_step": 1e-4, "memory.rate": 0.1}
    along = {name: np.array(value) for name, value in along.items()}
    along["initial_velocities"] = 0.1 * random.standard_normal((64, 2))
    gradient, slope = both_modes(problem, at, along, 1e-12)
    assert len(set(problem.diagnostics["memory_iterations"])) > 1
    _, taped = problem.value_and_gradient(at, gradients.Tape())
    for name in at:
        np.testing.assert_allclose(taped[name], gradient[name], rtol=1e-9, atol=1e-12 * np.abs(gradient[name]).max())
    assert central_difference(problem.value, at, along, 1e-6) == pytest.approx(slope, rel=1e-6)
    assert cortado.certify(problem, {name: POINT[name] for name in ("gravity", "memory.rate")}).right


def test_states_that_are_computed_again_carry_the_same():
    kept, again = problem_of(), problem_of(memory_budget=0)
    assert again._rollout._interval > 1
    for name, gradient in kept.value_and_gradient(POINT)[1].items():
        assert again.value_and_gradient(POINT)[1][name].tobytes() == gradient.tobytes()


def test_an_explicit_solver_is_certified():
    """Without pressure, with forces and two phases; forward mode and the tape agree."""
    made = two_layers(forces={"gravity": [0.3, -2.0, 0.1], "viscosity": "pairwise"})
    simulation = Simulation(made, precision="float64", solver=MakeExplicit(), forces=[Breeze()])
    problem = Problem(simulation, 6, losses.FinalPositions(simulation.positions + 0.01))
    names = ["gravity", "time_step", "viscosity", "breeze.k"]
    assert cortado.certify(problem, names).right
    at = {name: simulation.parameters()[name] for name in names}
    taped, exact = (problem.value_and_gradient(at, one)[1] for one in (gradients.Tape(), gradients.Exact()))
    for name in names:
        np.testing.assert_allclose(taped[name], exact[name], rtol=1e-9)
    slope = sum(float(np.sum(exact[name])) for name in names)
    assert problem.tangent(at, {name: np.ones_like(at[name]) for name in names}) == pytest.approx(slope, rel=1e-9)


def test_a_solver_goes_to_other_processes_and_other_precisions():
    judged = problem_of(solver=MakeRemembering(0.2))
    again = pickle.loads(pickle.dumps(judged))
    assert again.value({}) == judged.value({}) and again.fingerprint == judged.fingerprint
    other = judged.simulation.in_precision("float32")
    assert other.parameters()["memory.rate"] == 0.2 and "memory" in other.state().fields


class Makes:
    """A solver with a setting that is no parameter."""

    def __init__(self, kind, setting=None):
        self.kind, self.setting = kind, setting

    def build(self, setting):
        return self.kind(particle_system(setting))


def test_another_solver_is_another_problem():
    """Also by a setting that is no parameter."""
    loss, stiff = losses.FinalPositions(np.zeros((64, 2))), [Makes(Falling, np.array(k)) for k in (1.0, 2.0, 2.0)]
    makers = (None, MakeFalling(), MakeRemembering(), MakeRemembering(0.2), *stiff)
    found = [Problem(Simulation(moving(), solver=maker), 3, loss).fingerprint for maker in makers]
    assert found[-1] == found[-2] and len(set(found)) == 6


def test_a_state_that_another_solver_carried_is_refused():
    class MakeOther(MakeRemembering):
        pass

    state = Simulation(moving(), solver=MakeRemembering()).run(3).last_state
    with pytest.raises(
        InputError, match=r"additional state fields of the solver MakeRemembering, but must be of .*MakeOther"
    ):
        Simulation(moving(), solver=MakeOther()).run(2, state=state)
    with pytest.raises(InputError, match=r"state has .*memory, .*, but must have positions"):
        Simulation(moving()).run(2, state=state)


def test_a_state_that_nothing_is_carried_in_goes_on_with_any_solver():
    """And lost particles are noticed without loops."""
    state, falling = Simulation(moving()).run(3).last_state, Simulation(moving(), solver=MakeFalling())
    assert falling.run(2, state=state).positions.shape == (3, 64, 2)
    with pytest.raises(cortado.DivergedError) as caught:
        falling.run(60)
    assert caught.value.step > 1 and "left the container" in str(caught.value)


def test_forces_of_ones_own_act_in_a_solver_of_ones_own():
    free = plane(forces={"gravity": [0.0, -9.81], "viscosity": "none", "pressure": False})
    options = {"precision": "float64", "forces": [Breeze()]}
    given, scenes = (Simulation(free, **options, solver=maker).run(5).velocities for maker in (MakeFalling(), None))
    np.testing.assert_allclose(given, scenes, rtol=1e-14)


class Wrong:
    def __init__(self, made, parameters=()):
        self.made, self.parameters = made, parameters

    def build(self, setting):
        return self.made


class Alone:
    """A solver that is none of particles, and takes no forces."""

    def new_state(self):
        raise AssertionError

    new_parameters = new_log = set_substeps = reset = make_room = step = new_state


class Uncounted(Falling):
    def end_step(self, x, v, new_state, log):
        pass


@pytest.mark.parametrize(
    ("solver", "options", "said"),
    [
        (3.0, {}, r"solver is 3.0, but must be an object with a method build\(setting\)"),
        (MakeFalling, {}, "solver is <class .*>, but must be an object"),
        (Wrong(None, "k"), {}, "the solver <.*> has parameters 'k', but must have a list"),
        (Wrong(None, [number("gravity")]), {}, "parameter gravity of a solver has the name of another one"),
        (MakeRemembering(np.nan), {}, "parameter memory.rate has a value that is not finite"),
        (MakeFalling(), {"batch": 2}, "batch is 2, but must be left out, as .* MakeFalling supports no batches"),
        (Makes(ParticleSolver), {}, "build of the solver Makes returned .*, which has no method step, but must have"),
        (Makes(Uncounted), {}, r"solver Uncounted does not count its steps: .* self\.end_step"),
        (Wrong(Alone()), {"forces": [Breeze()]}, "forces is given, but must be left out, as the solver Wrong takes no"),
    ],
)
def test_a_solver_that_does_not_fit_is_a_sentence(solver, options, said):
    with pytest.raises(InputError, match=said):
        Simulation(plane(), solver=solver, **options).run(3)


def run_command(tmp_path, monkeypatch, kind):
    """The folder of a run of 20 steps, and the sentence that the command ends with."""
    on_path(tmp_path, monkeypatch)
    (tmp_path / "scene.toml").write_text(SCENE.replace("KIND", kind))
    out = tmp_path / "out"
    return out, run_scene(tmp_path / "scene.toml", RunRequest(out, steps=20, frames=EverySteps(4)))


def test_the_run_command_reports_any_solver(monkeypatch, tmp_path):
    out, _ = run_command(tmp_path, monkeypatch, "remembering")
    assert (out / "figures" / "density_errors.png").exists() and (out / "report.html").exists()
    rows = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert len(rows) == 20 and {*NAMES, *MEMORY_NAMES, "converged"} <= rows[0].keys()
    trajectory = Trajectory.load(out / "trajectory.vtkhdf")
    assert trajectory.others["memory"].shape == (6, 64, 2)
    assert [row["memory_iterations"] for row in rows] == trajectory.diagnostics["memory_iterations"].tolist()


def test_a_solver_may_have_no_loops(monkeypatch, tmp_path):
    out, sentence = run_command(tmp_path, monkeypatch, "falling")
    assert "The results are in" in sentence and not (out / "figures" / "density_errors.png").exists()
    trajectory = Trajectory.load(out / "trajectory.vtkhdf")
    assert trajectory.diagnostics.keys() == {"converged"} and trajectory.converged.all()
    assert trajectory.not_converged == 0 and len(trajectory.converged) == 20
    for name in ("iterations", "density_errors"):
        with pytest.raises(InputError, match=f"{name} is no diagnostic of this solver, whose diagnostics are conv"):
            getattr(trajectory, name)


def test_a_solver_without_derivatives_says_so():
    problem = Problem(Simulation(plane(), solver=MakeFalling()), 3, losses.FinalPositions(np.zeros((64, 2))))
    at = {"gravity": np.array([0.0, -1.0])}
    estimators = {"reverse mode: try gradients.Tape": gradients.Exact(), "tape: try": gradients.Tape()}
    for what, estimator in estimators.items():
        with pytest.raises(InputError, match=f"the solver MakeFalling has no {what}"):
            problem.value_and_gradient(at, estimator)
    with pytest.raises(InputError, match="no forward mode"):
        problem.tangent(at, at)
    smoothed = gradients.RandomizedSmoothing({"gravity": 0.1}, samples=2)
    assert np.isfinite(problem.value_and_gradient(at, smoothed)[1]["gravity"]).all()


def test_the_reference_engine_is_pcisph_alone():
    made = scene()
    other = made.model_copy(update={"solver": PackageSolver.model_construct(kind="dfsph", time_step=0.002)})
    words = r"solver\.kind is 'dfsph', but must be pcisph or projection for the reference engine"
    with pytest.raises(InputError, match=words):
        reference.Simulation(other)
