"""States and parameters over time that stay on the device: the bits of those on the host, there and back."""

import pickle
from typing import Any

import numpy as np
import pytest
import warp as wp

import cortado
from cortado import DivergedError, InputError, Simulation
from cortado.optimisation.layers.functions import Steps
from cortado.optimisation.layers.layer import PARAMETER, STATE, named
from cortado.optimisation.layers.layer import on_host as arrays_on_host
from cortado.particles.state import State
from layered import same_bits
from scenes import jet, plane, pool, pour, scene, two_layers
from test_stepper import assert_same_state, last_adjoint, scheduled

CUDA = pytest.mark.skipif(not wp.is_cuda_available(), reason="there is no CUDA device")
SCENES = {"one fluid": plane, "in space": scene, "mixture": two_layers, "schedule": scheduled, "jet": jet, "pour": pour}


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=CUDA)])
def device(request):
    return request.param


class Foreign:
    """An array of another program, of which only the memory is known."""

    def __init__(self, values):
        self._values = values

    def __dlpack__(self, **options):
        return self._values.__dlpack__(**options)

    def __dlpack_device__(self):
        return self._values.__dlpack_device__()


def vectors(simulation, values):
    """On the device's side: three components, in its precision."""
    found = np.zeros((*values.shape[:-1], 3), dtype=simulation.precision.name)
    found[..., : values.shape[-1]] = values
    return Foreign(given(simulation, found))


def given(simulation, values):
    """On the device of a simulation."""
    return wp.array(values, device=simulation.device)


def taken(array):
    """What another program takes by DLPack, as NumPy has it."""
    return wp.from_dlpack(Foreign(array)).numpy()


def on_host(simulation, values):
    """What was given by DLPack as the host's derivatives are, in the shapes of a state's fields."""
    fields = {field.name: field for field in simulation.initial.fields}
    found = {}
    for name, value in values.items():
        array = np.array(taken(value) if isinstance(value, wp.array) else value, dtype=np.float64)
        is_vector = name in fields and fields[name].entry.name == "VECTOR"
        found[name] = array[..., : simulation.dimension] if is_vector else array
    return found


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", SCENES)
def test_steps_and_derivatives_have_the_bits_of_those_on_the_host(name, precision, device):
    simulation = Simulation(SCENES[name](), device, precision)
    parameters = {"viscosity": 1.1 * np.asarray(simulation.parameters()["viscosity"]), "time_step": 0.0018}
    first, stepper = simulation.step(simulation.state(), steps=3), simulation.stepper(5)
    wanted, residual = stepper.step(first, parameters)
    found, same_residual = stepper.step(simulation.on_device(first), parameters)
    host = {n: taken(found[n]) for n in wanted.fields}
    assert on_host(simulation, host).keys() == wanted.fields.keys()
    for field, array in on_host(simulation, host).items():
        assert array.tobytes() == np.float64(wanted[field]).tobytes(), field
    assert (found.scenes[0].clock, found.scenes[0].origin) == (wanted.clock, wanted.origin)
    x, v = (np.float64(wanted[n]) for n in ("positions", "velocities"))
    bars, parts = stepper.vjp(residual, last_adjoint(wanted) | {"time": 0.3})
    adjoint = {"positions": vectors(simulation, 2.0 * x + v), "velocities": vectors(simulation, x), "time": 0.3}
    same_bars, same_parts = stepper.vjp(same_residual, adjoint)
    for one, other in ((bars, same_bars), (parts, same_parts)):
        same_bits(one, on_host(simulation, other))
    pull = {"gravity": np.ones(simulation.dimension)}
    same_dots = stepper.jvp(same_residual, {"velocities": vectors(simulation, x)}, pull)
    same_bits(stepper.jvp(residual, {"velocities": x}, pull), on_host(simulation, same_dots))


