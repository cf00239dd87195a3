"""What a Problem promises besides right derivatives: clean state, clear sentences."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import cortado
from bad_scenes import one_sentence
from cortado import CortadoWarning, InputError, Problem, Scene, Simulation, gradients, losses
from cortado.rollout.checkpoints import Checkpoints
from cortado.sph.free_energy import MISCIBLE
from scenes import jet, plane, plane_of_three, splash, two_layers

GRAVITY = {"gravity": np.array([0.0, -9.81, 0.0])}


@pytest.fixture(scope="module")
def simulation():
    return Simulation(splash(), precision="float64")


@pytest.fixture
def problem(simulation):
    return Problem(simulation, 20, losses.FinalPositions(simulation.positions))


def test_problems_and_runs_share_a_simulation(simulation, problem):
    point = {**GRAVITY, "initial_velocities": simulation.velocities}
    wanted = problem.value_and_gradient(point)
    other = Problem(simulation, 8, losses.FinalPositions(np.zeros_like(simulation.positions)))
    other.value_and_gradient({"gravity": np.tile([3.0, -5.0, 1.0], (8, 1)), "viscosity": 0.5}, gradients.Tape())
    simulation.run(10)
    problem.tangent({"viscosity": 0.3}, {"viscosity": 1.0})
    found = problem.value_and_gradient(point)
    assert found[0] == wanted[0]
    for name, gradient in wanted[1].items():
        assert gradient.tobytes() == found[1][name].tobytes()


@pytest.mark.parametrize(("estimator", "steps"), [(gradients.Exact(), 6), (gradients.Tape(), 4)])
def test_an_interruption_leaves_nothing_behind(simulation, estimator, steps, monkeypatch):
    loss, point = losses.FinalPositions(np.zeros((125, 3))), {**GRAVITY, "initial_positions": simulation.positions}
    problem, fresh = (Problem(simulation, steps, loss) for _ in range(2))
    _, wanted = problem.value_and_gradient(point, estimator)
    solver, calls = type(simulation.solver), []
    recorded = solver.write_state

    def interrupted(self, *rest):
        calls.append(1)
        if len(calls) == 2:  # while a graph is captured
            raise KeyboardInterrupt
        recorded(self, *rest)

    monkeypatch.setattr(solver, "write_state", interrupted)
    with pytest.raises(KeyboardInterrupt):
        for _ in range(3):
            fresh.value_and_gradient(point, estimator)
    monkeypatch.undo()
    _, found = fresh.value_and_gradient(point, estimator)
    for name, gradient in wanted.items():
        assert gradient.tobytes() == found[name].tobytes()
    np.testing.assert_array_equal(fresh.iterations(), np.full(steps, 5))


def test_an_adjoint_that_a_loss_keeps_is_not_changed(simulation):
    class Height:
        kept = None

        def value(self, end):
            return float(end.positions[:, 1].sum())

        def adjoint(self, end):
            if self.kept is None:
                self.kept = end.state.like()
                self.kept.set({"positions": np.tile([0.0, 1.0, 0.0], (125, 1))})
            return self.kept

    problem = Problem(simulation, 20, Height())
    first, second = (problem.value_and_gradient(GRAVITY)[1]["gravity"] for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_run_under_parameters_ends_where_the_loss_looks(simulation, problem):
    point = {"gravity": [1.0, -5.0, 0.0], "initial_velocities": simulation.velocities + 0.1, "time_step": 0.002}
    trajectory = problem.run(point, record_every=8)
    np.testing.assert_array_equal(trajectory.steps, [0, 8, 16, 20])
    assert trajectory.times[-1] == pytest.approx(0.04) and trajectory.positions.shape == (4, 125, 3)
    np.testing.assert_array_equal(trajectory.iterations, np.full(20, 5))
    np.testing.assert_array_equal(trajectory.positions[-1], problem.end(point).positions)


def test_targets_and_first_states_cannot_be_changed_behind_the_back(simulation):
    target = np.zeros_like(simulation.positions)
    loss = losses.FinalPositions(target)
    target[:] = 1.0
    assert loss.target.max() == 0.0
    for array in (loss.target, simulation.positions, simulation.velocities):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_fingerprints_tell_problems_apart(simulation, problem):
    others = [
        Problem(simulation, 21, problem.loss),
        Problem(simulation, 20, losses.FinalPositions(simulation.positions + 1.0)),
        Problem(Simulation(splash()), 20, problem.loss),
        Problem(Simulation(splash(time_step=0.002), precision="float64"), 20, problem.loss),
    ]
    assert len({problem.fingerprint, *(other.fingerprint for other in others)}) == 5
    assert problem.fingerprint == Problem(simulation, 20, losses.FinalPositions(simulation.positions)).fingerprint
    scene, own = plane_of_three(), replace(MISCIBLE, name="own")
    made = [Simulation(scene), Simulation(scene, free_energy=own), Simulation(scene, free_energy=MISCIBLE)]
    assert len({Problem(s, 1, losses.FinalPositions(s.positions)).fingerprint for s in made}) == 3


class Wrong(losses.FinalPositions):
    def adjoint(self, end):
        return np.zeros((7, 3)), np.zeros((7, 3))


def without_volume():
    """A run of a scene in which particle 5 has none."""
    simulation = Simulation(plane_of_three())
    fractions = simulation.mass_fractions.copy()
    fractions[5] = [3.0, -2.0, 0.0]
    simulation.run(1, {"mass_fractions": fractions, "rest_density": [1000.0, 100.0, 1000.0]})


@pytest.mark.parametrize("steps", [1, 2, 7, 50, 1000])
def test_checkpoints_fit_where_they_can(steps):
    for affordable in range(1, steps + 2):
        interval = Checkpoints.interval(steps, affordable)
        alive = steps if interval == 1 else -(-steps // interval) + interval
        assert alive <= max(affordable, 2 * np.sqrt(steps) + 3)


def test_without_steps_there_are_no_rows(simulation):
    """And a first state is not overwritten by the next evaluation."""
    problem, x = Problem(simulation, 0, losses.FinalPositions(np.zeros((125, 3)))), simulation.positions
    with pytest.raises(InputError, match=r"has shape \(0, 3\), but must be \(3,\) in"):
        problem.value({"gravity": np.zeros((0, 3))})
    assert not problem.value_and_gradient(GRAVITY)[1]["gravity"].any()
    first = problem.end({"initial_positions": x + 0.01})
    problem.end({"initial_positions": x})
    np.testing.assert_array_equal(first.positions, x + 0.01)


def test_a_forward_pass_is_gone_back_through_after_other_evaluations(problem, simulation):
    point = {**GRAVITY, "viscosity": 0.1}
    _, wanted = problem.value_and_gradient(point)
    forward_pass = problem.forward_pass(point)
    for _ in range(2):
        found = forward_pass.back(gradients.Exact())
        assert found["gravity"].tobytes() == wanted["gravity"].tobytes()
    problem.value({"gravity": [1.0, -5.0, 0.0]})
    found = forward_pass.back(gradients.Exact())
    assert {name: bar.tobytes() for name, bar in found.items()} == {name: bar.tobytes() for name, bar in wanted.items()}
    del forward_pass
    problem.value_and_gradient(GRAVITY)
    assert not problem._rollout.pending  # of evaluations that nobody holds


@pytest.mark.parametrize("budget", [2**30, 0])
@pytest.mark.parametrize("estimator", [gradients.Exact(), gradients.Tape()])
@pytest.mark.parametrize("make", [splash, two_layers, jet, lambda: Simulation(plane(), batch=3)])
def test_interleaved_evaluations_have_the_bits_of_evaluations_in_turn(make, estimator, budget):
    """With other first states, numbers of diffusion substeps and lengths of loops."""
    made = make()
    simulation = made if isinstance(made, Simulation) else Simulation(made)
    problem = Problem(simulation, 7, losses.CentreOfMass(np.zeros(simulation.dimension)), memory_budget=budget)
    v, mu = simulation.velocities, simulation.parameters()["viscosity"]
    points = [
        {"initial_velocities": 0.0 * v + 0.1 * k, "viscosity": 0.0 * mu + 0.05 + 0.1 * k, "time_step": 1e-3 + 3e-4 * k}
        | ({"mobility": 0.05 + 0.3 * k} if len(simulation.scene.phase) > 1 else {})
        for k in range(3)
    ]
    wanted = [problem.value_and_gradient(point, estimator)[1] for point in points]
    passes = [problem.forward_pass(point) for point in points]
    for number in (0, 2, 1, 1, 0):
        found = passes[number].back(estimator)
        for name, bar in wanted[number].items():
            assert found[name].tobytes() == bar.tobytes(), (number, name)


class Overflowing:
    """A loss whose adjoint is beyond all numbers."""

    def value(self, end):
        return 1.0

    def adjoint(self, end):
        bar = end.state.like()
        bar.positions.fill_(np.inf)
        return bar


def test_a_gradient_that_is_not_finite_is_warned_of(simulation):
    with pytest.warns(CortadoWarning, match="gradient with respect to gravity is not finite"):
        Problem(simulation, 3, Overflowing()).value_and_gradient(GRAVITY)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda it: it.value({"gravty": 1.0}), "gravty"),
        (lambda it: it.value({"gravity": np.zeros((59, 3))}), r"shape \(59, 3\), but must be"),
        (lambda it: it.value({"gravity": [0.0, -9.81]}), r"shape \(2,\), but must be"),
        (lambda it: it.value({"viscosity": -1.0}), "must be at least 0"),
        (lambda it: it.value({"rest_density": 0.0}), "must be greater than 0"),
        (lambda it: it.value({"initial_positions": np.zeros((3, 3))}), r"shape \(3, 3\), but must be"),
        (lambda it: it.value({"viscosity": [0.1, 0.2]}), r"shape \(2,\), but must be"),
        (lambda it: it.tangent(GRAVITY, {"speed": 1.0}), "speed"),
        (lambda it: it.value_and_gradient(GRAVITY, gradient=gradients.Exact), "estimator is <class"),
        (lambda it: Problem(it.simulation, 10, np.zeros((125, 3))), "loss"),
        (lambda it: Problem(it.simulation, 2, losses.FinalPositions(np.zeros((7, 3)))).value(GRAVITY), "shape"),
        (lambda it: Simulation(it.simulation.scene, device="gpu7"), "gpu7"),
        (lambda it: it.simulation.run(2, controls={"wind": 1.0}), "wind"),
        (lambda it: it.simulation.run(10**400), r"steps is .*, but must be"),
        (lambda it: it.simulation.run(3, record_every=0), r"record_every is .*, but must be"),
        (lambda it: Problem(it.simulation, 3), r"^Problem is given no loss, but must be called as Problem"),
        (lambda it: cortado.certify(it, nmes=["gravity"]), "certify is called in a wrong way .* 'nmes'"),
        (lambda it: it.simulation.run(number=3), "^Simulation.run is called in a wrong way .*'number'"),
        (lambda it: Problem(it.simulation, 5, Wrong(np.zeros((125, 3)))).value_and_gradient(GRAVITY), r"shape .7, 3"),
        (lambda it: without_volume(), r"^mass_fractions of particle 5 are \[3.0, -2.0, 0.0\], but the sum of"),
        (lambda it: Simulation(plane_of_three(), free_energy="miscible"), "^free_energy is .miscible., but must be a"),
        (lambda it: Simulation(splash(), free_energy=MISCIBLE), r"left out, as the scene has only one phase\.$"),
    ],
)
def test_what_does_not_fit_is_a_sentence(problem, call, said):
    with one_sentence(said) as caught:
        call(problem)
    assert len(str(caught.value)) < 300


def test_a_warning_points_at_the_line_that_led_to_it():
    thin = [{"name": "water", "rest_density": 1.0, "viscosity": 0.05}]
    with pytest.warns(CortadoWarning) as said:
        plane(phase=thin)
        Scene.from_json(plane().to_json().replace("1000.0", "1.0"))
    assert {Path(one.filename).name for one in said} == {"scenes.py", "test_problem.py"}
