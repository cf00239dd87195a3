"""Steps as a function of a state: chained, they have the bits of one run."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from cortado import InputError, Scene, Simulation
from scenes import jet, plane, plane_of_three, pour, scene, two_layers

SWAY = {"times": [0.0, 0.03, 0.06, 0.1], "values": [[0.0, -9.81], [8.0, -9.81], [-5.0, -7.0], [0.0, -9.81]]}
PATH = {"times": [0.0, 0.02, 0.05], "values": [[0.3, 0.26], [0.34, 0.28], [0.28, 0.3]]}


def scheduled() -> Scene:
    return plane(schedule={"gravity": SWAY})


def moving_jet() -> Scene:
    return jet(schedule={"nozzle_path": PATH})


def tense() -> Scene:
    honey = [{"name": "water", "rest_density": 1000.0, "viscosity": 0.6}]
    return plane(phase=honey, forces={"gravity": [0.0, -9.81], "surface_tension": 0.5})


def periodic() -> Scene:
    room = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.7, 0.8], "periodic": [True, False]}
    return plane(container=room, forces={"gravity": [0.5, -9.81]})


SCENES = {
    "one fluid": plane,
    "in space": scene,
    "mixture": two_layers,
    "three fluids": plane_of_three,
    "schedule": scheduled,
    "jet": moving_jet,
    "pour": pour,
    "surface tension": tense,
    "periodic": periodic,
}


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


def test_steps_of_a_batch_have_the_bits_of_one_run():
    simulation = Simulation(scheduled(), batch=3)
    parameters = {"viscosity": [0.05, 0.1, 0.3]}
    whole = simulation.run(30, parameters)
    states = simulation.state()
    for _ in range(3):
        states = simulation.step(states, parameters, steps=10)
    assert isinstance(states, tuple) and len(states) == 3
    for b in range(3):
        assert_same_state(states[b], whole[b].last_state)


def test_parameters_of_steps_are_those_of_the_steps_to_come():
    simulation = Simulation(moving_jet(), precision="float64")
    gravity = np.array([0.0, -9.81]) + np.sin(np.arange(20))[:, None]
    path = np.array([0.3, 0.26]) + 0.002 * np.sin(0.2 * np.arange(20))[:, None]
    start = {"initial_velocities": 0.1 * np.random.default_rng(0).standard_normal((simulation.particles, 2))}
    whole = simulation.run(20, {"gravity": gravity, "nozzle_path": path, **start})
    state = simulation.state({"nozzle_path": path[0], **start})
    for k in (0, 10):
        state = simulation.step(state, {"gravity": gravity[k : k + 10], "nozzle_path": path[k : k + 10]}, steps=10)
    assert_same_state(state, whole.last_state)


def test_what_a_step_cannot_take_is_refused_in_a_sentence():
    simulation = Simulation(plane())
    state = simulation.state()
    for arguments, words in [
        ((None, {"viscosity": -1.0}), "viscosity"),
        ((state, {"initial_velocities": simulation.velocities}), "must be left out with a state"),
        ((simulation.initial,), "must be a RestartState"),
        (([state, state],), "has 2 states, but must have 1"),
        ((replace(state, fields={"positions": state["positions"]}),), "but must have"),
        ((state, {}, 0), "steps"),
        ((state, {}, 2.5), "steps"),
    ]:
        with pytest.raises(InputError, match=words):
            simulation.step(*arguments)
    with pytest.raises(InputError, match="has 1 states, but must have 3"):
        Simulation(plane(), batch=3).step(state)


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
    with pytest.raises(InputError, match="to be given again"):
        simulation.step(state, {"rest_density": 900.0})
    again = pickle.loads(pickle.dumps(state))
    assert_same_state(simulation.step(again), simulation.step(state))


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_a_scene_of_a_batch_that_is_lost_has_no_numbers_and_cannot_go_on():
    simulation = Simulation(plane(), batch=2)
    fast = np.zeros((2, simulation.particles, 2))
    fast[1, 0] = [400.0, 0.0]
    one, lost = simulation.step(simulation.state({"initial_velocities": fast}), steps=3)
    assert_same_state(one, Simulation(plane()).run(3).last_state)
    assert np.isnan(lost["positions"]).all() and np.isnan(lost["velocities"]).all()
    with pytest.raises(InputError, match="not finite"):
        simulation.step([one, lost])


def test_from_the_second_call_on_nothing_is_allocated_on_the_device(monkeypatch):
    simulation = Simulation(plane())
    state = simulation.state()
    for _ in range(2):
        state = simulation.step(state, steps=3)
    made = []
    for name in ("zeros", "empty", "zeros_like", "empty_like", "clone", "full"):
        monkeypatch.setattr(wp, name, lambda *a, name=name, **k: made.append(name))
    monkeypatch.setattr(wp, "ScopedCapture", lambda *a, **k: made.append("capture"))
    for _ in range(2):
        state = simulation.step(state, steps=3)
    assert not made and state.clock.steps == 12
