"""Steps as a function of a state: chained, they have the bits of one run."""

import copy
import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from cortado import CortadoWarning, InputError, Problem, Scene, Simulation, certify, gradients
from scenes import MIXING, box, jet, plane, plane_of_three, pour, scene, two_layers

SWAY = {"times": [0.0, 0.03, 0.06, 0.1], "values": [[0.0, -9.81], [8.0, -9.81], [-5.0, -7.0], [0.0, -9.81]]}
PATH = {"times": [0.0, 0.02, 0.05], "values": [[0.3, 0.26], [0.34, 0.28], [0.28, 0.3]]}


HONEY = [{"name": "water", "rest_density": 1000.0, "viscosity": 0.6}]
ROOM = box([0.0, 0.0], [0.7, 0.8], periodic=[True, False])
SCENES = {
    "one fluid": plane,
    "in space": scene,
    "mixture": two_layers,
    "three fluids": plane_of_three,
    "schedule": lambda: plane(schedule={"gravity": SWAY}),
    "jet": lambda: jet(path=PATH),
    "pour": pour,
    "surface tension": lambda: plane(phase=HONEY, forces={"gravity": [0.0, -9.81], "surface_tension": 0.5}),
    "periodic": lambda: plane(container=ROOM, forces={"gravity": [0.5, -9.81]}),
}


def scheduled() -> Scene:
    return SCENES["schedule"]()


def assert_same_state(found, wanted):
    assert found.fields.keys() == wanted.fields.keys()
    for name in wanted.fields:
        assert found[name].dtype == wanted[name].dtype and found[name].tobytes() == wanted[name].tobytes(), name
    assert (found.clock, found.origin) == (wanted.clock, wanted.origin)


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", SCENES)
def test_chained_steps_have_the_bits_of_one_run(name, precision):
    simulation = Simulation(SCENES[name](), precision=precision)
    whole = simulation.run(40)
    state = simulation.state()
    assert_same_state(state, whole[:1].last_state)
    for steps in (10, 1, 10, 1, 18):
        state = simulation.step(state, steps=steps)
        assert state.clock.time == whole.times[state.clock.steps]
    assert_same_state(state, whole.last_state)
    assert_same_state(simulation.step(simulation.state(), steps=40), whole.last_state)


def test_a_state_of_a_step_cannot_be_changed_and_one_that_is_made_of_it_is_judged():
    simulation = Simulation(plane())
    state = simulation.step(simulation.state(), steps=2)
    with pytest.raises(ValueError, match="read-only"):
        state["positions"][0] = 0.0
    with pytest.raises(InputError, match="cannot be changed"):
        state.fields["positions"] = np.zeros((64, 2))
    crowded = np.array(state["positions"])
    crowded[3] = crowded[5]
    with pytest.raises(InputError, match="particles 3 and 5 at one place"):
        simulation.step(replace(state, fields={**state.fields, "positions": crowded}))
    with pytest.raises(InputError, match="of the first run again"):
        simulation.step(state, {"rest_density": 900.0})
    again = pickle.loads(pickle.dumps(state))
    assert_same_state(simulation.step(again), simulation.step(state))


