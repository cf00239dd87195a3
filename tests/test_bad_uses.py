"""A hundred bad uses of layers, environments and fits: each is refused in one sentence, before anything is computed."""

from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

import cortado
import cortado.environments
from bad_scenes import one_sentence
from cortado import CortadoError, InputError
from scenes import plane, pool
from scenes import scene as box

PADDLE = {"name": "paddle", "shape": "box", "lower": [0.5, 0.1], "upper": [0.6, 0.4], "motion": "path"}


@pytest.fixture(scope="module")
def at():
    """What the uses below go wrong with: 48 particles beside a paddle, in float64."""
    import jax

    import cortado.jax

    jax.config.update("jax_enable_x64", True)
    made = SimpleNamespace(jax=jax, jnp=jax.numpy, layer=cortado.jax)
    tables = {"solid": [{**PADDLE, "velocity": [0.0, 0.0]}], "solver": {"kind": "projection", "time_step": 0.002}}
    made.scene = pool([0.4, 0.3], [0.8, 0.8], viscosity=1.0, **tables)
    made.simulation = cortado.Simulation(made.scene, precision="float64")
    made.state, made.gravity = made.layer.state(made.simulation), jax.numpy.array([0.0, -9.81])
    made.problem = cortado.Problem(made.simulation, 4, cortado.losses.CentreOfMass([0.2, 0.1]))
    made.loss = made.layer.value(made.problem)
    made.renderer = made.simulation.renderer(resolution=(8, 8))
    made.times, made.frames = 0.004 * np.arange(1, 5), np.random.default_rng(0).random((4, 8, 8, 3))
    made.video = cortado.measured.Video(made.renderer, made.times, made.frames)
    made.experiment = cortado.measured.Experiment(made.simulation, {"camera": made.video})
    made.env, made.closed = (gymnasium.make("cortado/Carry-v0").unwrapped for _ in range(2))
    made.vec = cortado.environments.make_vec("Carry", 2, autoreset_mode="Disabled")
    for one in (made.env, made.closed, made.vec):
        one.reset(seed=1)
    made.twin = made.env.twin(1)
    made.closed.close()
    yield made
    jax.config.update("jax_enable_x64", False)


