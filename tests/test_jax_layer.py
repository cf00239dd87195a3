"""Cortado as a layer of JAX, what it has alone (see test_layer.py): compiled programs, lost scenes, bad uses."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

import cortado
import layered
from cortado import InputError, Problem, Simulation, gradients, sensors
from cortado.optimisation.layers.layer import KEPT
from layered import BAD_PARAMETERS, STIFF, assert_refused, matched, same_bits, scheduled, shear, sheared
from scenes import Squares, plane, two_layers


@pytest.fixture(scope="module")
def layer(jax):
    import cortado.jax

    return cortado.jax


@pytest.fixture(scope="module")
def simulation():
    return Simulation(sheared(), precision="float64")


@pytest.fixture(scope="module")
def problem(simulation):
    return matched(simulation)


@pytest.fixture(scope="module")
def point(jax, simulation):
    values = simulation.positions, shear(simulation), np.array([0.4, -9.0]), np.array(0.7)
    return tuple(jax.numpy.asarray(value) for value in values)


def test_compiled_scanned_and_recomputed_segments_have_the_same_gradient(jax, layer, simulation, point):
    first = {**layer.state(simulation), "velocities": point[1]}

    def loss(segments, gravity, viscosity):
        parameters = {"gravity": gravity, "viscosity": STIFF * viscosity}
        end = segments(lambda state: layer.step(simulation, state, parameters, steps=10), first)
        return (end["positions"] ** 2).sum() + (end["velocities"] ** 2).sum()

    def unrolled(advance, state):
        return advance(advance(advance(state)))

    def scanned(advance, state):
        return jax.lax.scan(lambda before, _: (advance(before), None), state, None, length=3)[0]

    def recomputed(advance, state):
        return scanned(jax.checkpoint(advance), state)

    wanted = jax.grad(partial(loss, unrolled), argnums=(0, 1))(*point[2:])
    assert all(np.abs(one).max() > 1e-2 for one in wanted)
    for segments in (unrolled, scanned, recomputed):
        found = jax.jit(jax.grad(partial(loss, segments), argnums=(0, 1)))(*point[2:])
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12)


def test_steps_go_back_by_an_estimator_one_by_one_and_mapped(jax, layer, simulation, point):
    viscous = gradients.AdjointViscosity()
    first = {**layer.state(simulation), "velocities": point[1]}

    def far(way, gravity):
        end = way(first, {"gravity": gravity})
        return (end["positions"] ** 2).sum() + (end["velocities"] ** 2).sum()

    def scanned(state, parameters, gradient=viscous):
        advance = partial(layer.step, simulation, parameters=parameters, steps=10, gradient=gradient)
        return jax.lax.scan(lambda before, _: (advance(before), None), state, None, length=2)[0]

    def rolled(state, parameters):
        states = layer.rollout(simulation, state, parameters, 20, 10, viscous)
        return {name: array[-1] for name, array in states.items()}

    squares = Squares({"positions": 1.0, "velocities": 1.0})
    problem = Problem(simulation, 20, squares, state=layer.restart_state(simulation, first))
    wanted = problem.value_and_gradient({"gravity": point[2]}, viscous)[1]["gravity"]
    for way in (scanned, rolled):
        np.testing.assert_allclose(jax.jit(jax.grad(partial(far, way)))(point[2]), wanted, rtol=1e-12)
    exact = jax.grad(partial(far, partial(scanned, gradient=None)))(point[2])
    assert np.abs(exact - wanted).max() > 1e-9 * np.abs(wanted).max()
    both = jax.vmap(jax.grad(partial(far, scanned)))(jax.numpy.stack([point[2], 1.1 * point[2]]))
    np.testing.assert_allclose(both[0], wanted, rtol=1e-12)


def test_residuals_that_are_gone_are_computed_again(jax, layer, simulation, point, monkeypatch):
    from cortado.optimisation.layers import with_jax

    first = layer.state(simulation)

    def loss(viscosity):
        state = {**first, "velocities": point[1]}
        for _ in range(3):
            state = layer.step(simulation, state, {"viscosity": STIFF * viscosity}, steps=5)
        return (state["velocities"] ** 2).sum()

    waiting = len(with_jax.RESIDUALS)
    wanted = jax.grad(loss)(point[3])
    assert len(with_jax.RESIDUALS) == waiting
    monkeypatch.setattr(with_jax, "MOST_KEPT", 0)
    computed = []
    monkeypatch.setattr(with_jax, "evaluate", lambda *a, own=with_jax.evaluate, **k: computed.append(1) or own(*a, **k))
    assert jax.grad(loss)(point[3]) == wanted and len(computed) == 3 + 2


def test_a_gradient_is_taken_twice_from_one_forward_run(jax, problem, layer):
    _, back = jax.vjp(lambda m: layer.value(problem)({"viscosity": m}), jax.numpy.asarray(10.0))
    assert back(1.0) == back(1.0) != 0.0


GONE = np.array([[0.4, -9.0], [9e5, 0.0], [-1.0, -8.0]])
"""Gravities, the second of which throws the fluid through the wall."""


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_lost_scene_of_a_map_adds_nothing_where_its_cotangent_is_0(jax, layer, precision):
    """To the derivatives of what the scenes share: of values, of values from states, and of scanned steps, through
    which it passes without numbers."""
    np_, sheared_one = jax.numpy, Simulation(sheared(), precision=precision)
    problem = matched(sheared_one)
    first, kept = layer.state(sheared_one), np.array([0, 2])

    def states(rows, viscosity):
        own = jax.tree.map(lambda array: np_.broadcast_to(array, (len(rows), *array.shape)), first)

        def body(before, _):
            move = lambda one, g: layer.step(sheared_one, one, {"gravity": g, "viscosity": viscosity}, steps=4)  # noqa: E731
            after = jax.vmap(move)(before, rows)
            return after, None

        return jax.lax.scan(body, own, None, length=2)[0]

    def values(rows, viscosity):
        return jax.vmap(lambda g: layer.value(problem)({"gravity": g, "viscosity": viscosity}))(rows)

    def later(rows, viscosity):
        return jax.vmap(lambda one: layer.value(problem)({"viscosity": viscosity}, one))(states(rows, viscosity))

    def ends(rows, viscosity):
        return states(rows, viscosity)["positions"].sum(axis=(1, 2))

    rows, viscosity = np_.asarray(GONE, sheared_one.precision.numpy), np_.asarray(9.0, sheared_one.precision.numpy)
    for each in (values, later, ends):

        def summed(total, rows, viscosity, each=each):
            found = each(rows, viscosity)
            return total(found), found

        gradients_of = [jax.grad(partial(summed, total), (0, 1), has_aux=True) for total in (np_.nansum, np_.sum)]
        (_, wanted), alone = gradients_of[1](rows[kept], viscosity)
        assert wanted != 0.0
        for gradient in (gradients_of[0], *([jax.jit(gradients_of[0])] if each is ends else [])):
            (by_row, along), found = gradient(rows, viscosity)
            assert np.isnan(found).tolist() == [False, True, False]
            assert np.asarray(found)[kept].tobytes() == np.asarray(alone).tobytes()
            assert np.asarray(along).tobytes() == np.asarray(wanted).tobytes()
            assert (by_row[1] == 0.0).all() and np.asarray(by_row)[kept].all()
        assert np.isnan(gradients_of[1](rows, viscosity)[0][1])


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
def test_lost_evaluations_of_a_map_that_goes_one_by_one_leave_the_others(jax, layer, simulation, problem):
    """As an estimator without batches does, and what measures: from states of lost scenes, too."""
    estimator, kept = gradients.RandomizedSmoothing(samples=2), np.array([0, 2])
    loss = jax.vmap(lambda g, v: layer.value(problem, estimator)({"gravity": g, "viscosity": v}), (0, None))
    found, wanted = loss(GONE, 9.0), loss(GONE[kept], 9.0)
    assert np.isnan(found).tolist() == [False, True, False] and found[kept].tobytes() == wanted.tobytes()
    found = jax.grad(lambda v: jax.numpy.nansum(loss(GONE, v)))(9.0)
    assert found == jax.grad(lambda v: loss(GONE[kept], v).sum())(9.0) != 0.0
    first = layer.state(simulation)

    def densities(gravities):
        def measured(gravity):
            end = layer.step(simulation, first, {"gravity": gravity}, steps=2)
            return layer.measure(simulation, "density")(end).sum()

        return jax.vmap(measured)(gravities)

    found, wanted = densities(GONE), densities(GONE[kept])
    assert np.isnan(found).tolist() == [False, True, False] and found[kept].tobytes() == wanted.tobytes()
    along = jax.grad(lambda g: jax.numpy.nansum(densities(g)))(jax.numpy.asarray(GONE))
    assert np.isfinite(along).all() and along[kept].all() and not along[1].any()


def test_constant_rows_of_a_map_are_no_rows_of_steps(jax, layer, simulation):
    gravities = np.array([[0.4, -9.0], [0.0, -9.81], [-1.0, -8.0]])
    first = layer.state(simulation)
    found = jax.vmap(lambda g: layer.step(simulation, first, {"gravity": g}, steps=3)["velocities"])(gravities)
    wanted = [simulation.run(3, {"gravity": gravity}).last_state["velocities"] for gravity in gravities]
    np.testing.assert_array_equal(found, wanted)


def test_optax_and_optimistix_search(jax, layer, simulation):
    optax, optimistix = pytest.importorskip("optax"), pytest.importorskip("optimistix")
    target = simulation.run(10, {"gravity": [1.0, -9.0]}).positions[-1]
    loss = layer.value(cortado.Problem(simulation, 10, cortado.losses.FinalPositions(target)))
    start = {"gravity": jax.numpy.array([0.0, -9.81])}
    optimiser, parameters = optax.adam(0.1), start
    state = optimiser.init(parameters)
    for _ in range(30):
        updates, state = optimiser.update(jax.grad(loss)(parameters), state)
        parameters = optax.apply_updates(parameters, updates)
    assert loss(parameters) < 0.1 * loss(start)
    solver = optimistix.BFGS(rtol=1e-6, atol=1e-9)
    found = optimistix.minimise(lambda own, _: 1e4 * loss(own), solver, start, max_steps=20, throw=False)
    assert loss(found.value) < 1e-3 * loss(start)


@pytest.mark.parametrize("what", ["density", "wall_force", sensors.PressureProbe([0.2, 0.1])], ids=str)
def test_what_is_measured_has_the_derivatives_of_differences(jax, layer, simulation, what):
    from jax.test_util import check_grads

    state = layer.state(simulation, simulation.step(simulation.state(), {"gravity": [0.4, -9.0]}, steps=20))
    reading = layer.measure(simulation, what)

    def read(positions, velocities, gravity):
        return reading({**state, "positions": positions, "velocities": velocities}, {"gravity": gravity})

    arguments = state["positions"], state["velocities"], jax.numpy.array([0.4, -9.0])
    check_grads(read, arguments, order=1, modes=["fwd", "rev"], eps=1e-7)
    gradient = jax.grad(lambda *own: (read(*own) ** 2).sum(), argnums=(0, 1, 2))(*arguments)
    assert max(np.abs(one).max() for one in gradient) > 1.0
    if isinstance(what, str):
        wanted = simulation.quantity(what, layer.restart_state(simulation, state), {"gravity": [0.4, -9.0]})
        np.testing.assert_array_equal(read(*arguments), wanted)


def test_readings_are_gone_back_through_in_any_order(jax, layer):
    simulation = Simulation(scheduled(), precision="float64")
    early, late = (layer.state(simulation, simulation.run(steps).last_state) for steps in (5, 22))
    reading = layer.measure(simulation, "pressure")

    def gradient(*states):
        return jax.grad(lambda own: sum((reading(state) ** 2).sum() for state in own))(states)

    both, alone = gradient(early, late), (*gradient(early), *gradient(late))
    for one, other in zip(both, alone, strict=True):
        same_bits(one, other)
    assert alone[0]["time"] != 0.0 != alone[1]["time"]


def test_a_picture_has_the_derivatives_of_differences_in_reverse_mode(jax, layer):
    from jax.test_util import check_grads

    simulation = Simulation(two_layers(), precision="float64")
    renderer, state = simulation.renderer(resolution=(9, 8)), layer.state(simulation)
    colours = jax.numpy.array([[0.1, 0.4, 0.9], [0.7, 0.2, 0.1]])
    draw = partial(layer.picture, renderer)
    arguments = state["positions"], state["mass_fractions"], colours
    assert np.asarray(draw(*arguments)).tobytes() == renderer.render(*map(np.asarray, arguments)).tobytes()
    check_grads(draw, arguments, order=1, modes=["rev"], eps=1e-6)

    def through_steps(gravity):
        end = layer.step(simulation, state, {"gravity": gravity}, steps=3)
        return (draw(end["positions"], end["mass_fractions"], colours) ** 2).sum()

    gradient = jax.jit(jax.grad(through_steps))(jax.numpy.array([1.0, -9.0, 0.5]))
    eager = jax.grad(through_steps)(jax.numpy.array([1.0, -9.0, 0.5]))
    assert np.abs(gradient).max() > 0.0 and np.asarray(gradient).tobytes() == np.asarray(eager).tobytes()
    other = renderer.render(np.asarray(arguments[0]) + 0.01, *map(np.asarray, arguments[1:]))
    both = arguments[0] + jax.numpy.array([[[0.0]], [[0.01]]])
    assert jax.vmap(draw, in_axes=(0, None, None))(both, *arguments[1:])[1].tobytes() == other.tobytes()
    with pytest.raises(InputError, match="reverse mode only"):
        jax.jvp(draw, arguments, arguments)


BAD_STATES = {
    **layered.BAD_STATES,
    "float32": (lambda s: {**s, "positions": s["positions"].astype("float32")}, "state positions is float32, but"),
    "at one place": (
        lambda s: {**s, "positions": s["positions"].at[3].set(s["positions"][5])},
        "particles 3 and 5 at one place",
    ),
}


@pytest.mark.parametrize("name", BAD_STATES)
def test_a_bad_state_is_refused_in_a_sentence(layer, simulation, problem, name):
    change, words = BAD_STATES[name]
    assert_refused(words, *layered.uses_of_state(layer, simulation, problem, change(layer.state(simulation))))


@pytest.mark.parametrize("name", BAD_PARAMETERS)
def test_bad_parameters_are_refused_in_a_sentence(layer, simulation, problem, name):
    make, words = BAD_PARAMETERS[name]
    assert_refused(words, *layered.uses_of_parameters(layer, simulation, problem, make))


@dataclass
class Changing(gradients.AdjointEstimator):
    def derivative(self, rollout):
        return gradients.Exact().derivative(rollout)


def test_other_bad_uses_are_refused_in_a_sentence(jax, layer, simulation, problem):
    state = layer.state(simulation)
    other = layer.state(Simulation(plane(discretisation={"spacing": 0.04}), precision="float64"))
    gentle = gradients.RandomizedSmoothing(samples=4)
    single, rounded = jax.numpy.float32(2.0), np.array([0.0, -9.81], dtype=np.float16)
    half, brain = (
        {**state, "velocities": np.asarray(state["velocities"]).astype(one)} for one in ("float16", jax.numpy.bfloat16)
    )
    for use, words in [
        (lambda: layer.step(simulation, brain), "state velocities is bfloat16, but must be float32 or float64, as"),
        (lambda: layer.measure(simulation, "density")(half), "state velocities is float16, but must be float32 or"),
        (lambda: layer.step(simulation, state, {"gravity": rounded}), "parameter gravity is float16, but must be"),
        (lambda: layer.step(simulation, other), "state positions has shape"),
        (lambda: layer.step(simulation, state, {"viscosity": single}), "parameter viscosity is float32, but must be"),
        (lambda: layer.rollout(simulation, state, steps=5, record_every=2), "record_every is 2, but must divide the 5"),
        (lambda: layer.step(simulation, state, gradient=gentle), "estimator is .*, but must be an AdjointEstimator"),
        (lambda: layer.step(simulation, state, gradient=Changing()), "estimator has an unhashable type: 'Changing'"),
        (lambda: layer.value(problem, gentle)({}, state), "gradient is a RandomizedSmoothing, but must be an Adj"),
        (lambda: layer.measure(Simulation(plane(), batch=2), "density"), "simulation is a batch of 2 scenes, but must"),
        (lambda: layer.picture(simulation, state["positions"]), "renderer is .*, but must be a renderer, such as"),
    ]:
        assert_refused(words, use)


def test_second_derivatives_are_refused_in_a_sentence(jax, layer, problem):
    loss = layer.value(problem)
    for second in (jax.hessian, lambda f: jax.grad(jax.grad(f)), lambda f: jax.jacfwd(jax.jacfwd(f))):
        with pytest.raises(InputError, match="only first derivatives exist"):
            second(lambda m: loss({"viscosity": m}))(jax.numpy.asarray(10.0))


def test_within_a_compiled_program_the_error_has_the_sentence(jax, layer, simulation, problem, capfd):
    loss = jax.jit(lambda m: layer.value(problem)({"viscosity": m}))
    with pytest.raises(Exception, match=r"OutOfRangeError: parameter viscosity is -1\.0, but must be at least 0"):
        loss(jax.numpy.asarray(-1.0)).block_until_ready()
    fast = jax.numpy.full((64, 2), 400.0)
    run = jax.jit(lambda v: layer.step(simulation, {**layer.state(simulation), "velocities": v}, steps=2)["positions"])
    with pytest.raises(Exception, match="DivergedError: The simulation diverged in step 1"):
        run(fast).block_until_ready()
    with pytest.raises(InputError, match=r"parameter gravity has shape \(3,\)"):
        jax.jit(lambda g: layer.value(problem)({"gravity": g}))(jax.numpy.zeros(3))
    assert loss(jax.numpy.asarray(10.0)) > 0.0
    assert "Traceback" not in "".join(capfd.readouterr())


def test_an_error_that_is_not_ours_has_its_traceback(jax, layer, problem, capfd, monkeypatch):
    loss = jax.jit(lambda m: layer.value(problem)({"viscosity": m}))
    monkeypatch.setattr("cortado.optimisation.layers.with_jax.evaluate", lambda *given: 1 / 0)
    with pytest.raises(Exception, match="ZeroDivisionError"):
        loss(jax.numpy.asarray(10.0)).block_until_ready()
    assert "Traceback" in capfd.readouterr().err


def test_float64_needs_a_jax_that_has_it(jax, layer, problem):
    single = Simulation(sheared())
    jax.config.update("jax_enable_x64", False)
    try:
        end = layer.step(single, layer.state(single), {"viscosity": 3.0})
        assert end["positions"].dtype == end["time"].dtype == "float32"
        assert jax.grad(lambda m: layer.value(matched(single))({"viscosity": m}))(3.0) != 0.0
        for use in (lambda: layer.state(problem.simulation), lambda: layer.value(problem)({"viscosity": 3.0})):
            with pytest.raises(InputError, match=r"float64, but must be float32, as .*\(\"jax_enable_x64\", True\)"):
                use()
    finally:
        jax.config.update("jax_enable_x64", True)


def test_what_layers_keep_is_bounded(jax, layer, simulation, problem):
    loss = layer.value(problem)
    for size in (1, 2, 3, 4):
        jax.vmap(lambda m: loss({"viscosity": m}))(jax.numpy.full(size, 10.0))
        layer.step(simulation, layer.state(simulation), steps=size)
    (own,) = {cell.cell_contents for cell in loss.__closure__ if hasattr(cell.cell_contents, "_batched")}
    assert len(own._batched) == KEPT and len(simulation.__dict__["_layers"]) <= 4
