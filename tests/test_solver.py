"""Runs, restarts, gradients, files and reports know solvers by their protocol, and not PCISPH."""

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import cortado
from cortado import InputError, Problem, Simulation, Trajectory, gradients, losses, reference
from cortado.commands.run import run_scene
from cortado.scene.model import SOLVERS
from scenes import plane, scene, two_layers
from solvers import build_falling, build_remembering

STEPS = 30
NAMES = ["iterations", "density_errors", "greatest_density_errors"]
MEMORY_NAMES = ["memory_iterations", "memory_errors", "greatest_memory_errors"]


def use(monkeypatch, build):
    """From now on scenes get the solver that ``build`` makes."""
    monkeypatch.setitem(sys.modules, "a_solver", SimpleNamespace(build=build))
    monkeypatch.setitem(SOLVERS, "pcisph", "a_solver")


def moving(**changes):
    """Fluid that pushes towards a wall, so that its memory has something to forget."""
    block = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.4], "phase": "water", "velocity": [0.8, 0.1]}
    solver = {"time_step": 0.0021, "minimum_iterations": 2, "maximum_iterations": 20}
    return plane(**{"fluid": [block], "solver": solver, **changes})


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("make", [moving, two_layers])
def test_a_run_goes_on_with_what_the_solver_carries(monkeypatch, make, precision, tmp_path):
    use(monkeypatch, build_remembering)
    simulation = Simulation(make(), precision=precision)
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


def test_what_the_solver_carries_cannot_be_left_out(monkeypatch):
    use(monkeypatch, build_remembering)
    simulation = Simulation(moving())
    state = simulation.run(11).last_state
    forgetful = replace(state, fields={**state.fields, "memory": np.zeros_like(state["memory"])})
    assert simulation.run(5, state=forgetful).positions.tobytes() != simulation.run(5, state=state).positions.tobytes()
    without = replace(state, fields={name: state[name] for name in state.fields if name != "memory"})
    with pytest.raises(InputError, match=r"must have positions, velocities, .*memory"):
        simulation.run(5, state=without)


def problem_of(steps=12, **options):
    simulation = Simulation(moving(), precision="float64")
    target = simulation.positions + 0.05 * np.sin(np.arange(simulation.positions.size)).reshape(-1, 2)
    return Problem(
        simulation,
        steps,
        losses.Frames({7: losses.FinalPositions(target), steps: losses.FinalPositions(target)}),
        **options,
    )


SCENE = """
dimension = 2
discretisation = {spacing = 0.05}
phase = [{name = "water", rest_density = 1000.0, viscosity = 0.05}]
fluid = [{shape = "box", lower = [0.0, 0.0], upper = [0.4, 0.4], phase = "water", velocity = [0.8, 0.1]}]
container = {shape = "box", lower = [0.0, 0.0], upper = [0.7, 0.8]}
solver = {time_step = 0.0021}
"""
POINT = {"gravity": np.array([0.4, -9.5]), "viscosity": np.array(0.06), "time_step": np.array(0.002)}


def test_derivatives_go_through_what_the_solver_carries(monkeypatch):
    use(monkeypatch, build_remembering)
    problem = problem_of()
    random = np.random.default_rng(4)
    velocities = problem.simulation.velocities + 0.05 * random.standard_normal((64, 2))
    at = {**POINT, "initial_velocities": velocities}
    along = {"gravity": np.array([1.0, -2.0]), "viscosity": np.array(0.01), "time_step": np.array(1e-4)}
    along["initial_velocities"] = 0.1 * random.standard_normal((64, 2))
    _, gradient = problem.value_and_gradient(at)
    assert len(set(problem.diagnostics["memory_iterations"])) > 1
    slope = sum(np.sum(gradient[name] * along[name]) for name in at)
    assert problem.tangent(at, along) == pytest.approx(slope, rel=1e-12)
    _, taped = problem.value_and_gradient(at, gradients.Tape())
    for name in at:
        np.testing.assert_allclose(taped[name], gradient[name], rtol=1e-9, atol=1e-12 * np.abs(gradient[name]).max())
    h = 1e-6
    ends = [problem.value({name: at[name] + sign * h * along[name] for name in at}) for sign in (1.0, -1.0)]
    assert (ends[0] - ends[1]) / (2.0 * h) == pytest.approx(slope, rel=1e-6)


