"""Many scenes in one launch: each has the bits of its single run, whatever the others do; with more that a scene may
have in tests/test_features.py."""

from typing import Any

import numpy as np
import pytest

import cortado
import scenes
from cortado import CortadoWarning, InputError, Problem, Simulation, gradients
from cortado.losses import CentreOfMass, FinalPositions, Frames

STEPS = 8
FREE = {"kind": "pcisph", "time_step": 0.0021, "minimum_iterations": 3, "maximum_iterations": 12}
FREE |= {"density_tolerance": 1e-3}
"""As many pressure iterations as a scene needs, which differ between the scenes of a batch."""
RANDOM = np.random.default_rng(3)
ESTIMATORS = [gradients.Exact(), gradients.AdjointViscosity(20.0, order=2), gradients.Tape()]


def random_gravity(size: float, batch: int, rows: int, dimension: int = 3) -> np.ndarray:
    return size * RANDOM.standard_normal((batch, rows, dimension)) - 9.0 * np.eye(dimension)[1]


def layers() -> Any:
    return scenes.two_layers(solver=FREE)


CASES: dict[str, tuple[Any, dict[str, Any], dict[str, Any]]] = {
    "gravity": (scenes.plane, {"gravity": random_gravity(3.0, 4, 1, 2)}, {}),
    "iterations": (
        lambda: scenes.scene(solver=FREE),
        {"gravity": random_gravity(8.0, 5, STEPS), "time_step": RANDOM.uniform(0.001, 0.003, 5)},
        {"viscosity": 0.1},
    ),
    "mixture": (
        layers,
        {"viscosity": RANDOM.uniform(0.1, 1.0, (3, 2)), "rest_density": RANDOM.uniform(900.0, 1500.0, (3, 2))},
        {"mobility": 0.1, "interface_width": 0.04},
    ),
    "jet": (scenes.jet, {"nozzle.flow_rate": RANDOM.uniform(0.2, 0.4, (3, STEPS))}, {"time_step": 0.002}),
    "pour": (
        scenes.pour,
        {"nozzle.path": np.array([0.09, 0.17, 0.12]) + RANDOM.uniform(-0.02, 0.02, (3, STEPS, 3))},
        {"gravity": np.tile([0.0, -9.0, 0.0], (STEPS, 1))},
    ),
    "tilt": (scenes.scene, {"tilt": RANDOM.uniform(-20.0, 20.0, (3, STEPS, 2))}, {}),
}


def member(values: dict[str, Any], b: int) -> dict[str, Any]:
    """Of one scene; a single row stands for all steps."""
    return {
        name: value[b, 0] if np.ndim(value) == 3 and np.shape(value)[1] == 1 else value[b]
        for name, value in values.items()
    }


def loss_of(simulation: Simulation) -> Frames:
    return Frames({STEPS: FinalPositions(simulation.positions), 5: CentreOfMass(np.full(simulation.dimension, 0.1))})


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("case", CASES)
def test_a_scene_of_a_batch_has_the_bits_of_its_single_run(case, precision):
    make, own, shared = CASES[case]
    batch = len(next(iter(own.values())))
    alone, together = Simulation(make(), precision=precision), Simulation(make(), precision=precision, batch=batch)
    single, problem = Problem(alone, STEPS, loss_of(alone)), Problem(together, STEPS, loss_of(alone))
    loss, gradient = problem.value_and_gradient({**own, **shared})
    np.testing.assert_array_equal(problem.value({**own, **shared}), loss)
    runs = problem.run({**own, **shared}, record_every=3)
    assert loss.shape == (batch,) and len(runs) == batch
    assert len(set(loss)) == batch
    for b in range(batch):
        given = {**member(own, b), **shared}
        wanted, wanted_gradient = single.value_and_gradient(given)
        assert wanted == loss[b]
        for name, bar in wanted_gradient.items():
            np.testing.assert_array_equal(gradient[name][b].reshape(bar.shape), bar)
            assert bar.any()
        run = single.run(given, record_every=3)
        np.testing.assert_array_equal(runs[b].positions, run.positions)
        np.testing.assert_array_equal(runs.positions[:, b], run.positions)
        np.testing.assert_array_equal(runs[b].times, run.times)
        for name, column in run.diagnostics.items():
            np.testing.assert_array_equal(runs[b].diagnostics[name], column)