def test_nothing_of_a_state_passes_through_the_host(monkeypatch, device):
    simulation = Simulation(two_layers(), device)
    state, stepper = simulation.on_device(), simulation.stepper(3)
    x = simulation.on_device()["positions"]
    for _ in range(2):
        end, residual = stepper.step(state)
        wanted = taken(end["positions"])
        stepper.vjp(residual, {"positions": x})
        stepper.jvp(residual, {"positions": x})
    fail = lambda some: pytest.fail("through the host") if some else {}  # noqa: E731
    monkeypatch.setattr(State, "set", lambda self, values: fail(values))
    monkeypatch.setattr(State, "numpy", lambda self, dimension, only=("all",): fail(only))
    end, residual = stepper.step(state)
    bar = stepper.vjp(residual, {"positions": x})[0]
    dot = stepper.jvp(residual, {"positions": x})
    assert taken(end["positions"]).tobytes() == wanted.tobytes()
    assert bar["velocities"].dtype is wp.float32 and dot["velocities"].shape == x.shape


def test_a_batch_on_the_device_has_the_bits_of_one_on_the_host(device):
    simulation = Simulation(scheduled(), device, batch=3)
    parameters = {"viscosity": [0.05, 0.1, 0.3]}
    states, on_device = simulation.state(), simulation.on_device()
    for _ in range(3):
        states, on_device = (simulation.step(one, parameters, steps=4) for one in (states, on_device))
    found = taken(on_device["velocities"])
    assert found.shape == (3, simulation.particles, 3)
    assert found[..., :2].tobytes() == np.stack([state["velocities"] for state in states]).tobytes()
    assert [scene.clock for scene in on_device.scenes] == [state.clock for state in states]


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_a_scene_of_a_batch_that_is_lost_has_no_numbers_on_the_device(device):
    simulation = Simulation(plane(), device, batch=2)
    fast = np.zeros((2, simulation.particles, 2))
    fast[1, 0] = [400.0, 0.0]
    state = simulation.step(simulation.on_device(parameters={"initial_velocities": fast}), steps=3)
    one, lost = taken(state["positions"])
    assert one[:, :2].tobytes() == Simulation(plane(), device).run(3).positions[-1].tobytes() and np.isnan(lost).all()
    one, lost = taken(simulation.step(state, steps=2)["positions"])
    assert one[:, :2].tobytes() == Simulation(plane(), device).run(5).positions[-1].tobytes() and np.isnan(lost).all()
    assert np.isnan(simulation.on_host(state)[1]["positions"]).all()


def test_fields_of_other_programs_replace_those_of_a_state(device):
    simulation = Simulation(plane(), device, precision="float64")
    state = simulation.step(simulation.state(), steps=4)
    faster = 1.5 * state["velocities"]
    found = simulation.step(simulation.on_device(state, {"velocities": vectors(simulation, faster)}), steps=2)
    begun = type(state)({**state.fields, "velocities": faster}, state.clock, state.origin)
    wanted = simulation.run(2, state=begun).last_state
    assert taken(found["positions"])[:, :2].tobytes() == wanted["positions"].tobytes()
    assert_same_state(simulation.step(state, steps=2), simulation.run(2, state=state).last_state)
    back = simulation.on_host(simulation.on_device(state))
    assert_same_state(back, state)
    assert back in simulation.judged_states


