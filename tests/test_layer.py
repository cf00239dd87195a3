"""Cortado as a layer of JAX and of PyTorch: what holds with both. What one of them has alone is in files of its own."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from cortado import InputError, Simulation, gradients
from cortado.optimisation.layers.layer import named_states
from finite_differences import central_difference
from layered import POINT, STIFF, matched, same_bits, scheduled, shear, sheared
from scenes import jet, plane, two_layers


def of_jax(jax):
    import cortado.jax

    given = {name: getattr(jax, name) for name in ("grad", "jvp", "vjp", "vmap", "jacrev", "jacfwd", "value_and_grad")}
    return SimpleNamespace(layer=cortado.jax, array=jax.numpy.asarray, compiled=jax.jit, **given)


def of_torch(_):
    torch = pytest.importorskip("torch", reason="PyTorch is not installed: its CPU wheel is optional")
    import cortado.torch

    def array(values):
        return torch.tensor(np.asarray(values), dtype=torch.float64)

    def value_and_grad(function, argnums=0):
        """By a graph."""

        def evaluated(*tables):
            own = [{name: one.clone().requires_grad_() for name, one in table.items()} for table in tables]
            value = function(*own)
            value.backward()
            found = [{name: one.grad for name, one in table.items()} for table in own]
            return value.detach(), tuple(found[k] for k in argnums) if argnums else found[0]

        return evaluated

    given = {name: getattr(torch.func, name) for name in ("grad", "jvp", "vjp", "vmap", "jacrev", "jacfwd")}
    layer = cortado.torch
    return SimpleNamespace(layer=layer, array=array, compiled=lambda f: f, value_and_grad=value_and_grad, **given)


@pytest.fixture(scope="module", params=[of_jax, of_torch], ids=["jax", "torch"])
def lib(request, jax):
    return request.param(jax)


@pytest.fixture(scope="module")
def simulation():
    return Simulation(sheared(), precision="float64")


@pytest.fixture(scope="module")
def problem(simulation):
    return matched(simulation)


def arrays(lib, values):
    return {name: lib.array(value) for name, value in values.items()}


def sheared_state(lib, simulation):
    return {**lib.layer.state(simulation), "velocities": lib.array(shear(simulation))}


def test_chained_segments_have_the_derivatives_of_differences(lib, simulation):
    """40 steps in two segments, in both modes, with respect to each argument alone."""
    first, random = lib.layer.state(simulation), np.random.default_rng(2)
    weights = [lib.array(random.standard_normal(simulation.positions.shape)) for _ in range(2)]

    def end(own):
        state = {**first, "positions": own["positions"], "velocities": own["velocities"]}
        for _ in range(2):
            parameters = {"gravity": own["gravity"], "viscosity": STIFF * own["viscosity"]}
            state = lib.layer.step(simulation, state, parameters, steps=20)
        return (weights[0] * state["positions"]).sum() + (weights[1] * state["velocities"]).sum()

    values = {"positions": simulation.positions, "velocities": shear(simulation), "gravity": [0.4, -9.0]}
    point = arrays(lib, {**values, "viscosity": 0.7})
    gradient = lib.grad(end)(point)
    for name, value in point.items():
        along = lib.array(random.standard_normal(np.shape(value)))
        _, slope = lib.jvp(lambda one, name=name: end({**point, name: one}), (value,), (along,))
        assert float((gradient[name] * along).sum()) == pytest.approx(float(slope), rel=1e-9)
        # most directions lead through a kink within a longer step
        found = central_difference(lambda own: float(end({**point, **own})), {name: value}, {name: along}, 1e-8)
        assert found == pytest.approx(float(slope), rel=1e-4, abs=1e-5) and abs(slope) > 1e-3, name


@pytest.mark.parametrize("made", [two_layers, scheduled, jet])
def test_both_modes_agree_for_every_field_of_a_state(lib, made):
    """<bar, J dot> = <J^T bar, dot>, for the time too."""
    simulation = Simulation(made(), precision="float64")
    first = lib.layer.state(simulation, simulation.run(5).last_state)
    run, rng = partial(lib.layer.step, simulation, steps=4), np.random.default_rng(0)
    dot = arrays(lib, {name: rng.standard_normal(array.shape) for name, array in first.items()})
    end, pull = lib.vjp(run, first)
    bar = arrays(lib, {name: rng.standard_normal(array.shape) for name, array in end.items()})
    (back,) = pull(bar)
    for name in first:
        one = {**{n: 0.0 * a for n, a in dot.items()}, name: dot[name]}
        _, own = lib.jvp(run, (first,), (one,))
        wanted = sum(float((bar[n] * own[n]).sum()) for n in own)
        assert float((back[name] * dot[name]).sum()) == pytest.approx(wanted, rel=1e-9, abs=1e-9), name


ESTIMATORS = {
    "exact": None,
    "viscosity": gradients.AdjointViscosity(0.2),
    "order 2": gradients.AdjointViscosity(0.2, order=2),
    "smoothing": gradients.RandomizedSmoothing(samples=4),
}


@pytest.mark.parametrize("gradient", ESTIMATORS.values(), ids=ESTIMATORS)
def test_a_value_and_its_gradient_have_the_bits_of_the_problem(lib, problem, gradient):
    parameters = arrays(lib, POINT)
    wanted, wanted_gradient = problem.value_and_gradient(POINT, gradient)
    loss = lib.value_and_grad(lib.layer.value(problem, gradient))
    for evaluate in (loss, lib.compiled(loss)):
        found, found_gradient = evaluate(parameters)
        assert float(found) == wanted
        same_bits(found_gradient, wanted_gradient)


def test_forward_mode_of_a_value_is_the_tangent_of_the_problem(lib, problem):
    parameters, along = arrays(lib, POINT), arrays(lib, {"gravity": [1.0, 0.5], "viscosity": 3.0})
    _, found = lib.jvp(lib.layer.value(problem), (parameters,), (along,))
    assert float(found) == problem.tangent(POINT, {name: np.asarray(one) for name, one in along.items()})
    gradient = problem.value_and_gradient(POINT, gradients.AdjointViscosity(0.2))[1]
    _, filtered = lib.jvp(lib.layer.value(problem, gradients.AdjointViscosity(0.2)), (parameters,), (along,))
    assert float(filtered) == pytest.approx(sum(float((gradient[n] * np.asarray(along[n])).sum()) for n in along))


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("made", [scheduled, two_layers])
def test_chained_steps_and_rollouts_have_the_bits_of_one_run(lib, made, precision):
    simulation = Simulation(made(), precision=precision)
    wanted, state = simulation.run(12), lib.layer.state(simulation)
    states = lib.compiled(lambda first: lib.layer.rollout(simulation, first, steps=12, record_every=4))(state)
    for steps in (1, 7, 4):
        state = lib.layer.step(simulation, state, steps=steps)
    last = wanted.last_state
    same_bits({name: state[name] for name in last.fields}, last.fields)
    same_bits({name: states[name][-1] for name in last.fields}, last.fields)
    np.testing.assert_array_equal(states["positions"][1], wanted.positions[4])
    assert states["time"].shape == (4,) and float(state["time"]) == pytest.approx(last.clock.time, rel=1e-6)
    again = lib.layer.restart_state(simulation, state)
    same_bits(again.fields, last.fields)
    np.testing.assert_array_equal(simulation.run(3, state=again).positions[-1], simulation.run(15).positions[-1])


def test_a_state_that_steps_led_to_is_not_judged_again(lib, monkeypatch):
    simulation, judged = Simulation(plane(solver={"kind": "projection", "time_step": 0.002}), precision="float64"), []
    space = named_states(simulation)._space
    check = space.check_restarts
    monkeypatch.setattr(space, "check_restarts", lambda *given: judged.append(given) or check(*given))
    state = lib.layer.state(simulation)
    for _ in range(3):
        state = lib.layer.step(simulation, state, {"gravity": lib.array([0.4, -9.0])})
    assert len(judged) <= 1
    lib.layer.step(simulation, {**state, "velocities": 0.9 * state["velocities"]})
    assert len(judged) == 1


def test_a_rollout_gives_each_segment_its_rows_and_is_differentiated(lib, simulation):
    rows = np.array([0.0, -9.81]) + np.random.default_rng(1).standard_normal((6, 2))

    def rolled(gravity):
        return lib.layer.rollout(simulation, lib.layer.state(simulation), {"gravity": gravity}, 6, 2)["positions"]

    np.testing.assert_array_equal(rolled(lib.array(rows)), simulation.run(6, {"gravity": rows}).positions[::2])
    assert np.abs(lib.grad(lambda own: (rolled(own)[-1] ** 2).sum())(lib.array(rows))).min() > 0.0


def test_a_value_begins_at_a_state_and_has_its_gradient(lib, simulation, problem):
    state, parameters = lib.layer.state(simulation, simulation.run(9).last_state), arrays(lib, POINT)
    loss, (gradient, initial) = lib.value_and_grad(lib.layer.value(problem), argnums=(0, 1))(parameters, state)
    begun = problem.beginning_at(lib.layer.restart_state(simulation, state))
    wanted, wanted_gradient, wanted_initial = begun.value_and_gradients(POINT)
    assert float(loss) == wanted
    same_bits(gradient, wanted_gradient)
    same_bits(initial, {name: wanted_initial[name] for name in initial})
    along = {name: 0.0 * array + 1.0 for name, array in state.items()}
    _, forward = lib.jvp(lambda own: lib.layer.value(problem)(parameters, own), (state,), (along,))
    assert float(forward) == pytest.approx(sum(float(array.sum()) for array in initial.values()), rel=1e-12)


def test_a_map_is_a_batch_with_the_bits_of_single_evaluations(lib, simulation, problem):
    gravities, first = lib.array([[0.4, -9.0], [0.0, -9.81], [-1.0, -8.0]]), sheared_state(lib, simulation)

    def end(gravity):
        state = lib.layer.step(simulation, first, {"gravity": gravity}, steps=3)
        return lib.layer.step(simulation, state, {"gravity": gravity, "viscosity": 5.0}, steps=3)["positions"]

    def loss(gravity):
        return lib.layer.value(problem)({"gravity": gravity, "viscosity": 9.0})

    for function in (end, loss, lib.grad(loss), lib.grad(lambda g: (end(g) ** 2).sum())):
        wanted = np.stack([np.asarray(function(gravity)) for gravity in gravities])
        assert np.abs(wanted).max() > 0.0
        for mapped in (lib.vmap(function), lib.compiled(lib.vmap(function))):
            assert np.asarray(mapped(gravities)).tobytes() == wanted.tobytes()
    estimator = gradients.RandomizedSmoothing(samples=4)  # without batches: one by one
    alone = lib.vmap(lib.grad(lambda m: lib.layer.value(problem, estimator)({"viscosity": m})))(lib.array([10.0, 12.0]))
    wanted = [problem.value_and_gradient({"viscosity": m}, estimator)[1]["viscosity"] for m in (10.0, 12.0)]
    np.testing.assert_array_equal(alone, wanted)
    summed = lib.grad(lambda g: lib.vmap(loss)(g).sum())(gravities)
    np.testing.assert_array_equal(summed, lib.vmap(lib.grad(loss))(gravities))


def test_jacobians_by_both_modes_agree_and_are_mapped(lib, simulation):
    first = sheared_state(lib, simulation)

    def corner(gravity, viscosity):
        parameters = {"gravity": gravity, "viscosity": viscosity}
        return lib.layer.step(simulation, first, parameters, steps=1)["velocities"][0]

    gravities, viscosities = lib.array([[0.4, -9.0], [1.0, -9.0]]), lib.array([14.0, 3.0])
    alone = lib.jacfwd(corner, argnums=(0, 1))(gravities[0], viscosities[0])
    ways = (lib.vmap(way(corner, argnums=(0, 1))) for way in (lib.jacrev, lib.jacfwd))
    back, both = (way(gravities, viscosities) for way in ways)
    for of_one, one, other in zip(alone, back, both, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-13)
        assert float(abs(other).max()) > 1e-5
        np.testing.assert_array_equal(other[0], of_one)
    of_all = lib.jacrev(lambda own: lib.vmap(corner)(gravities, own))(viscosities)
    np.testing.assert_allclose(of_all[1, ..., 1], both[1][1], rtol=1e-8, atol=1e-13)


def test_a_batch_of_a_user_has_parameters_in_all_shapes(lib):
    problem = matched(Simulation(sheared(), precision="float64", batch=2))
    gravity = np.array([[[0.4, -9.0]], [[0.0, -9.81]]])
    losses, wanted = problem.value_and_gradient({"gravity": gravity, "viscosity": 9.0})
    loss = lib.layer.value(problem)
    given = lib.array(gravity), lib.array(9.0)
    found, pull = lib.vjp(lambda g, m: loss({"gravity": g, "viscosity": m}), *given)
    np.testing.assert_array_equal(found, losses)
    of_gravity, of_viscosity = pull(lib.array([1.0, 2.0]))
    np.testing.assert_array_equal(of_gravity, wanted["gravity"] * np.array([1.0, 2.0])[:, None, None])
    assert float(of_viscosity) == pytest.approx(wanted["viscosity"] @ [1.0, 2.0], rel=1e-14)
    batch = problem.simulation
    ends = lib.layer.step(batch, lib.layer.state(batch), {"gravity": given[0]}, steps=3)
    assert ends["positions"].shape == (2, 64, 2) and ends["time"].shape == (2,)
    with pytest.raises(InputError, match="is a batch of 2 cannot be mapped"):
        lib.vmap(lambda m: loss({"viscosity": m}))(lib.array([1.0, 2.0]))


def test_threads_that_share_a_layer_get_the_bits_of_one(lib, problem):
    loss = lib.value_and_grad(lib.layer.value(problem))

    def bits(viscosity):
        value, gradient = loss({"viscosity": lib.array(viscosity)})
        return float(value), float(gradient["viscosity"])

    points = [3.0, 8.0, 12.0, 17.0]
    wanted = [bits(one) for one in points]
    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(bits, points * 3)) == wanted * 3