def assert_same(one: Problem, other: Problem, given: dict[str, Any]) -> None:
    """Values and gradients of two problems are the same."""
    (values, gradient), (wanted, wanted_gradient) = (each.value_and_gradient(given) for each in (one, other))
    np.testing.assert_array_equal(values, wanted)
    for name, bar in wanted_gradient.items():
        np.testing.assert_array_equal(gradient[name], bar)


class _OneByOne:
    """A loss without what it has for whole batches."""

    def __init__(self, loss):
        self.value, self.value_and_adjoint = loss.value, loss.value_and_adjoint


def test_a_loss_of_all_scenes_at_once_has_the_bits_of_one_by_one(precision="float64"):
    make, own, shared = CASES["iterations"]
    simulation = Simulation(make(), precision=precision, batch=len(next(iter(own.values()))))
    loss = FinalPositions(Simulation(make(), precision=precision).positions)
    assert_same(*(Problem(simulation, STEPS, each) for each in (loss, _OneByOne(loss))), {**own, **shared})


def test_a_loss_of_all_scenes_at_once_is_checked():
    make, own, shared = CASES["iterations"]
    simulation = Simulation(make(), batch=len(next(iter(own.values()))))
    loss = FinalPositions(Simulation(make()).positions)
    loss.values = lambda end: 1.0
    with pytest.raises(InputError, match=r"the loss's values has shape \(\), but must be \(\d,\)"):
        Problem(simulation, STEPS, loss).value({**own, **shared})


def test_scenes_of_a_batch_iterate_as_often_as_each_needs():
    make, own, shared = CASES["iterations"]
    runs = Simulation(make(), batch=5).run(STEPS, {**own, **shared})
    counts = np.array([run.iterations for run in runs])
    assert (counts.min(axis=0) < counts.max(axis=0)).any(), "else the test above would see no scene that waits"


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda estimator: type(estimator).__name__)
@pytest.mark.parametrize("case", ["iterations", "mixture"])
def test_every_estimator_has_the_bits_of_single_runs(estimator, case):
    make, own, shared = CASES[case]
    batch = len(next(iter(own.values())))
    problem = Problem(Simulation(make(), batch=batch), STEPS, CentreOfMass(np.full(3, 0.1)))
    single = Problem(Simulation(make()), STEPS, CentreOfMass(np.full(3, 0.1)))
    found = problem.estimate({**own, **shared}, estimator)
    for b in range(batch):
        wanted = single.estimate({**member(own, b), **shared}, estimator)
        assert wanted.loss == found.loss[b]
        for name, bar in wanted.gradient.items():
            np.testing.assert_array_equal(found.gradient[name][b].reshape(bar.shape), bar)


@pytest.mark.parametrize("case", ["iterations", "mixture", "jet"])
def test_tangents_of_a_batch_are_those_of_single_runs(case):
    make, own, shared = CASES[case]
    batch = len(next(iter(own.values())))
    problem = Problem(Simulation(make(), batch=batch), STEPS, loss_of(Simulation(make())))
    single = Problem(Simulation(make()), STEPS, loss_of(Simulation(make())))
    along = {name: RANDOM.standard_normal(np.shape(value)) for name, value in own.items()}
    found = problem.tangent({**own, **shared}, along)
    assert found.shape == (batch,)
    for b in range(batch):
        assert single.tangent({**member(own, b), **shared}, member(along, b)) == found[b]


def test_a_small_memory_budget_gives_the_same_bits():
    make, own, shared = CASES["iterations"]
    simulation = Simulation(make(), batch=5)
    budgets = (Problem(simulation, STEPS, CentreOfMass(np.full(3, 0.1)), budget) for budget in (2**30, 0))
    assert_same(*budgets, {**own, **shared})