def test_states_that_are_computed_again_carry_the_same(monkeypatch):
    use(monkeypatch, build_remembering)
    kept, again = problem_of(), problem_of(memory_budget=0)
    assert again._rollout._interval > 1
    for name, gradient in kept.value_and_gradient(POINT)[1].items():
        assert again.value_and_gradient(POINT)[1][name].tobytes() == gradient.tobytes()


def test_the_certificate_judges_any_solver(monkeypatch):
    use(monkeypatch, build_remembering)
    assert cortado.certify(problem_of(), {"gravity": POINT["gravity"]}).right


def run_command(tmp_path):
    """The folder of a run of 20 steps, and the sentence that the command ends with."""
    (tmp_path / "scene.toml").write_text(SCENE)
    out = tmp_path / "out"
    settings = {"device": "cpu", "precision": "float32", "record_every": 4, "overwrite": False, "command": []}
    return out, run_scene(tmp_path / "scene.toml", 20, out, overrides=[], **settings)


def test_the_run_command_reports_any_solver(monkeypatch, tmp_path):
    use(monkeypatch, build_remembering)
    out, _ = run_command(tmp_path)
    assert (out / "figures" / "density_errors.png").exists() and (out / "report.html").exists()
    rows = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert len(rows) == 20 and {*NAMES, *MEMORY_NAMES, "converged"} <= rows[0].keys()
    trajectory = Trajectory.load(out / "trajectory.vtkhdf")
    assert trajectory.others["memory"].shape == (6, 64, 2)
    assert [row["memory_iterations"] for row in rows] == trajectory.diagnostics["memory_iterations"].tolist()


def test_a_solver_may_have_no_loops(monkeypatch, tmp_path):
    use(monkeypatch, build_falling)
    out, sentence = run_command(tmp_path)
    assert "The results are in" in sentence and not (out / "figures" / "density_errors.png").exists()
    trajectory = Trajectory.load(out / "trajectory.vtkhdf")
    assert trajectory.diagnostics.keys() == {"converged"} and trajectory.converged.all()
    assert trajectory.not_converged == 0 and len(trajectory.converged) == 20
    for name in ("iterations", "density_errors"):
        with pytest.raises(InputError, match=f"{name} is no diagnostic of this solver, whose diagnostics are conv"):
            getattr(trajectory, name)


def test_lost_particles_are_noticed_without_loops(monkeypatch):
    use(monkeypatch, build_falling)
    with pytest.raises(cortado.DivergedError) as caught:
        Simulation(moving()).run(60)
    assert caught.value.step > 1 and "left the container" in str(caught.value)


def test_a_solver_without_derivatives_says_so(monkeypatch):
    use(monkeypatch, build_falling)
    problem = Problem(Simulation(plane()), 3, losses.FinalPositions(np.zeros((64, 2))))
    at = {"gravity": np.array([0.0, -1.0])}
    estimators = {"reverse mode: try gradients.Tape": gradients.Exact(), "tape: try": gradients.Tape()}
    for what, estimator in estimators.items():
        with pytest.raises(InputError, match=f'solver.kind is "pcisph", which has no {what}'):
            problem.value_and_gradient(at, estimator)
    with pytest.raises(InputError, match="no forward mode"):
        problem.tangent(at, at)
    smoothed = gradients.RandomizedSmoothing({"gravity": 0.1}, samples=2)
    assert np.isfinite(problem.value_and_gradient(at, smoothed)[1]["gravity"]).all()


def test_the_reference_engine_is_pcisph_alone():
    made = scene()
    other = made.model_copy(update={"solver": made.solver.model_copy(update={"kind": "dfsph"})})
    with pytest.raises(InputError, match=r"solver\.kind is 'dfsph', but must be pcisph for the reference engine"):
        reference.Simulation(other)