def test_what_does_not_fit_is_a_sentence(device):
    simulation = Simulation(plane(), device)
    state, n = simulation.on_device(), simulation.particles
    crowded = np.zeros((n, 3), dtype=np.float32)
    single = np.zeros((n, 3), dtype=np.float32)
    single[:, :2] = simulation.velocities
    single[5] = np.nan
    narrow = np.zeros((n, 2), dtype=np.float32)
    other, several = Simulation(plane(), precision="float64"), Simulation(plane(), batch=2)
    fields = {
        r"velocities is a float64 array \(64, 3\) on cpu, but must be a float32": {"velocities": np.zeros((n, 3))},
        r"\(64, 2\) on cpu, but must be a float32 array \(64, 3\)": {"velocities": narrow},
        "must be an array with DLPack": {"velocities": [[0.0, 0.0]]},
        "velocities cannot be read as a DLPack array: Unsupported": {"velocities": np.array([["fast"]])},
        "not finite": {"velocities": given(simulation, single)},
        "at one place": {"positions": given(simulation, crowded)},
        "velocities has a third component other than 0": {"velocities": given(simulation, crowded + np.float32(1.0))},
        "'pressure', but must have only positions": {"pressure": given(simulation, crowded)},
    }
    for use, words in [
        *((lambda own=own: simulation.on_device(state, own), words) for words, own in fields.items()),
        (lambda: simulation.vjp(state, {}, {"velocities": narrow}), r"state_bar velocities is .* \(64, 2\) on cpu"),
        (lambda: other.step(state), "of a simulation with other arrays"),
        (lambda: several.step(state), "of a simulation with other arrays"),
        (lambda: Simulation(plane(), device).step(state), "of another simulation, but must be of this simulation"),
        (lambda: state["pressure"], "has no 'pressure', but has positions"),
        (lambda: simulation.step(state, {"rest_density": 900.0}), "of the first run again"),
        (lambda: pickle.dumps(state), "cannot be pickled or copied"),
        (lambda: simulation.on_host(3), "state is 3, but must be a DeviceState"),
        (lambda: simulation.step(state, {"gravity": on_device(np.zeros((3, 2)), "float32")}), "is a float32 array"),
        (lambda: simulation.step(state, {"gravity": on_device(np.zeros(2))}), r"gravity is a float64 array \(2,\) on"),
    ]:
        with pytest.raises(InputError, match=words):
            use()
    assert repr(state).startswith("DeviceState(positions (64, 3), velocities (64, 3), ")


STEPS = 4


def simulation(precision: str = "float64", **changes: Any) -> cortado.Simulation:
    scene: dict[str, Any] = {
        "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 0.5}],
        "solver": {"kind": "pcisph", "time_step": 0.002, "minimum_iterations": 2, "maximum_iterations": 2},
    }
    return Simulation(pool([0.5, 0.5], [1.0, 1.0], 0.1, **{**scene, **changes}), precision=precision)


def on_device(values: np.ndarray, precision: str = "float64") -> wp.array:
    return wp.array(values, dtype=getattr(wp, precision), device="cpu")