def test_a_lost_scene_stops_and_the_others_go_on():
    """One is shot through the wall; nothing of it reaches its neighbours."""
    scene = scenes.scene(solver=FREE)
    velocities = np.zeros((3, 125, 3))
    velocities[1, 17] = [300.0, 0.0, 0.0]
    given = {"initial_velocities": velocities, "gravity": np.array([0.0, -9.0, 1.0])}
    problem = Problem(Simulation(scene, batch=3), STEPS, CentreOfMass(np.full(3, 0.1)))
    loss, gradient = problem.value_and_gradient(given)
    assert list(problem.lost) == [1] and problem.lost[1].particle == 17
    with pytest.warns(CortadoWarning, match=r"1 of 3 scenes .* were lost\. First scene 1: .* particle 17 left"):
        runs = problem.run(given)
    assert list(runs.lost) == [1]
    assert len(runs[1]) == problem.lost[1].step and len(runs[0]) == STEPS + 1
    assert np.isnan(runs.positions[problem.lost[1].step :, 1]).all() and np.isfinite(runs[1].positions).all()
    assert np.isnan(loss[1]) and all(np.isnan(bar[1]).all() for bar in gradient.values())
    single = Problem(Simulation(scene), STEPS, CentreOfMass(np.full(3, 0.1)))
    for b in (0, 2):
        wanted, bars = single.value_and_gradient({**given, "initial_velocities": velocities[b]})
        assert wanted == loss[b]
        for name, bar in bars.items():
            np.testing.assert_array_equal(gradient[name][b], bar)


def test_a_batch_goes_on_from_where_it_stopped():
    simulation, gravity = Simulation(scenes.plane(), batch=3), random_gravity(3.0, 3, 6, 2)
    whole = simulation.run(6, {"gravity": gravity})
    first = simulation.run(4, {"gravity": gravity[:, :4]})
    rest = simulation.run(2, {"gravity": gravity[:, 4:]}, state=[run.last_state for run in first])
    np.testing.assert_array_equal(rest.positions[-1], whole.positions[-1])
    np.testing.assert_array_equal(rest[2].times, whole[2].times[4:])
    with pytest.raises(InputError, match="state has 2 states, but must have 3, one for each scene"):
        simulation.run(2, state=[run.last_state for run in first[:2]])


def test_a_batch_of_one_has_an_axis_and_gradients_an_entry_for_each_scene():
    problem = Problem(Simulation(scenes.plane(), batch=1), 3, CentreOfMass([0.1, 0.1]))
    loss, gradient = problem.value_and_gradient({"gravity": [0.0, -9.0], "viscosity": [0.1]})
    assert loss.shape == (1,) and gradient["gravity"].shape == (1, 2) and gradient["viscosity"].shape == (1,)
    # In the shape of a value that has one, and with an axis more than a value for all.
    problem = Problem(Simulation(scenes.plane(), batch=4), 3, CentreOfMass([0.1, 0.1]))
    shapes = {"gravity": (4, 1, 2), "viscosity": (), "time_step": (4,), "initial_velocities": (64, 2)}
    given = {name: np.full(shape, 0.002) for name, shape in shapes.items()}
    found = {name: bar.shape for name, bar in problem.value_and_gradient(given)[1].items()}
    assert found == {**shapes, "viscosity": (4,), "initial_velocities": (4, 64, 2)}
    everywhere = {"gravity": np.full((1, 3, 2), 0.1)}
    assert problem.value_and_gradient(everywhere)[1]["gravity"].shape == (4, 3, 2)


def test_parameters_that_do_not_fit_are_said():
    for given, sentence in [
        ({"gravity": np.zeros((4, 2))}, r"gravity has shape \(4, 2\), whose first axis may count the steps or"),
        ({"gravity": np.zeros((3, 4, 2))}, r"gravity has shape \(3, 4, 2\), but must be .*\(4, 1, 2\) or \(4, 4, 2\)"),
        ({"viscosity": np.zeros(3)}, r"viscosity has shape \(3,\), but must be \(\) or \(4,\)"),
        ({"viscosity": -np.ones(4)}, "viscosity is -1.0, but must be at least 0"),
        ({"initial_positions": np.full((4, 64, 2), 5.0)}, r"In scene 0 of the batch, .* particle 0 at \(5, 5\) m"),
    ]:
        with pytest.raises(InputError, match=sentence):
            Problem(Simulation(scenes.plane(), batch=4), 4, CentreOfMass([0.1, 0.1])).value(given)


def test_substeps_of_diffusion_must_be_the_same():
    problem = Problem(Simulation(layers(), batch=2), 2, CentreOfMass(np.full(3, 0.1)))
    with pytest.raises(InputError, match="take 2 and 3 explicit steps of diffusion in a time step, but must all"):
        problem.value({"mobility": np.array([0.1, 0.2])})