def fast_second():
    """First velocities of two planes, of which the second loses a particle."""
    fast = np.zeros((2, 64, 2))
    fast[1, 0] = [400.0, 0.0]
    return fast


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_a_scene_of_a_batch_that_is_lost_has_no_numbers_and_goes_on_without():
    simulation = Simulation(plane(), batch=2)
    one, lost = simulation.step(simulation.state({"initial_velocities": fast_second()}), steps=3)
    assert_same_state(one, Simulation(plane()).run(3).last_state)
    assert np.isnan(lost["positions"]).all() and np.isnan(lost["velocities"]).all()
    by_hand = replace(lost, fields={name: np.array(value) for name, value in lost.fields.items()}, origin=None)
    with pytest.warns(CortadoWarning, match=r"scene 1: .* particle 0 \(and 63 more\) had been lost in steps before"):
        after = [simulation.step([one, state], steps=2) for state in (lost, by_hand)]
    for on, gone in after:
        assert_same_state(on, Simulation(plane()).run(5).last_state)
        assert all(np.isnan(value).all() for value in gone.fields.values())
    runs = simulation.run(2, state=[one, lost])
    assert list(runs.lost) == [1] and len(runs[1]) == 1 and np.isnan(runs.positions[:, 1]).all()
    partly = {**by_hand.fields, "velocities": np.zeros((64, 2))}
    for state in (replace(lost, fields=partly), replace(one, fields={**one.fields, "positions": lost["positions"]})):
        with pytest.raises(InputError, match="state positions has a value that is not finite"):
            simulation.step([one, state])
    with pytest.raises(InputError, match="not finite"):
        Simulation(plane()).step(lost)


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_derivatives_of_a_scene_of_a_batch_that_is_lost_have_no_numbers_and_go_back_beside_those_of_others():
    simulation, alone = Simulation(plane(), batch=2), Simulation(plane())
    stepper, first = simulation.stepper(3), simulation.state({"initial_velocities": fast_second()})
    states, residual = stepper.step(first)
    bar = stepper.vjp(residual, {"positions": np.stack([one["positions"] for one in states])})[0]
    wanted = alone.vjp(alone.state(), {}, {"positions": states[0]["positions"]}, steps=3)[0]
    assert bar["velocities"][0].tobytes() == wanted["velocities"].tobytes()
    assert np.isnan(bar["velocities"][1]).all() and np.isnan(bar["time"][1])
    silent = np.stack([states[0]["positions"], np.zeros((64, 2))])
    viscosity = {"viscosity": np.array(1.0)}
    states, residual = stepper.step(first, viscosity)
    bar, shared = stepper.vjp(residual, {"positions": silent})
    assert bar["velocities"][0].any() and not bar["velocities"][1].any() and bar["time"][1] == 0.0
    assert shared["viscosity"][0] != 0.0 == shared["viscosity"][1]
    dot = stepper.jvp(residual, {"positions": silent})
    assert dot["positions"][0].any() and not dot["positions"][1].any() and dot["time"][1] == 0.0
    assert np.isnan(stepper.jvp(residual, {"positions": silent}, viscosity)["positions"][1]).all()
    partly = np.zeros((2, 64, 2))
    partly[1, 3] = np.nan
    with pytest.raises(InputError, match="positions has a value that is not finite"):
        stepper.vjp(residual, {"positions": partly})


def test_from_the_second_call_on_nothing_is_allocated_on_the_device(monkeypatch):
    simulation = Simulation(two_layers())
    first, stepper = simulation.state(), simulation.stepper(3)

    def every_call():
        state, residual = stepper.step(simulation.step(first, steps=3))
        stepper.vjp(residual, last_adjoint(state))
        stepper.jvp(residual, {"velocities": state["positions"]}, {"gravity": np.ones(simulation.dimension)})
        return state

    for _ in range(2):
        wanted = every_call()
    made, allocator = [], type(simulation.device.get_allocator())
    allocate = allocator.allocate
    monkeypatch.setattr(allocator, "allocate", lambda self, size: made.append(size) or allocate(self, size))
    monkeypatch.setattr(wp, "ScopedCapture", lambda *a, **k: made.append("capture"))
    for _ in range(2):
        assert_same_state(every_call(), wanted)
    assert not made


@pytest.mark.parametrize("name", ["one fluid", "steps that are chosen", "gravity in every step"])
def test_runs_of_any_length_share_their_graphs(name, monkeypatch):
    """On a CPU a graph is captured the second time. A run has the bits of the first one of its simulation."""
    made = plane(solver={"time_step": "auto"}) if name == "steps that are chosen" else plane()
    controls = {n: {"gravity": np.linspace([0.5, -9.81], [1.5, -9.0], n)} for n in (3, 11, 21)}
    given = controls if name == "gravity in every step" else dict.fromkeys(controls)
    simulation = Simulation(made)
    wanted = {n: Simulation(made).run(n, given[n]) for n in controls}

    def check(n):
        found = simulation.run(n, given[n])
        fields = found.positions, found.velocities, found.times, *found.diagnostics.values()
        own = wanted[n].positions, wanted[n].velocities, wanted[n].times, *wanted[n].diagnostics.values()
        assert all(map(np.array_equal, fields, own))

    for n in (21, 3, 11, 21, 3):
        check(n)
    captures = []
    monkeypatch.setattr(wp, "ScopedCapture", lambda *a, **k: captures.append("capture"))
    for n in (11, 3, 21):
        check(n)
    assert not captures


