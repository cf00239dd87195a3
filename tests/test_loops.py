"""Closed loops: their losses smoothed over an ensemble, and the warning where an adjoint grows too far."""

import warnings
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from cortado import CortadoWarning, InputError, Problem, Simulation, gradients, losses
from layered import sheared

STEPS = 4
PLACE = [0.3, 0.2]


pytestmark = pytest.mark.usefixtures("jax")


@pytest.fixture(scope="module")
def simulation():
    return Simulation(sheared(), precision="float64")


def layer_of(library):
    import cortado.jax
    import cortado.torch

    return {"jax": cortado.jax, "torch": cortado.torch}[library]


def loop(layer, simulation, weights, state, gradient=None, spoilt=np.inf):
    """A loop without a policy, so that it is a problem: its weights are the gravity of all steps."""
    for _ in range(STEPS // 2):
        state = layer.step(simulation, state, {"gravity": weights["g"]}, 2, gradient)
    miss = [state["positions"][:, axis].mean() - place for axis, place in enumerate(PLACE)]
    lost = (weights["g"][0] > spoilt) * np.inf if spoilt < np.inf else 0.0
    return miss[0] ** 2 + miss[1] ** 2 + lost


# ---- smoothed ----------------------------------------------------------------------------------------------------
ESTIMATORS = [
    gradients.EnsembleMean(0.5, 4, estimator=gradients.Exact()),
    gradients.EnsembleMean(0.5, 4),
    gradients.Guided(0.5, seed=3),
    gradients.RandomizedSmoothing(0.5, samples=2, position_noise=0.02),
    gradients.AdjointViscosity(),
]


@pytest.mark.parametrize("library", ["jax", "torch"])
@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda one: type(one).__name__)
def test_a_loop_is_smoothed_as_the_problem_that_it_is(simulation, library, estimator):
    layer, gravity = layer_of(library), np.array([0.4, -9.0])
    found = layer.smoothed(simulation, partial(loop, layer, simulation), estimator).estimate({"g": gravity})
    problem = Problem(simulation, STEPS, losses.CentreOfMass(PLACE))
    wanted = problem.estimate({"gravity": gravity}, estimator)
    assert wanted.loss > 0.0
    np.testing.assert_allclose(found.loss, wanted.loss, rtol=1e-10)
    np.testing.assert_allclose(found.gradient["g"], wanted.gradient["gravity"], rtol=1e-7)
    if wanted.standard_error is not None:
        np.testing.assert_allclose(found.degrees_of_freedom, wanted.degrees_of_freedom, rtol=1e-6)
        np.testing.assert_allclose(found.mean_loss, wanted.mean_loss, rtol=1e-10)
        np.testing.assert_allclose(found.standard_error["g"], wanted.standard_error["gravity"], rtol=1e-5)
        assert abs(found.mean_loss - found.loss) > 1e-9 * found.loss


@pytest.mark.parametrize("library", ["jax", "torch"])
def test_in_float32_it_is_the_problem_to_round_off(jax, library):
    with jax.enable_x64(False):
        single = Simulation(sheared(), precision="float32")
        layer, gravity, estimator = layer_of(library), np.array([0.4, -9.0]), gradients.EnsembleMean(0.5, 4)
        smoothed = layer.smoothed(single, partial(loop, layer, single), estimator)
        found = smoothed.estimate({"g": gravity})
        wanted = Problem(single, STEPS, losses.CentreOfMass(PLACE)).estimate({"gravity": gravity}, estimator)
        np.testing.assert_allclose(found.loss, wanted.loss, rtol=1e-4)
        np.testing.assert_allclose(found.gradient["g"], wanted.gradient["gravity"], rtol=1e-3)
        np.testing.assert_allclose(found.standard_error["g"], wanted.standard_error["gravity"], rtol=1e-2)