def test_estimators_that_run_batches_are_given_single_scenes():
    problem = Problem(Simulation(scenes.plane(), batch=2), 2, CentreOfMass([0.1, 0.1]))
    for estimator in (gradients.RandomizedSmoothing(), gradients.EnsembleMean()):
        with pytest.raises(InputError, match="is given a problem with a batch of scenes, but needs a single scene"):
            problem.value_and_gradient({"gravity": [0.0, -9.0]}, estimator)


@pytest.mark.parametrize(
    "estimator",
    [
        gradients.RandomizedSmoothing(spread={"gravity": 0.5, "viscosity": 0.02}, samples=3),
        gradients.EnsembleMean(spread={"gravity": 0.5, "viscosity": 0.02}, estimator=gradients.Exact(), samples=6),
        gradients.EnsembleMean(spread={"gravity": 0.5, "viscosity": 0.02}),
    ],
    ids=["smoothing", "mean of exact", "mean"],
)
def test_ensembles_run_in_batches_with_the_same_bits(estimator, monkeypatch):
    problem = Problem(Simulation(scenes.scene(solver=FREE)), STEPS, CentreOfMass(np.full(3, 0.1)))
    given, sizes = {"gravity": [0.5, -9.0, 0.0], "viscosity": 0.1}, []
    own = Simulation.batch_of
    monkeypatch.setattr(Simulation, "batch_of", lambda made, size: sizes.append(size) or own(made, size))
    found = problem.estimate(given, estimator)
    assert sizes, "no batch was made"
    monkeypatch.setattr(Problem, "room", lambda *_: 1)
    wanted = problem.estimate(given, estimator)
    for name in given:
        np.testing.assert_array_equal(found.gradient[name], wanted.gradient[name])
        np.testing.assert_array_equal(found.standard_error[name], wanted.standard_error[name])


class Normalised(gradients.Filtered):
    """An adjoint that is divided by its norm: over all scenes of a batch, if nobody looked."""

    def filter(self, bar: Any) -> None:
        values = bar.velocities.numpy()
        bar.velocities.assign(values / np.linalg.norm(values))


class ByNorm(gradients.AdjointEstimator):
    def derivative(self, rollout: Any) -> Any:
        return Normalised(gradients.Exact().derivative(rollout))


def test_an_estimator_of_a_users_own_is_not_trusted_with_a_batch():
    given = {"gravity": [0.0, -9.0]}
    batch = Problem(Simulation(scenes.plane(), batch=2), 3, CentreOfMass([0.1, 0.1]))
    with pytest.raises(InputError, match=r"ByNorm is given a batch, but has no `batches = True`"):
        batch.value_and_gradient(given, ByNorm())
    single = Problem(Simulation(scenes.plane()), 3, CentreOfMass([0.1, 0.1]))
    assert single.room(ByNorm()) == 1
    single.value_and_gradient(given, gradients.EnsembleMean(estimator=ByNorm()))


def test_states_are_shared_with_other_libraries():
    problem = Problem(Simulation(scenes.two_layers(), batch=2), 2, CentreOfMass(np.full(3, 0.1)))
    end = problem.end({"time_step": np.array([0.001, 0.0011])})
    np.testing.assert_array_equal(np.from_dlpack(end.state.numbers("positions")), end.positions.astype(np.float32))
    assert end.state.numbers("mass_fractions").shape == (2, 125, 2)
    assert end.state.numbers("reference_density").shape == (2, 125)
    end.state.numbers("positions").fill_(2.0)
    np.testing.assert_array_equal(end[1].state.positions.numpy(), np.full((125, 3), 2.0))


def test_a_force_of_a_users_own_is_not_trusted_with_a_batch(monkeypatch):
    monkeypatch.setattr("cortado.sph.viscous_stress.ViscousStress.batches", False)
    Simulation(scenes.plane())
    with pytest.raises(InputError, match=r"batch is 2, .* as the force ViscousStress has no `batches = True`"):
        Simulation(scenes.plane(), batch=2)


def test_one_scene_is_certified_and_optimised():
    problem = Problem(Simulation(scenes.plane(), batch=2), 2, CentreOfMass([0.1, 0.1]))
    with pytest.raises(InputError, match="problem has a batch of scenes, but must have a single scene"):
        cortado.certify(problem, {"gravity": [0.0, -9.0]})
    with pytest.raises(InputError, match=r"The problem's loss has shape \(2,\), but must be one number"):
        cortado.optimise(problem, {"gravity": [0.0, -9.0]}, "adam", learning_rate=0.1, iterations=1)
