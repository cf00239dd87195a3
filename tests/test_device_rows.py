"""Parameters over time that stay on the device: the bits of the same from the host, in every shape, there and back."""

from typing import Any

import numpy as np
import pytest
import warp as wp

import cortado
from cortado.errors import DivergedError, InputError
from cortado.optimisation.layers.functions import Steps
from cortado.optimisation.layers.layer import PARAMETER, STATE, named, on_host

STEPS = 4


def simulation(precision: str = "float64", **changes: Any) -> cortado.Simulation:
    scene: dict[str, Any] = {
        "name": "rows",
        "dimension": 2,
        "discretisation": {"spacing": 0.1},
        "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 0.5}],
        "fluid": [{"shape": "box", "lower": [0, 0], "upper": [0.5, 0.5], "phase": "water"}],
        "container": {"shape": "box", "lower": [0, 0], "upper": [1, 1]},
        "solver": {"kind": "pcisph", "time_step": 0.002, "minimum_iterations": 2, "maximum_iterations": 2},
    }
    return cortado.Simulation(cortado.Scene(**{**scene, **changes}), precision=precision)


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
    np.testing.assert_allclose(
        found["gravity"].numpy(), of_values["gravity"], rtol=1e-14 if precision == "float64" else 1e-5
    )
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


def test_a_lost_scene_has_no_derivative() -> None:
    own = simulation().batch_of(2)
    stepper, gravity = own.stepper(STEPS), numbers(0, 2, STEPS, 2)
    gravity[1, 1] = np.nan
    with pytest.warns(cortado.CortadoWarning, match="scene 1"):
        _, residual = stepper.step(own.on_device(), {"gravity": on_device(gravity)})
    found = stepper.vjp(residual, {"positions": on_device(numbers(1, 2, 25, 3))})[1]["gravity"].numpy()
    assert np.isfinite(found[0]).all() and np.isnan(found[1]).all()
    silent = numbers(1, 2, 25, 3) * np.array([[[1.0]], [[0.0]]])
    one, lost = stepper.vjp(residual, {"positions": on_device(silent)})[1]["gravity"].numpy()
    assert one.tobytes() == found[0].tobytes() and not lost.any()


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


@pytest.mark.parametrize(
    ("array", "sentence"),
    [
        (on_device(np.zeros((3, 2))), r"gravity is a float64 array \(3, 2\) on cpu, but must be float64 of shape"),
        (on_device(np.zeros(2), "float32"), r"gravity is a float32 array \(2,\) on cpu, but must be float64 of shape"),
    ],
)
def test_others_are_refused(array: wp.array, sentence: str) -> None:
    own = simulation()
    with pytest.raises(InputError, match=sentence):
        own.stepper(STEPS).step(own.on_device(), {"gravity": array})
    with pytest.raises(InputError, match="direction " + sentence):
        _, residual = own.stepper(STEPS).step(own.on_device())
        own.stepper(STEPS).jvp(residual, {}, {"gravity": array})


def test_what_is_no_number_ends_the_run() -> None:
    own = simulation()
    with pytest.raises(DivergedError, match=r"diverged in step 2.*try a smaller time step than 0\.002 s"):
        own.stepper(STEPS).step(own.on_device(), {"gravity": on_device([[0, 0], [np.nan, 0], [0, 0], [0, 0]])})


@pytest.mark.parametrize("size", [None, 3])
@pytest.mark.parametrize("shape", [(2,), (STEPS, 2)])
def test_a_layer_leaves_them_there(shape: tuple[int, ...], size: int | None) -> None:
    """As layers get them on a GPU: of one evaluation, and of several that are mapped."""
    own = simulation()
    layer, many = Steps(own, STEPS), () if size is None else (size,)
    layer = layer if size is None else layer.batched(size)
    first = named(STATE, layer.states.of(own.state() if size is None else (own.state(),) * size, {}))
    bars, name = {STATE + "positions": numbers(1, *many, 25, 2)}, PARAMETER + "gravity"
    found = []
    for array in (on_device, np.asarray):
        given = {**first, name: array(numbers(0, *many, *shape))}
        end, residual = layer.evaluate(given, keep=True)
        bar = layer.pull(residual, bars)[name]
        assert isinstance(bar, wp.array) == isinstance(given[name], wp.array)
        dots = layer.push(residual, {name: array(numbers(2, *many, *shape))})
        found.append([on_host(one) for one in (end[STATE + "positions"], bar, dots[STATE + "positions"])])
    for ours, theirs in zip(*found, strict=True):
        np.testing.assert_allclose(ours.reshape(theirs.shape), theirs, rtol=1e-13, atol=1e-18)
        assert theirs.any()