def test_its_value_is_the_mean_and_its_derivative_the_smoothed_gradient(jax, simulation):
    import torch

    for library in ("jax", "torch"):
        layer = layer_of(library)
        smoothed = layer.smoothed(simulation, partial(loop, layer, simulation), gradients.EnsembleMean(0.5, 4))
        found = smoothed.estimate({"g": np.array([0.4, -9.0])})
        if library == "jax":
            value, own = jax.value_and_grad(lambda g, f=smoothed: 3.0 * f({"g": 2.0 * g}))(jax.numpy.array([0.2, -4.5]))
        else:
            given = torch.tensor([0.2, -4.5], dtype=torch.float64, requires_grad=True)
            value = 3.0 * smoothed({"g": 2.0 * given})
            value.backward()
            own = given.grad
        assert value.item() == pytest.approx(3.0 * found.mean_loss)
        np.testing.assert_allclose(np.asarray(own), 6.0 * found.gradient["g"], rtol=1e-12)


def test_it_begins_at_a_state_and_leaves_lost_loops_out(simulation):
    layer, gravity = layer_of("jax"), np.array([0.4, -9.0])
    estimator = gradients.EnsembleMean(0.5, samples=10, estimator=gradients.Exact())
    later = layer.step(simulation, layer.state(simulation), steps=5)
    whole, begun = (
        layer.smoothed(simulation, partial(loop, layer, simulation), gradients.Exact(), start).estimate({"g": gravity})
        for start in (None, later)
    )
    assert begun.loss != whole.loss
    most = estimator.around(Problem(simulation, 1, losses.CentreOfMass(PLACE)), {"g": gravity})
    drawn = [gravity + sign * 0.5 * u for u in _offsets(most, 5) for sign in (1.0, -1.0)]
    spoilt = np.sort([g[0] for g in drawn])[-2:].mean()  # beyond which there is one
    with pytest.warns(gradients.ensembles.LeftOutWarning, match="1 of 10 runs .* cannot be run, so that 1 of 5"):
        found = layer.smoothed(simulation, partial(loop, layer, simulation, spoilt=spoilt), estimator).estimate(
            {"g": gravity}
        )
    assert found.left_out == 2 and np.isfinite(found.gradient["g"]).all()


def _offsets(sampler, pairs):
    for _ in range(pairs):
        yield sampler.offset()
        sampler.displacement()


def test_bad_loops_are_refused_in_a_sentence(jax, simulation):
    layer = layer_of("jax")
    smoothed = layer.smoothed(simulation, partial(loop, layer, simulation), gradients.EnsembleMean(0.5))
    for use, sentence in (
        (lambda: jax.jit(smoothed)({"g": np.zeros(2)}), "weights are JAX tracers, but must be arrays"),
        (lambda: smoothed({"initial_positions": np.zeros(2)}), "weights has initial_positions, but must have another"),
        (lambda: smoothed(np.zeros(2)), r"weights is .*, but must be .*\{'bias': array\}"),
        (lambda: smoothed.estimate({"g": ["a", "b"]}), "weight g is .*, but must be"),
        (lambda: layer.smoothed(simulation, lambda weights, state: 0.0, gradients.Exact()), "loss takes the arguments"),
        (
            lambda: layer.smoothed(simulation, partial(loop, layer, simulation), gradients.Exact(), {"x": [0.0]}),
            "state has x, but must",
        ),
        (
            lambda: layer.smoothed(simulation, lambda w, s, g: s["positions"], gradients.Guided(0.5))({"g": [0.0]}),
            r"loss returned an array of shape \(.*\), but must return one number",
        ),
    ):
        with pytest.raises(InputError, match=sentence):
            use()


# ---- growth ------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Growing(gradients.AdjointEstimator):
    """Multiplies the adjoint after every step."""

    factor: float

    def derivative(self, rollout):
        step = gradients.Filtered(gradients.Exact().derivative(rollout))

        def filtered(bar):
            for array in (bar.positions, bar.velocities):
                array.assign(self.factor * array.numpy())

        step.filter = filtered
        return step