class Weighted:
    """A loss of the last state alone, with the same weights in every dimension."""

    def value(self, end):
        return float((end.positions**2).sum() + (end.positions * end.velocities).sum())

    def adjoint(self, end):
        return 2.0 * end.positions + end.velocities, end.positions


def last_adjoint(state):
    x, v = np.float64(state["positions"]), np.float64(state["velocities"])
    return {"positions": 2.0 * x + v, "velocities": x}


def differentiated(simulation):
    """Parameters of a whole run of 200 steps: a gravity in every step, a viscosity, a nozzle that moves."""
    steps = 200
    sway = np.sin(0.1 * np.arange(steps))[:, None] * np.eye(simulation.dimension)[0]
    found = {"gravity": np.array(simulation.scene.forces.gravity) + sway}
    found["viscosity"] = np.asarray(simulation.parameters()["viscosity"]) * 1.1
    if simulation.scene.emitter:
        found["nozzle.path"] = np.array(simulation.scene.emitter[0].outlet) + 0.002 * sway
    return found


def rows(parameters, steps):
    return {name: value[steps] if np.ndim(value) == 2 else value for name, value in parameters.items()}


ROUND_OFF = {"float32": 2e-5, "float64": 1e-11}
"""Relative: adjoints of parameters of all steps are added up in segments."""
CHAINED = {name: SCENES[name] for name in ("one fluid", "mixture", "schedule", "jet", "surface tension", "periodic")}


def there_and_back(stepper, state, each, adjoint=last_adjoint, estimator=None):
    """The last state after segments with these parameters, and the adjoints of the first state and of each segment."""
    residuals, parts = [], []
    for parameters in each:
        state, residual = stepper.step(state, parameters)
        residuals.append(residual)
    bar = adjoint(state)
    while residuals:
        bar, part = stepper.vjp(residuals.pop(), bar, *([] if estimator is None else [estimator]))
        parts.insert(0, part)
    return state, bar, parts


CASES = list(zip(CHAINED, 3 * ("float32", "float64"), strict=True))


@pytest.mark.parametrize(("name", "precision"), CASES)
def test_segments_chained_by_vjp_have_the_bits_of_one_run(name, precision):
    simulation = Simulation(CHAINED[name](), precision=precision)
    parameters = differentiated(simulation)
    if name == "schedule":
        del parameters["gravity"]
    start = {"initial_velocities": simulation.velocities + 0.01}
    loss, gradient = Problem(simulation, 200, Weighted()).value_and_gradient({**parameters, **start})
    each = [rows(parameters, slice(k, k + 10)) for k in range(0, 200, 10)]
    state, bar, parts = there_and_back(simulation.stepper(10), simulation.state(start), each)
    assert Weighted().value(SimpleNamespace(**{n: np.float64(a) for n, a in state.fields.items()})) == loss
    assert bar["velocities"].tobytes() == gradient["initial_velocities"].tobytes()
    assert np.abs(bar["velocities"]).max() > 0.0
    for parameter, value in parameters.items():
        if np.ndim(value) == 2:
            found = np.concatenate([part[parameter] for part in parts])
            if parameter == "nozzle.path":  # where a run begins that is given a path
                found[0] += bar["nozzle.outlet"][0]
            assert found.tobytes() == gradient[parameter].tobytes(), parameter
        else:
            found = sum(part[parameter] for part in parts)
            size = sum(np.abs(part[parameter]) for part in parts)  # parts of the sum may cancel
            assert (np.abs(found - gradient[parameter]) <= ROUND_OFF[precision] * size).all(), parameter