def numbers(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("shape", [(2,), (STEPS, 2)])
def test_of_one_scene(shape: tuple[int, ...], precision: str) -> None:
    own = simulation(precision)
    stepper, first = own.stepper(STEPS), own.on_device()
    gravity = numbers(0, *shape).astype(precision)
    end, residual = stepper.step(first, {"gravity": on_device(gravity, precision), "viscosity": 0.3})
    wanted, of_host = stepper.step(first, {"gravity": gravity, "viscosity": 0.3})
    assert np.array_equal(end["positions"].numpy(), wanted["positions"].numpy())
    bar = {"positions": on_device(numbers(1, 25, 3).astype(precision), precision)}
    state_bar, found = stepper.vjp(residual, bar)  # which has been put aside
    wanted_bar, of_values = stepper.vjp(of_host, bar)
    assert found["gravity"].shape == shape and np.abs(of_values["gravity"]).max() > 1e-8
    rtol = 1e-14 if precision == "float64" else 1e-5
    np.testing.assert_allclose(found["gravity"].numpy(), of_values["gravity"], rtol=rtol)
    assert found["viscosity"] == of_values["viscosity"]
    assert np.array_equal(state_bar["velocities"].numpy(), wanted_bar["velocities"].numpy())
    direction = numbers(2, *shape).astype(precision)
    dots = [
        stepper.jvp(one, {}, {"gravity": along})["positions"].numpy()
        for one, along in ((residual, on_device(direction, precision)), (of_host, direction))
    ]
    assert np.array_equal(*dots) and dots[0].any()


@pytest.mark.parametrize("shape", [(2,), (STEPS, 2), (1, STEPS, 2), (3, 1, 2), (3, STEPS, 2)])
def test_of_a_batch(shape: tuple[int, ...]) -> None:
    own = simulation().batch_of(3)
    stepper, first, gravity = own.stepper(STEPS), own.on_device(), numbers(0, *shape)
    end, residual = stepper.step(first, {"gravity": on_device(gravity)})
    wanted, of_host = stepper.step(first, {"gravity": gravity})
    assert np.array_equal(end["positions"].numpy(), wanted["positions"].numpy())
    bar = {"positions": on_device(numbers(1, 3, 25, 3))}
    found, each = stepper.vjp(residual, bar)[1]["gravity"], stepper.vjp(of_host, bar)[1]["gravity"]
    summed = each if each.shape == shape else each.sum(axis=0).reshape(shape)
    np.testing.assert_allclose(found.numpy(), summed, rtol=1e-13)


def test_what_is_no_number_ends_the_run() -> None:
    """And a direction that does not fit is a sentence."""
    own = simulation()
    stepper, first = own.stepper(STEPS), own.on_device()
    with pytest.raises(DivergedError, match=r"diverged in step 2.*try a smaller time step than 0\.002 s"):
        stepper.step(first, {"gravity": on_device([[0, 0], [np.nan, 0], [0, 0], [0, 0]])})
    with pytest.raises(InputError, match=r"direction gravity is a float64 array \(3, 2\) on cpu, but must be float64"):
        stepper.jvp(stepper.step(first)[1], {}, {"gravity": on_device(np.zeros((3, 2)))})


def test_a_schedule_is_replaced_by_rows() -> None:
    """So that the derivatives with respect to the time step and to the time do not see it."""
    schedule = {"tilt": {"times": [0.0, 0.008], "values": [[0.0], [30.0]]}}
    own = simulation(schedule=schedule)
    stepper, first, gravity = own.stepper(STEPS), own.on_device(), numbers(0, STEPS, 2)
    bar = {"velocities": on_device(numbers(1, 25, 3))}
    found = [
        stepper.vjp(stepper.step(first, {"gravity": rows, "time_step": 0.002})[1], bar)
        for rows in (on_device(gravity), gravity)
    ]
    assert found[0][0]["time"] == found[1][0]["time"] == 0.0
    assert found[0][1]["time_step"] == found[1][1]["time_step"] != 0.0
    scheduled = stepper.vjp(stepper.step(first, {"time_step": 0.002})[1], bar)
    assert scheduled[0]["time"] != 0.0


@pytest.mark.parametrize("size", [None, 3])
@pytest.mark.parametrize("shape", [(2,), (STEPS, 2)])
def test_a_layer_leaves_them_there(shape: tuple[int, ...], size: int | None) -> None:
    """As layers get them on a GPU: of one evaluation, and of several that are mapped."""
    own = simulation()
    layer, many = Steps(own, STEPS), () if size is None else (size,)
    layer = layer if size is None else layer.batched(size)
    begun = layer._simulation.on_device(own.state() if size is None else (own.state(),) * size, parameters={})
    first = named(STATE, layer.states.arrays(begun))
    bars, name = {STATE + "positions": numbers(1, *many, 25, 2)}, PARAMETER + "gravity"
    found = []
    for array in (on_device, np.asarray):
        given = {**first, name: array(numbers(0, *many, *shape))}
        end, residual = layer.evaluate(given, keep=True)
        bar = layer.pull(residual, bars)[name]
        assert isinstance(bar, wp.array) == isinstance(given[name], wp.array)
        dots = layer.push(residual, {name: array(numbers(2, *many, *shape))})
        found.append([arrays_on_host(one) for one in (end[STATE + "positions"], bar, dots[STATE + "positions"])])
    for ours, theirs in zip(*found, strict=True):
        np.testing.assert_allclose(ours.reshape(theirs.shape), theirs, rtol=1e-13, atol=1e-18)
        assert theirs.any()
