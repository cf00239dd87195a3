"""Bad uses of layers, environments and fits: each is refused in one sentence, before anything is computed."""

import re
from functools import partial
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

import cortado
import cortado.environments
from bad_scenes import one_sentence
from cortado import CortadoError, measured, sensors
from scenes import plane, pool
from scenes import scene as box

PADDLE = {"name": "paddle", "shape": "box", "lower": [0.5, 0.1], "upper": [0.6, 0.4], "motion": "path"}
PATH = "paddle.displacement"


@pytest.fixture(scope="module")
def at(jax):
    import cortado.jax

    made = SimpleNamespace(jax=jax, np=jax.numpy, layer=cortado.jax)
    tables = {"solid": [{**PADDLE, "velocity": [0.0, 0.0]}], "solver": {"kind": "projection", "time_step": 0.002}}
    made.scene = pool([0.4, 0.3], [0.8, 0.8], viscosity=1.0, **tables)
    made.simulation = cortado.Simulation(made.scene, precision="float64")
    made.state, made.gravity = made.layer.state(made.simulation), jax.numpy.array([0.0, -9.81])
    made.problem = cortado.Problem(made.simulation, 4, cortado.losses.CentreOfMass([0.2, 0.1]))
    made.loss = made.layer.value(made.problem)
    made.renderer = made.simulation.renderer(resolution=(8, 8))
    made.times, made.frames = 0.004 * np.arange(1, 5), np.random.default_rng(0).random((4, 8, 8, 3))
    made.video = measured.Video(made.renderer, made.times, made.frames)
    made.experiment = measured.Experiment(made.simulation, {"camera": made.video})
    made.env, made.closed = (gymnasium.make("cortado/Carry-v0").unwrapped for _ in range(2))
    made.vec = cortado.environments.make_vec("Carry", 2, autoreset_mode="Disabled")
    for one in (made.env, made.closed, made.vec):
        one.reset(seed=1)
    made.twin, made.ones = made.env.twin(1), jax.numpy.ones((3, 2))
    made.closed.close()
    made.batch = cortado.Simulation(made.scene, precision="float64", batch=2)
    made.other = cortado.Simulation(plane(), precision="float64")
    made.x, made.twin_in_jax = made.state["positions"], made.twin.in_jax()
    made.act, made.act_all = made.env.step, made.vec.step
    made.step_from, made.measure = (partial(call, made.simulation) for call in (made.layer.step, made.layer.measure))
    made.step, made.rollout = (
        partial(call, made.simulation, made.state) for call in (made.layer.step, made.layer.rollout)
    )
    made.picture = partial(made.layer.picture, made.renderer)
    made.fit, made.film = partial(cortado.fit, made.experiment), partial(measured.Video, made.renderer)
    made.seen = partial(measured.Experiment, made.simulation)
    made.make_one = partial(gymnasium.make, "cortado/Carry-v0")
    made.make = partial(cortado.environments.make_vec, "Carry")
    return made