def test_segments_go_back_by_an_estimator_as_one_run_does():
    estimator, simulation = gradients.AdjointViscosity(), Simulation(plane(), precision="float64")
    start = {"initial_velocities": simulation.velocities + np.random.default_rng(2).normal(0, 0.3, (64, 2))}
    wanted = Problem(simulation, 20, Weighted()).value_and_gradient({"viscosity": 0.1, **start}, estimator)[1]
    segments = simulation.stepper(5), simulation.state(start), 4 * [{"viscosity": 0.1}]
    _, bar, parts = there_and_back(*segments, estimator=estimator)
    assert np.abs(bar["velocities"] - there_and_back(*segments)[1]["velocities"]).max() > 1e-6
    assert bar["velocities"].tobytes() == wanted["initial_velocities"].tobytes()
    assert sum(part["viscosity"] for part in parts) == pytest.approx(wanted["viscosity"], rel=1e-12)


def test_segments_of_a_batch_chained_by_vjp_have_the_bits_of_one_run():
    simulation = Simulation(plane_of_three(), batch=3, precision="float64")
    start = {"initial_velocities": 0.02 * np.arange(3)[:, None, None] + simulation.velocities}
    gravity = np.array([0.0, -9.81]) + np.random.default_rng(2).standard_normal((3, 200, 2))
    losses, gradient = Problem(simulation, 200, Weighted()).value_and_gradient({"gravity": gravity, **start})

    def adjoint(states):
        each = [last_adjoint(state) for state in states]
        return {name: np.stack([one[name] for one in each]) for name in each[0]}

    segments = [{"gravity": gravity[:, k : k + 10]} for k in range(0, 200, 10)]
    states, bar, parts = there_and_back(simulation.stepper(10), simulation.state(start), segments, adjoint)
    assert [Weighted().value(SimpleNamespace(**state.fields)) for state in states] == losses.tolist()
    assert bar["velocities"].tobytes() == gradient["initial_velocities"].tobytes()
    assert np.concatenate([part["gravity"] for part in parts], axis=1).tobytes() == gradient["gravity"].tobytes()
    assert bar["time"].shape == (3,)


def moved(simulation, state, by, dot):
    """A state that nobody judges: its densities are of no fluid that there is."""
    clock = replace(state.clock, time=state.clock.time + by * float(dot.get("time", 0.0)))
    fields = {name: array + by * dot.get(name, 0.0) for name, array in state.fields.items()}
    found = replace(state, clock=clock, fields=fields).fixed()
    simulation.judged_states.add(found)
    return found