LAYERS = {
    "jit over steps": (
        lambda at: at.jax.jit(lambda k: at.layer.step(at.simulation, at.state, steps=k)["positions"])(2),
        r"steps is JitTracer\(\~int64\[\]\), but must be a whole number of at",
    ),
    "jit over record_every": (
        lambda at: at.jax.jit(
            lambda k: at.layer.rollout(at.simulation, at.state, steps=2, record_every=k)["positions"]
        )(2),
        r"record_every is JitTracer\(\~int64\[\]\), but must be a whole number",
    ),
    "vmap wrong axis": (
        lambda at: at.jax.vmap(lambda a: at.loss({"gravity": a}), in_axes=1)(at.jnp.ones((3, 2))),
        r"parameter gravity has shape \(3,\), but must be \(2,\) or \(4, 2\)\.",
    ),
    "vmap of batch": (
        lambda at: at.jax.vmap(
            lambda a: at.layer.step(
                cortado.Simulation(at.scene, precision="float64", batch=2),
                at.layer.state(cortado.Simulation(at.scene, precision="float64", batch=2)),
                {"gravity": a},
            )["positions"]
        )(at.jnp.ones((3, 2))),
        r"a simulation that is a batch of 2 cannot be mapped over a",
    ),
    "hessian": (
        lambda at: at.jax.hessian(lambda a: at.loss({"gravity": a}))(at.gravity),
        r"A second derivative is asked for, but there are first ones",
    ),
    "paddle unknown solid": (
        lambda at: at.loss({"paddel.displacement": at.jnp.zeros(2)}),
        r"parameter 'paddel\.displacement' is unknown, but must be one of",
    ),
    "paddle shape": (
        lambda at: at.loss({"paddle.displacement": at.jnp.zeros((4, 3))}),
        r"parameter paddle\.displacement has shape \(4, 3\), but must be",
    ),
    "paddle rows": (
        lambda at: at.layer.step(at.simulation, at.state, {"paddle.displacement": at.jnp.zeros((4, 2))}, steps=2),
        r"parameter paddle\.displacement has shape \(4, 2\), but must be",
    ),
    "paddle nan": (
        lambda at: at.layer.step(at.simulation, at.state, {"paddle.displacement": at.jnp.full((1, 2), at.jnp.nan)}),
        r"parameter paddle\.displacement has a value that is not finite,",
    ),
    "turn vector in 2-D": (
        lambda at: at.loss({"paddle.turn": at.jnp.zeros((4, 3))}),
        r"parameter paddle\.turn has shape \(4, 3\), but must be \(\) or \(4,\)\.",
    ),
    "velocity of solid": (
        lambda at: at.loss({"paddle.swing": at.jnp.zeros(2)}),
        r"parameter 'paddle\.swing' is unknown, but must be one of",
    ),
    "string dtype": (
        lambda at: at.loss({"gravity": np.array(["a", "b"])}),
        r"parameter gravity is made of text, but must be a number or an",
    ),
    "object array": (
        lambda at: at.loss({"gravity": np.array([None, 1], object)}),
        r"parameter gravity is array\(\[None, 1\], dtype=object\), but must",
    ),
    "list ragged": (
        lambda at: at.loss({"gravity": [[1, 2], [3]]}),
        r"parameter gravity is \[\[1, 2\], \[3\]\], but must be a number or an",
    ),
    "nested dict": (
        lambda at: at.loss({"gravity": {"x": 1.0}}),
        r"parameter gravity is a table, but must be a number or an array",
    ),
    "key not text": (lambda at: at.loss({3: 1.0}), r"parameters has the name 3, but must have texts as names\."),
    "state as second twice": (
        lambda at: at.layer.step(at.simulation, {**at.state, "positions": np.zeros((48, 2), np.float32)}),
        r"state positions are usually 0 spacings of 0\.05 m from the",
    ),
    "state of 3d": (
        lambda at: at.layer.step(at.simulation, at.layer.state(cortado.Simulation(box(), precision="float64"))),
        r"state has positions, velocities, mass_fractions,",
    ),
    "state of batch": (
        lambda at: at.layer.step(
            at.simulation, at.layer.state(cortado.Simulation(at.scene, precision="float64", batch=2))
        ),
        r"state positions has shape \(2, 48, 2\), but must be \(48, 2\)\.",
    ),
    "batch given single": (
        lambda at: at.layer.step(cortado.Simulation(at.scene, precision="float64", batch=2), at.state),
        r"state positions has shape \(48, 2\), but must be \(2, 48, 2\)\.",
    ),
    "state f32 sim": (
        lambda at: at.layer.step(cortado.Simulation(at.scene), at.state),
        r"state positions is float64, but must be float32, the",
    ),
    "restart of batch": (
        lambda at: at.layer.restart_state(cortado.Simulation(at.scene, precision="float64", batch=2), at.state),
        r"state positions has shape \(48, 2\), but must be \(2, 48, 2\)\.",
    ),
    "steps neg": (
        lambda at: at.layer.step(at.simulation, at.state, steps=-1),
        r"steps is \-1, but must be a whole number of at least 1\.",
    ),
    "steps bool": (
        lambda at: at.layer.step(at.simulation, at.state, steps=True),
        r"steps is True, but must be a whole number of at least 1\.",
    ),
    "steps text": (
        lambda at: at.layer.step(at.simulation, at.state, steps="2"),
        r"steps is '2', but must be a whole number of at least 1\.",
    ),
    "record_every 0": (
        lambda at: at.layer.rollout(at.simulation, at.state, steps=2, record_every=0),
        r"record_every is 0, but must be a whole number of at least 1\.",
    ),
    "rollout gravity rows": (
        lambda at: at.layer.rollout(
            at.simulation, at.state, {"gravity": at.jnp.zeros((3, 2))}, steps=4, record_every=2
        ),
        r"parameter gravity has 3 rows, but must have 4, one for each",
    ),
    "sim path": (
        lambda at: at.layer.step("scene.toml", at.state),
        r"simulation is 'scene\.toml', but must be a cortado\.Simulation\.",
    ),
    "problem none": (lambda at: at.layer.value(None), r"problem is None, but must be a cortado\.Problem\."),
    "value gradient text": (
        lambda at: at.layer.value(at.problem, "exact"),
        r"estimator is 'exact', but must be an object such as",
    ),
    "loss called with array": (
        lambda at: at.loss(at.gravity),
        r"parameters is Array\(\[ 0\. , \-9\.81\], dtype=float64\), but must be",
    ),
    "measure none": (
        lambda at: at.layer.measure(at.simulation, None),
        r"sensor is None, but must be a sensor, such as one of",
    ),
    "measure class": (lambda at: at.layer.measure(at.simulation, cortado.sensors.WaveGauge), r"sensor is "),
    "measure 3d gauge": (
        lambda at: at.layer.measure(at.simulation, cortado.sensors.WaveGauge([0.1, 0.0, 0.1]))(at.state),
        r"position has 3 components, but must have 2, as the scene has\.",
    ),
    "measure sim of path": (
        lambda at: at.layer.measure("x", "density"),
        r"simulation is 'x', but must be a cortado\.Simulation\.",
    ),
    "measure no pressure param": (
        lambda at: at.layer.measure(at.simulation, "pressure")(at.state, {"gravty": at.gravity}),
        r"parameter 'gravty' is unknown, but must be one of gravity,",
    ),
    "picture wrong n": (
        lambda at: at.layer.picture(at.renderer, at.state["positions"][:3]),
        r"positions has shape \(3, 2\), but must have \(48, 2\)\.",
    ),
    "picture f32": (
        lambda at: at.layer.picture(at.renderer, at.state["positions"].astype("float32")),
        r"positions is float32, but must be float64, the simulation's",
    ),
    "picture nan": (
        lambda at: at.layer.picture(at.renderer, at.state["positions"] * at.jnp.nan),
        r"positions has a value that is not finite, but must be made of",
    ),
    "picture 3 comps": (
        lambda at: at.layer.picture(at.renderer, at.jnp.zeros((48, 3))),
        r"positions has shape \(48, 3\), but must have \(48, 2\)\.",
    ),
    "picture none": (
        lambda at: at.layer.picture(at.renderer, None),
        r"positions is left out, but must be an array \(48, 2\)\.",
    ),
    "picture colours": (
        lambda at: at.layer.picture(at.renderer, at.state["positions"], colours=at.jnp.zeros(3)),
        r"colours has shape \(3,\), but must have \(1, 3\)\.",
    ),
    "picture jvp": (
        lambda at: at.jax.jvp(
            lambda p: at.layer.picture(at.renderer, p), (at.state["positions"],), (at.state["positions"],)
        ),
        r"A picture has derivatives in reverse mode only: take a gradient\.",
    ),
    "state kw": (
        lambda at: at.layer.state(at.simulation, at.state),
        r"state is a table, but must be a RestartState, such as",
    ),
    "state of wrong": (
        lambda at: at.layer.state(at.simulation, cortado.Simulation(plane(), precision="float64").state()),
        r"state has positions, velocities, mass_fractions,",
    ),
    "state problem": (
        lambda at: at.layer.state(at.problem),
        r"simulation is Problem\(4 steps of Simulation\(48 particles, 1",
    ),
}
ENVIRONMENTS = {
    "env act shape": (lambda at: at.env.step(np.zeros(3)), r"action has shape \(3,\), but must be \(2,\)\."),
    "env act nan": (
        lambda at: at.env.step(np.array([np.nan, 0])),
        r"action has a value that is not finite, but must be numbers from",
    ),
    "env act inf": (
        lambda at: at.env.step(np.array([np.inf, 0])),
        r"action has a value that is not finite, but must be numbers from",
    ),
    "env act text": (lambda at: at.env.step("left"), r"action is 'left', but must be a number or an array of real"),
    "env act complex": (
        lambda at: at.env.step(np.array([1j, 0])),
        r"action is made of complex numbers, but must be a number or an",
    ),
    "env act None": (lambda at: at.env.step(None), r"action is None, but must be a number or an array of real"),
    "env act jax traced": (
        lambda at: at.jax.jit(lambda a: at.env.step(a)[1])(at.jnp.zeros(2)),
        r"action is JitTracer\(float64\[2\]\), but must be a number or an",
    ),
    "reset seed text": (lambda at: at.env.reset(seed="a"), r"seed is 'a', but must be a whole number or None\."),
    "vec reset seed text": (
        lambda at: at.vec.reset(seed="ab"),
        r"seed is 'ab', but must be a whole number, or a list of them\.",
    ),
    "vec reset seed float": (
        lambda at: at.vec.reset(seed=1.5),
        r"seed is 1\.5, but must be a whole number, or a list of them\.",
    ),
    "vec act 1": (lambda at: at.vec.step(np.zeros(2)), r"actions has shape \(2,\), but must be \(2, 2\)\."),
    "vec act nan": (
        lambda at: at.vec.step(np.full((2, 2), np.nan)),
        r"actions has a value that is not finite, but must be numbers",
    ),
    "vec twin no": (lambda at: at.vec.twin(2), r"number is 2, but must be at most 1\."),
    "vec twin neg": (lambda at: at.vec.twin(-1), r"number is \-1, but must be a whole number of at least 0\."),
    "vec twin text": (lambda at: at.vec.twin("a"), r"number is 'a', but must be a whole number of at least 0\."),
    "vec options": (
        lambda at: at.vec.reset(options={"reset_mask": np.zeros(3, bool)}),
        r"reset_mask is array\(\[False, False, False\]\), but must be an",
    ),
    "vec options list": (
        lambda at: at.vec.reset(options=[1]),
        r"options is \[1\], but must be given by name, as \{'reset_mask':",
    ),
    "twin shape": (lambda at: at.twin.value(np.zeros((2, 2))), r"actions has shape \(2, 2\), but must be \(1, 2\)\."),
    "twin nan": (
        lambda at: at.twin.value(np.full((1, 2), np.nan)),
        r"actions has a value that is not finite, but must be numbers",
    ),
    "twin none": (lambda at: at.twin.value(None), r"actions is None, but must be a number or an array of real"),
    "twin grad text": (
        lambda at: at.twin.value_and_gradient(np.zeros((1, 2)), "exact"),
        r"estimator is 'exact', but must be an object such as",
    ),
    "twin jax shape": (
        lambda at: at.twin.in_jax()(at.jnp.zeros((2, 2), at.jnp.float32)),
        r"actions has shape \(2, 2\), but must be an array \(1, 2\)\.",
    ),
    "twin jax nan": (
        lambda at: at.twin.in_jax()(at.jnp.full((1, 2), at.jnp.nan, at.jnp.float32)),
        r"parameter cup\.displacement has a value that is not finite, but",
    ),
    "twin actions text": (
        lambda at: at.env.twin("all"),
        r"actions is 'all', but must be a whole number of at least 1\.",
    ),
    "twin jax 1-d": (
        lambda at: at.twin.in_jax()(at.jnp.zeros(2, at.jnp.float32)),
        r"actions has shape \(2,\), but must be an array \(1, 2\)\.",
    ),
    "after close": (
        lambda at: at.closed.step(np.zeros(2)),
        r"step is called after close\(\), but must come after reset\(\)\.",
    ),
    "after close vec": (
        lambda at: (at.vec.close(), at.vec.step(np.zeros((2, 2)))),
        r"step is called after close\(\), but must come before it\.",
    ),
    "make size": (
        lambda at: gymnasium.make("cortado/Carry-v0", size=3),
        r'size is 3, but must be "small" or "large"\.',
    ),
    "make device": (
        lambda at: gymnasium.make("cortado/Carry-v0", device="cuda:9"),
        r"device is 'cuda:9', but must be one of: cpu; no GPU with a CUDA",
    ),
    "make task": (
        lambda at: cortado.environments.make_vec(3),
        r"task is 3, but must be one of Carry, Latte, Pour, Raft, Splash,",
    ),
    "make num_envs": (
        lambda at: cortado.environments.make_vec("Carry", 1.5),
        r"num_envs is 1\.5, but must be a whole number of at least 1\.",
    ),
    "make sensors": (
        lambda at: cortado.environments.make_vec("Carry", 1, sensors={"a": cortado.sensors.WaveGauge}),
        r"sensor is ",
    ),
    "max steps": (
        lambda at: cortado.environments.make_vec("Carry", 1, max_episode_steps=0),
        r"max_episode_steps is 0, but must be a whole number of at least",
    ),
}
FITS = {
    "fit no table": (
        lambda at: cortado.fit(at.experiment, [1.0]),
        r"start is \[1\.0\], but must be given by name, as \{'viscosity':",
    ),
    "fit empty": (lambda at: cortado.fit(at.experiment, {}), r"start is empty, but must have a parameter to fit\."),
    "fit unknown": (
        lambda at: cortado.fit(at.experiment, {"viscocity": 1.0}),
        r"parameter 'viscocity' is unknown, but must be one of gravity,",
    ),
    "fit nan": (
        lambda at: cortado.fit(at.experiment, {"viscosity": np.nan}),
        r"start of viscosity is nan, but must be within its bounds\.",
    ),
    "fit neg": (
        lambda at: cortado.fit(at.experiment, {"viscosity": -1.0}),
        r"parameter viscosity is \-1\.0, but must be at least 0\.",
    ),
    "fit text": (
        lambda at: cortado.fit(at.experiment, {"viscosity": "thick"}),
        r"start of viscosity is 'thick', but must be a number or an array",
    ),
    "fit sim": (
        lambda at: cortado.fit(at.simulation, {"viscosity": 1.0}),
        r"experiments is Simulation\(48 particles, 1 phase, cpu, float64\),",
    ),
    "fit empty list": (
        lambda at: cortado.fit([], {"viscosity": 1.0}),
        r"experiments is empty, but must have one experiment at least\.",
    ),
    "fit bounds": (
        lambda at: cortado.fit(at.experiment, {"viscosity": 1.0}, bounds={"viscosity": (2.0, 3.0)}),
        r"start of viscosity is 1\.0, but must be within its bounds\.",
    ),
    "fit bounds rev": (
        lambda at: cortado.fit(at.experiment, {"viscosity": 1.0}, bounds={"viscosity": (3.0, 0.1)}),
        r"start of viscosity is 1\.0, but must be within its bounds\.",
    ),
    "fit bounds unknown": (
        lambda at: cortado.fit(at.experiment, {"viscosity": 1.0}, bounds={"gravity": (2.0, 3.0)}),
        r"bounds has gravity, but must be made of parameters that start",
    ),
    "exp none": (
        lambda at: cortado.measured.Experiment(at.simulation, {}),
        r"observations is empty, but must have what was measured\.",
    ),
    "exp of problem": (
        lambda at: cortado.measured.Experiment(at.problem, {"camera": at.video}),
        r"simulation is Problem\(4 steps of Simulation\(48 particles, 1",
    ),
    "exp list": (lambda at: cortado.measured.Experiment(at.simulation, [at.video]), r"observations is \["),
    "exp what": (
        lambda at: cortado.measured.Experiment(at.simulation, {"camera": at.frames}),
        r"observations camera is array\(\[\[\[\[6\.36961687e\-01,",
    ),
    "video times": (
        lambda at: cortado.measured.Video(at.renderer, at.times[:1], at.frames),
        r"times .*must be a list of at least 4 rising numbers, as error",
    ),
    "video order": (
        lambda at: cortado.measured.Video(at.renderer, at.times[::-1], at.frames),
        r"times has 0\.012 s after 0\.016 s, but must rise from frame",
    ),
    "video size": (
        lambda at: cortado.measured.Video(at.renderer, at.times, np.zeros((4, 5, 8, 3))),
        r"frames has shape \(4, 5, 8, 3\), but must be \(frames, \*\(8, 8, 3\)\)\.",
    ),
    "video nan": (
        lambda at: cortado.fit(
            cortado.measured.Experiment(
                at.simulation, {"c": cortado.measured.Video(at.renderer, at.times, at.frames * np.nan)}
            ),
            {"viscosity": 1.0},
        ),
        r"measured must be finite, or NaN for what does not count, but",
    ),
    "video renderer": (
        lambda at: cortado.measured.Video(None, at.times, at.frames),
        r"renderer is None, but must be a renderer such as of a",
    ),
    "video other sim": (
        lambda at: cortado.measured.Experiment(cortado.Simulation(box()), {"c": at.video}),
        r"observations c sees positions \(48, 2\), but must see \(125, 3\),",
    ),
    "video negative time": (
        lambda at: cortado.measured.Experiment(
            at.simulation, {"c": cortado.measured.Video(at.renderer, at.times - 1, at.frames)}
        ),
        r"times begin with \-0\.996 s, but must be finite and not before",
    ),
}
THEIRS = {
    "the gradient of a vector": (
        lambda at: at.jax.grad(lambda v: at.layer.step(at.simulation, at.state, {"gravity": v})["positions"])(
            at.gravity
        ),
        "Gradient only defined for scalar-output functions",
    ),
    "a simulation that is traced": (
        lambda at: at.jax.jit(at.layer.step)(at.simulation, at.state),
        "Error interpreting",
    ),
    "a problem that is traced": (lambda at: at.jax.jit(at.layer.value)(at.problem), "Error interpreting argument"),
    "maps of two sizes": (
        lambda at: at.jax.vmap(lambda a, b: at.loss({"gravity": a, "viscosity": b}))(
            at.jnp.zeros((2, 2)), at.jnp.zeros(3)
        ),
        "vmap got inconsistent sizes",
    ),
    "a seed below 0": (lambda at: at.env.reset(seed=-5), "Seed must be greater or equal to zero"),
}
"""What JAX and Gymnasium find first, in sentences of theirs."""