def chain(calls, factor, change=lambda bar: bar):
    """Go back through calls of two steps each, and return the adjoint of the first state."""
    simulation = Simulation(sheared(), precision="float64")
    states = [simulation.state()]
    for _ in range(calls):
        states.append(simulation.step(states[-1], steps=2))
    bar = {"positions": np.ones(simulation.positions.shape)}
    for state in reversed(states[:-1]):
        bar = change(simulation.vjp(state, {}, bar, 2, Growing(factor))[0])
    return bar


@contextmanager
def silence():
    with warnings.catch_warnings():
        warnings.simplefilter("error", CortadoWarning)
        yield


def test_a_chain_that_grows_by_ten_e_folds_says_so_once():
    with silence():
        bar = chain(4, np.exp(1.0))
    grown = np.log(np.linalg.norm(bar["positions"]) / np.sqrt(bar["positions"].size))
    assert 7.0 < grown < 9.5
    with pytest.warns(CortadoWarning) as found:
        chain(8, np.exp(1.0))
    (said,) = [str(one.message) for one in found if "adjoint" in str(one.message)]
    assert "has grown by e^10." in said or "has grown by e^11." in said, said
    assert "over 10 steps" in said or "over 12 steps" in said, said
    assert "AdjointViscosity" in said


def test_what_is_added_or_taken_away_between_calls_is_no_growth():
    def added(bar):
        return {**bar, "positions": bar["positions"] + 100.0 * np.abs(bar["positions"]).max()}

    def taken(bar):
        return {name: np.exp(-2.0) * array for name, array in bar.items()}

    with silence():
        chain(8, 1.0, added)
        chain(8, np.exp(1.0), taken)


def test_a_scan_in_jax_says_so(jax):
    layer, simulation = layer_of("jax"), Simulation(sheared(), precision="float64")
    first = layer.state(simulation)

    def end(gravity, estimator):
        def act(state, _):
            return layer.step(simulation, state, {"gravity": gravity}, 2, estimator), None

        return jax.lax.scan(act, first, length=8)[0]["positions"].sum()

    gravity = jax.numpy.array([0.4, -9.0])
    with silence():
        jax.jit(jax.grad(partial(end, estimator=None)))(gravity).block_until_ready()
    with pytest.warns(CortadoWarning, match="The adjoint of the state has grown by e"):
        jax.jit(jax.grad(partial(end, estimator=Growing(np.exp(1.0)))))(gravity).block_until_ready()


# ---- a gravity in every step -------------------------------------------------------------------------------------
def test_a_gravity_is_judged_by_the_limits_of_the_time_step_where_it_is_stronger_than_those_before():
    """A weaker one is not, as a policy gives another in every step; that of the scene itself is."""
    simulation = Simulation(sheared(), precision="float64")
    state = simulation.state()

    def said(gravity, steps=1, **others):
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            simulation.step(state, {**({} if gravity is None else {"gravity": gravity}), **others}, steps=steps)
        return any("limit of stability" in str(one.message) for one in found)

    assert not said([0.4, -9.0]) and not said([2.0, -1.0]) and said([0.0, -1e4]) and not said([0.0, -1e4])
    longer = {"steps": 2, "time_step": 0.012}
    assert not said([0.0, -1e-3], **longer) and said(None, **longer)


@pytest.mark.parametrize("library", ["jax", "torch"])
def test_two_loops_in_turn_have_their_own_bits_and_a_changed_state_is_judged(library):
    layer, simulation = layer_of(library), Simulation(sheared())
    first, pulls = layer.state(simulation), {"left": -0.4, "right": 0.3}

    def step(own, state, pull, number):
        return layer.step(own, state, {"gravity": np.array([pull * number, -9.0])})

    ends = dict.fromkeys(pulls, first)
    for number in range(4):
        ends |= {side: step(simulation, ends[side], pull, number) for side, pull in pulls.items()}
    for side, pull in pulls.items():
        alone, state = Simulation(sheared()), first
        for number in range(4):
            state = step(alone, state, pull, number)
        assert all(np.array_equal(state[name], ends[side][name]) for name in state)
    end = step(simulation, ends["left"], 0.1, 1)
    with pytest.raises(InputError, match="outside the container"):
        step(simulation, {**end, "positions": end["positions"] + 9.0}, 0.1, 1)