@pytest.mark.parametrize("name", SCENES)
def test_vjp_jvp_and_differences_agree_for_every_field_of_a_state(name):
    """And for the time of the state and the time step, on which a schedule depends."""
    simulation, steps = Simulation(SCENES[name](), precision="float64"), 6
    state, rng = simulation.step(simulation.state(), steps=9), np.random.default_rng(1)
    end_bar = {n: rng.standard_normal(a.shape) for n, a in state.fields.items()} | {"time": 0.7}
    parameters = {"time_step": 0.0018}
    bar, parameter_bars = simulation.vjp(state, parameters, end_bar, steps)
    assert bar.keys() == {*state.fields, "time"}
    for field in bar:
        dot = {field: rng.standard_normal(np.shape(bar[field]))}
        out = simulation.jvp(state, parameters, dot, steps=steps)
        forward = sum((np.asarray(end_bar[n]) * out[n]).sum() for n in out)
        assert forward == pytest.approx((bar[field] * dot[field]).sum(), rel=1e-9, abs=1e-9)
        step = 1e-8 if field != "reference_density" else 1e-4
        up, down = (simulation.step(moved(simulation, state, sign * step, dot), parameters, steps) for sign in (1, -1))
        difference = sum((end_bar[n] * (up[n] - down[n])).sum() for n in up.fields)
        difference += end_bar["time"] * (up.clock.time - down.clock.time)
        assert difference / (2.0 * step) == pytest.approx(forward, rel=2e-5, abs=2e-5), field
    along = simulation.jvp(state, parameters, {}, {"time_step": 1.0}, steps=steps)
    forward = sum((np.asarray(end_bar[n]) * along[n]).sum() for n in along)
    assert forward == pytest.approx(float(parameter_bars["time_step"]), rel=1e-9)


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_a_stepper_is_copied_as_what_it_is_made_from_and_what_is_on_the_device_says_that_it_stays(again):
    simulation = Simulation(plane())
    stepper, problem = simulation.stepper(2), Problem(simulation, 2, Weighted())
    end, residual = stepper.step(simulation.state())
    assert_same_state(again(stepper).step(again(simulation.state()))[0], end)
    held = [residual, stepper.rollout, simulation.solver, simulation.initial, problem.forward_pass({})]
    for one in held + ([] if again is copy.copy else [problem.end({})]):
        with pytest.raises(InputError, match=r"^An? \w+ can(not| be neither) .*pickled .*copied.*\.$"):
            again(one)


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", SCENES)
def test_a_problem_begins_at_a_state(name, precision):
    simulation = Simulation(SCENES[name](), precision=precision)
    viscosity = {"viscosity": 1.2 * np.asarray(simulation.parameters()["viscosity"])}
    whole = simulation.run(20, viscosity)
    state = simulation.run(12, viscosity).last_state
    problem = Problem(simulation, 8, Weighted(), state=state)
    for _ in range(2):
        assert problem.end(viscosity).positions.tobytes() == np.float64(whole.positions[-1]).tobytes()
    assert_same_state(problem.run(viscosity).last_state, whole.last_state)
    loss, gradient, initial_state = problem.value_and_gradients(viscosity)
    residual = simulation.stepper(8).step(state, viscosity)[1]
    bar, wanted = simulation.stepper(8).vjp(residual, last_adjoint(whole.last_state))
    assert loss == Problem(simulation, 20, Weighted()).value(viscosity)
    assert gradient["viscosity"].tobytes() == wanted["viscosity"].tobytes()
    assert problem.value_and_gradient(viscosity)[1]["viscosity"].tobytes() == wanted["viscosity"].tobytes()
    assert initial_state.keys() == bar.keys()
    assert all(np.asarray(initial_state[n]).tobytes() == np.asarray(a).tobytes() for n, a in bar.items())
    first = Problem(simulation, 8, Weighted(), state=simulation.state())
    assert first.value({}) == Problem(simulation, 8, Weighted()).value({})
    state["positions"][:] = 0.0  # of which the problem has its own copy
    assert problem.value(viscosity) == loss


def test_a_problem_with_a_state_is_copied_batched_and_told_from_others():
    simulation = Simulation(jet(), precision="float64")
    state = simulation.step(simulation.state(), steps=12)
    problem = Problem(simulation, 6, Weighted(), state=state)
    point = {"nozzle.flow_rate": 0.25}
    loss, gradient = problem.value_and_gradient(point)
    again = pickle.loads(pickle.dumps(problem))
    assert again.value(point) == loss and again.fingerprint == problem.fingerprint
    assert problem.fingerprint != Problem(simulation, 6, Weighted()).fingerprint
    together = problem.together([point, {"nozzle.flow_rate": 0.3}], gradients.Exact())
    assert together[0].loss == loss and together[0].gradient["nozzle.flow_rate"] == gradient["nozzle.flow_rate"]
    assert together[1].loss == problem.value({"nozzle.flow_rate": 0.3})
    slope = problem.tangent(point, {"nozzle.flow_rate": 1.0})
    assert slope == pytest.approx(float(gradient["nozzle.flow_rate"]), rel=1e-10)
    with pytest.raises(InputError, match="must begin at the scene's initial state, as certificates also vary"):
        certify(problem, point)
    path = {"nozzle.path": np.array(state["nozzle.outlet"]) + np.zeros((6, 2))}
    bars = problem.value_and_gradient(path)[1]
    assert problem.tangent(path, {"nozzle.path": np.ones((6, 2))}) == pytest.approx(bars["nozzle.path"].sum())
    for parameters in ({"initial_velocities": simulation.velocities}, {"rest_density": 900.0}):
        with pytest.raises(InputError, match="state"):
            problem.value(parameters)
    with pytest.raises(InputError, match="state is 3, but must be a RestartState"):
        Problem(simulation, 6, Weighted(), state=3)