@pytest.mark.parametrize("use", [*LAYERS, *ENVIRONMENTS, *FITS])
def test_a_bad_use_is_refused_in_a_sentence(at, use):
    call, words = {**LAYERS, **ENVIRONMENTS, **FITS}[use]
    with one_sentence(words, error=CortadoError):
        call(at)


@pytest.mark.parametrize("use", THEIRS)
def test_what_others_refuse_has_their_words(at, use):
    call, words = THEIRS[use]
    with pytest.raises(Exception, match=words) as caught:
        call(at)
    assert not isinstance(caught.value, InputError)


def test_there_are_a_hundred():
    assert len(LAYERS) + len(ENVIRONMENTS) + len(FITS) >= 100


def test_a_path_that_goes_on_in_segments_is_no_jump(at, recwarn):
    """It is counted from where the state has the solid, in a batch too; one that jumps is told of."""
    batch = cortado.Simulation(at.scene, precision="float64", batch=2)
    for simulation, rows in ((at.simulation, (3, 1)), (batch, (2, 3, 1))):
        state, path = at.layer.state(simulation), at.jnp.array([0.015, 0.0]) * at.jnp.ones(rows)
        for k in range(1, 7):
            state = at.layer.step(simulation, state, {"paddle.displacement": k * path}, steps=3)
        assert not [one for one in recwarn if issubclass(one.category, cortado.CortadoWarning)]
    with pytest.warns(cortado.CortadoWarning, match=r"goes 0\.21 m in step 1"):
        at.layer.step(simulation, state, {"paddle.displacement": 20 * path}, steps=3)


def test_paths_of_solids_pass_the_check_of_gradients(at):
    """Where a paddle is at each step, over two segments, in both modes; and by a problem."""
    from jax.test_util import check_grads

    def end(places, turns):
        state = at.state
        for k in range(2):
            path = {"paddle.displacement": places[k], "paddle.turn": turns[k]}
            state = at.layer.step(at.simulation, state, path, steps=3)
        return 10.0 * state["velocities"]

    random = np.random.default_rng(1)
    places = at.jnp.asarray(np.cumsum(random.uniform(-0.01, 0.0, (6, 2)), axis=0).reshape(2, 3, 2))
    turns = at.jnp.asarray(np.cumsum(random.uniform(0.0, 0.02, 6)).reshape(2, 3))
    check_grads(end, (places, turns), order=1, modes=["fwd", "rev"], eps=1e-7)
    gradient = at.jax.grad(lambda *own: (end(*own) ** 2).sum(), argnums=(0, 1))(places, turns)
    assert all(np.abs(one).max() > 1e-3 for one in gradient)