REFUSED = [
    # layers
    (lambda at: at.jax.jit(lambda k: at.step(steps=k)["positions"])(2), "steps is JitTracer(~int64[]), but must be a"),
    (
        lambda at: at.jax.vmap(lambda a: at.loss({"gravity": a}), in_axes=1)(at.ones),
        "parameter gravity has shape (3,), but must be (2,) or (4, 2).",
    ),
    (
        lambda at: at.jax.vmap(lambda a: at.layer.step(at.batch, at.layer.state(at.batch), {"gravity": a}))(at.ones),
        "a simulation that is a batch of 2 cannot be mapped over a",
    ),
    (lambda at: at.jax.hessian(lambda a: at.loss({"gravity": a}))(at.gravity), "A second derivative is asked for"),
    (lambda at: at.loss({"paddel.displacement": at.np.zeros(2)}), "parameter 'paddel.displacement' is unknown, but"),
    (lambda at: at.step({PATH: at.np.zeros((4, 2))}, steps=2), "parameter paddle.displacement has shape (4, 2), but"),
    (lambda at: at.jax.grad(lambda a: at.loss({"gravity": [a, 0.0]}))(1.0), "numbers: make one with jax.numpy.stack"),
    (lambda at: at.loss({3: 1.0}), "parameters has the name 3, but names must be strings."),
    (lambda at: at.step_from({**at.state, "positions": np.zeros((48, 2), np.float32)}), "positions has a typical"),
    (lambda at: at.step_from(at.layer.state(at.other)), "state has positions, velocities, mass_fractions,"),
    (lambda at: at.step_from(at.layer.state(at.batch)), "state positions has shape (2, 48, 2), but must be (48, 2)."),
    (lambda at: at.layer.step(cortado.Simulation(at.scene), at.state), "state positions is float64, but must be"),
    (
        lambda at: at.rollout({"gravity": at.np.zeros((3, 2))}, steps=4, record_every=2),
        "parameter gravity has 3 rows, but must have 4, one for each",
    ),
    (lambda at: at.layer.step("scene.toml", at.state), "simulation is 'scene.toml', but must be a cortado.Simulation."),
    (lambda at: at.layer.value(None), "problem is None, but must be a cortado.Problem."),
    (lambda at: at.layer.value(at.problem, "exact"), "estimator is 'exact', but must be an object such as"),
    (lambda at: at.loss(at.gravity), "parameters is Array([ 0. , -9.81], dtype=float64), but must be"),
    (lambda at: at.measure(None), "sensor is None, but must be a sensor, such as one of"),
    (lambda at: at.measure(sensors.WaveGauge([0.1, 0.0, 0.1]))(at.state), "position has 3 components, but must have"),
    (lambda at: at.picture(at.x[:3]), "positions has shape (3, 2), but must have (48, 2)."),
    (lambda at: at.picture(at.x * np.nan), "positions has a value that is not finite, but must be made of"),
    (lambda at: at.picture(at.x, colours=np.zeros(3)), "colours has shape (3,), but must have (1, 3)."),
    (lambda at: at.jax.jvp(at.picture, (at.x,), (at.x,)), "A picture has derivatives in reverse mode only: take a"),
    (lambda at: at.layer.state(at.simulation, at.state), "state is a table, but must be a RestartState, such as"),
    (lambda at: at.layer.state(at.simulation, at.other.state()), "state has positions, velocities, mass_fractions,"),
    # environments
    (lambda at: at.act(np.zeros(3)), "action has shape (3,), but must be (2,)."),
    (lambda at: at.act(np.array([np.nan, 0])), "action has a value that is not finite, but must be numbers from"),
    (lambda at: at.act("left"), "action is 'left', but must be a number or an array of real"),
    (lambda at: at.jax.jit(lambda a: at.act(a)[1])(at.np.zeros(2)), "action is JitTracer(float64[2]), but must be a"),
    (lambda at: at.env.reset(seed="a"), "seed is 'a', but must be a whole number of at least 0."),
    (lambda at: at.vec.reset(seed="ab"), "seed is 'ab', but must be a whole number, or a list of them."),
    (lambda at: at.act_all(np.zeros(2)), "actions has shape (2,), but must be (2, 2)."),
    (lambda at: at.vec.twin(2), "number is 2, but must be at most 1."),
    (lambda at: at.vec.reset(options={"reset_mask": np.zeros(3, bool)}), "reset_mask is array([False, False"),
    (lambda at: at.twin.value(np.zeros((2, 2))), "actions has shape (2, 2), but must be (1, 2)."),
    (lambda at: at.twin_in_jax(np.zeros((2, 2), np.float32)), "actions has shape (2, 2), but must be an array of"),
    (lambda at: at.twin_in_jax(at.np.full((1, 2), at.np.nan, at.np.float32)), "parameter cup.displacement has a"),
    (lambda at: at.closed.step(np.zeros(2)), "step is called after close(), but must come after reset()."),
    (lambda at: (at.vec.close(), at.act_all(np.zeros((2, 2)))), "step is called after close(), but must come before"),
    (lambda at: at.make_one(size=3), 'size is 3, but must be "small" or "large".'),
    (lambda at: at.make(1, max_episode_steps=0), "max_episode_steps is 0, but must be a whole number of at least"),
    # fits
    (lambda at: at.fit([1.0]), "start is [1.0], but must be a dictionary, such as {'viscosity':"),
    (lambda at: at.fit({}), "start is empty, but must have a parameter to fit."),
    (lambda at: at.fit({"viscocity": 1.0}), "parameter 'viscocity' is unknown, but must be one of gravity,"),
    (lambda at: at.fit({"viscosity": 1.0}, bounds={"viscosity": (1.0, 1.0)}), "0 free numbers"),
    (lambda at: cortado.fit(at.simulation, {"viscosity": 1.0}), "experiments is Simulation(48 particles, 1 phase"),
    (lambda at: cortado.fit([], {"viscosity": 1.0}), "experiments is empty, but must have one experiment at least."),
    (lambda at: at.fit({"viscosity": 1.0}, bounds={"viscosity": (2.0, 3.0)}), "is outside of its bounds"),
    (lambda at: at.fit({"viscosity": 1.0}, bounds={"gravity": (2.0, 3.0)}), "Bounds are given for 'gravity', but"),
    (lambda at: at.seen({}), "observations is empty, but must have at least one measurement."),
    (lambda at: at.seen({"camera": at.frames}), "observations camera is array([[[[6.36961687e-01,"),
    (lambda at: at.film(at.times[:1], at.frames), "must be a list of at least 4 rising numbers, as error"),
    (lambda at: at.film(at.times[::-1], at.frames), "times has 0.012 s after 0.016 s, but must rise from frame"),
    (
        lambda at: cortado.fit(at.seen({"c": at.film(at.times, at.frames * np.nan)}), {"viscosity": 1.0}),
        "measured must be finite, or NaN for numbers to ignore, but",
    ),
    (lambda at: measured.Video(None, at.times, at.frames), "renderer is None, but must be a renderer such as of a"),
    (lambda at: measured.Experiment(cortado.Simulation(box()), {"c": at.video}), "observations c renders positions ("),
    (lambda at: at.seen({"c": at.film(at.times - 1, at.frames)}), "times begin with -0.996 s, but must be finite and"),
]


@pytest.mark.parametrize("call, words", REFUSED, ids=[words for _, words in REFUSED])
def test_a_bad_use_is_refused_in_a_sentence(at, call, words):
    with one_sentence(re.escape(words), error=CortadoError):
        call(at)


def test_a_path_that_goes_on_in_segments_is_no_jump(at, recwarn):
    """It is counted from where the state has the solid, in a batch too; one that jumps is told of."""
    for simulation, rows in ((at.simulation, (3, 1)), (at.batch, (2, 3, 1))):
        state, path = at.layer.state(simulation), at.np.array([0.015, 0.0]) * at.np.ones(rows)
        for k in range(1, 7):
            state = at.layer.step(simulation, state, {PATH: k * path}, steps=3)
        assert not [one for one in recwarn if issubclass(one.category, cortado.CortadoWarning)]
    with pytest.warns(cortado.CortadoWarning, match=r"goes 0\.21 m in step 1"):
        at.layer.step(simulation, state, {PATH: 20 * path}, steps=3)