WRONG_BARS = [
    ({"pressure": np.zeros(64)}, "'pressure', but must have only positions"),
    ({"positions": np.zeros((63, 3))}, r"has shape \(63, 3\), but must be \(\d+, 3\)"),
    ({"time": [1.0]}, r"time has shape \(1,\)"),
    ({"velocities": "fast"}, "velocities"),
    ({"time": np.inf}, "time has a value that is not finite, but all values must be"),
    (None, "must be a table"),
]


def test_derivatives_directions_and_residuals_that_do_not_fit_are_sentences():
    simulation = Simulation(two_layers(mixture={**MIXING, "mobility": 0.0}))
    state, stepper, not_its_own = simulation.state(), simulation.stepper(2), "returned by this stepper's step"
    residual, velocities = stepper.step(state)[1], {"initial_velocities": simulation.velocities}
    for call, words in [
        (lambda: stepper.jvp(residual, {}, velocities), "give the directions of the state's fields"),
        (lambda: stepper.jvp(residual, {}, {"mobility": 1.0}), "must be named in the call of step, too"),
        (lambda: simulation.stepper(3).vjp(residual, {}), not_its_own),
        (lambda: stepper.vjp(3, {}), not_its_own),
        (lambda: stepper.vjp(residual, {}, 3), "gradient is 3, but must be an AdjointEstimator"),
        (lambda: stepper.vjp(residual, {}, gradients.Exact), "gradient is <class .*Exact.>, but must be an Adj"),
        (lambda: stepper.vjp(residual, {}, gradients.AdjointViscosity(order=2)), "order is 2, but must be 1 for"),
        (lambda: stepper.step(state, along="mobility"), "must be a list of names"),
        (lambda: stepper.step(state, along=3), "along is 3"),
        (lambda: stepper.step(state, along=["mobil"]), "'mobil' is unknown"),
        (lambda: simulation.step("state"), "state is 'state', but must be a RestartState"),
        (lambda: simulation.step(None, {"viscosity": -1.0}), "viscosity"),
        (lambda: simulation.step(state, velocities), "must be left out, as the given state"),
        (lambda: simulation.step([state, state]), "has 2 states, but must have 1"),
        (lambda: simulation.step(replace(state, fields={"positions": state["positions"]})), "but must have"),
        (lambda: simulation.step(state, {}, 2.5), "steps"),
        (lambda: Simulation(plane(), batch=3).step(state), "has 1 states, but must have 3"),
        *((lambda bar=bar: simulation.vjp(state, {}, bar), words) for bar, words in WRONG_BARS),
        *((lambda bar=bar: simulation.jvp(state, {}, bar), words) for bar, words in WRONG_BARS),
    ]:
        with pytest.raises(InputError, match=words):
            call()
    assert np.abs(simulation.jvp(state, {}, {}, {"mobility": 1.0}, steps=2)["mass_fractions"]).max() > 0.0


def test_steps_that_begin_as_the_last_ones_have_the_bits_of_steps_that_begin_anew():
    """Also where other parameters, and ways back, come between them."""
    given = [{"gravity": [k - 2.0, -9.0 - k]} for k in range(4)]
    given += [{"viscosity": 0.5}, given[0], {"gravity": [0.0, -9.81]}, {}, {"gravity": [[1.0, -9.81]]}, {}]
    simulation = Simulation(plane())
    state, host = simulation.on_device(), simulation.state()
    kept = None
    for k, parameters in enumerate(given):
        state, host = simulation.step(state, parameters), Simulation(plane()).step(host, parameters)
        for name, own in host.fields.items():
            assert state[name].numpy()[..., : own.shape[-1]].tobytes() == own.tobytes(), (parameters, name)
        if kept is not None and k > 6:
            simulation.stepper(1).vjp(kept, {"positions": state["positions"]})
        if k == 5:
            _, kept = simulation.stepper(1).step(state, {"gravity": [3.0, 1.0], "viscosity": 0.1})
