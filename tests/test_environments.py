"""Environments of Gymnasium: its own checks, seeds, batches, rewards with derivatives, and bad uses in sentences."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import cortado
import cortado.environments
from cortado import InputError, Simulation
from cortado.discretise.room import Domain
from cortado.environments.catalogue import TASKS, Carry
from cortado.environments.task import Position, Velocity
from cortado.environments.terms import Distance, Miss, Missed, OneBox, Share, Spread, StepEnd


@pytest.fixture(scope="module")
def environments():
    made = {}

    def of(name):
        if name not in made:
            made[name] = gymnasium.make(f"cortado/{name}-v0", precision="float64")
        return made[name]

    return of


def actions_of(env, count):
    return np.random.default_rng(0).uniform(-1.2, 1.2, (count, *env.action_space.shape))


def episode(env, actions, seed):
    first, _ = env.reset(seed=seed)
    found = [env.step(action) for action in actions]
    return np.array([first, *(one[0] for one in found)]), np.array([one[1] for one in found])


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.filterwarnings("error::cortado.CortadoWarning")
def test_the_scene_of_a_task_is_nothing_to_warn_of(name):
    assert TASKS[name]().scene.solver.time_step > 0.0


@pytest.mark.parametrize("name", TASKS)
def test_gymnasium_has_nothing_to_say(environments, name, recwarn):
    """A `ResourceWarning` is of something that another test has left, which Python collects here."""
    check_env(environments(name).unwrapped, skip_render_check=True, skip_close_check=True)
    said = [str(one.message) for one in recwarn if not issubclass(one.category, ResourceWarning)]
    assert not [sentence for sentence in said if "infinity" not in sentence]


def test_the_same_seed_has_the_same_bits_and_another_one_others(environments):
    env = environments("Carry")
    actions = actions_of(env, 2)
    (seen, rewards), (again, rewards_again), (other, _) = (episode(env, actions, seed) for seed in (3, 3, 4))
    assert np.array_equal(seen, again) and np.array_equal(rewards, rewards_again)
    layout = env.unwrapped.layout
    for part in ("particles", "goal"):
        assert not np.array_equal(seen[0, layout[part]], other[0, layout[part]])


def test_observations_are_what_the_layout_says(environments):
    env = environments("Raft").unwrapped
    seen, _ = episode(env, actions_of(env, 3), 1)
    scenes, layout = env.scenes, env.layout
    state = scenes.simulation.on_host(scenes.state)[0]
    particles = seen[-1, layout["particles"]].reshape(32, 2, 2)
    chosen = np.linspace(0, scenes.simulation.particles - 1, 32).astype(int)
    assert np.array_equal(particles[:, 0], state["positions"][chosen].astype(np.float32))
    assert np.array_equal(particles[:, 1], state["velocities"][chosen].astype(np.float32))
    x, y, cosine, sine, u, v, rate = seen[-1, layout["raft"]]
    assert np.allclose([x, y, u, v], np.ravel([state["raft.position"], state["raft.velocity"]]))
    assert np.isclose(cosine**2 + sine**2, 1.0) and sine != 0.0
    assert rate == np.float32(state["raft.angular_velocity"][0])
    assert np.isclose(seen[-1, layout["progress"]], 3 / 40)
    paddle = state["paddle.position"][0, 0] - 0.11
    assert np.isclose(seen[-1, layout["paddle.displacement"]][0], paddle) and paddle != 0.0


def test_sensors_are_observed_as_a_simulation_reads_them():
    sensors = {"probe": cortado.sensors.PressureProbe([0.5, 0.1]), "gauge": cortado.sensors.WaveGauge([0.7, 0.0])}
    envs = cortado.environments.make_vec("Raft", 2, precision="float64", sensors=sensors)
    first, _ = envs.reset(seed=1)
    stepped = envs.step(np.ones((2, 1)))[0]
    scenes, task = envs.scenes, envs.scenes.task
    assert list(envs.layout)[-2:] == ["probe", "gauge"]
    single, steps = Simulation(task.scene, precision="float64"), task.substeps
    path = task.actuators[0].over(1, steps, task.time_step).parameter(np.ones((1, 1)))
    for b, start in enumerate(scenes.starts):
        for displacement, seen, at in ((np.zeros(2), first, 0), (path, stepped, -1)):
            controls = {"initial_positions": start.positions, "paddle.displacement": displacement}
            read = single.run(steps, controls, record_every=steps, sensors=sensors).sensors
            expected = [read["probe"]["pressure"][at], read["gauge"]["height"][at]]
            assert np.allclose(seen[b, -2:], expected, rtol=1e-6) and expected[0] > 10.0
    broken(scenes, 1)
    seen, _, terminated, _, _ = envs.step(np.ones((2, 1)))
    assert terminated.tolist() == [False, True] and np.array_equal(seen[1], stepped[1]) and np.isfinite(seen).all()
    for bad in ({"goal": sensors["gauge"]}, ["gauge"], {"gauge": 1}):
        with pytest.raises(InputError, match="sensor"):
            cortado.environments.make_vec("Raft", 2, sensors=bad)


@pytest.mark.parametrize("name", TASKS)
def test_the_loss_of_the_twin_is_minus_the_return(environments, name):
    env = environments(name).unwrapped
    actions = actions_of(env, 2)
    _, rewards = episode(env, actions, 5)
    twin = env.twin(2)
    value, gradient = twin.value_and_gradient(actions)
    assert abs(value + rewards.sum()) < 1e-12 * max(1.0, abs(value))
    assert gradient.shape == actions.shape and not gradient[np.abs(actions) > 1.0].any()
    direction = np.where(np.abs(actions) < 0.99, np.random.default_rng(1).standard_normal(actions.shape), 0.0)
    h = 1e-6
    difference = (twin.value(actions + h * direction) - twin.value(actions - h * direction)) / (2.0 * h)
    assert gradient.any() and np.isclose(difference, (gradient * direction).sum(), rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("library", ["jax", "torch"])
def test_the_twin_in_other_libraries(environments, jax, library):
    env = environments("Carry").unwrapped
    env.reset(seed=5)
    twin, actions = env.twin(2), np.array([[0.5, -0.2], [1.5, 0.1]])
    if library == "jax":
        value, gradient = jax.value_and_grad(twin.in_jax())(jax.numpy.array(actions))
    else:
        own = pytest.importorskip("torch").tensor(actions, requires_grad=True)
        value = twin.in_torch()(own)
        value.backward()
        value, gradient = value.item(), own.grad.numpy()
    expected, slopes = twin.value_and_gradient(actions)
    assert np.isclose(value, expected, rtol=1e-12) and np.allclose(gradient, slopes, rtol=1e-9, atol=1e-12)


def test_actuators_are_their_matrices():
    generator = np.random.default_rng(2)
    for one in (
        Velocity("cup.displacement", (1.0, 2.0), (1,), (3.0,)),
        Position("gravity", (0.0, -9.81), (0, 1), (2.0, -1.0), lag=0.2),
        Velocity("cup.turn", (0.0,), (0,), (0.5,), is_number=True),
    ):
        actions, now, parts = generator.uniform(-1.0, 1.0, (4, len(one.axes))), one.at_rest(1), []
        for u in actions:
            now, rows = one.advance(now, u[None], 3, 0.01)
            parts.append(rows[0])
        assert np.allclose(np.concatenate(parts), one.over(4, 3, 0.01).parameter(actions), rtol=1e-14, atol=1e-14)
    steady = Velocity("x", (0.0,), (0,), (2.0,)).over(10, 5, 0.01).parameter(np.ones((10, 1)))
    assert np.isclose(steady[-1, 0], 2.0 * (0.5 - 0.05 / 2 + 0.01 / 2))  # a ramp in the first step, then 2 m/s


def test_an_episode_has_as_many_steps_as_it_is_made_with():
    horizon = TASKS["Splash"].horizon
    for env, wanted in (
        (gymnasium.make("cortado/Splash-v0", max_episode_steps=horizon + 2), horizon + 2),
        (cortado.environments.FluidEnv("Splash"), horizon),
    ):
        env.reset(seed=1)
        ends = [env.step(np.zeros(env.action_space.shape))[3] for _ in range(wanted)]
        assert ends == [False] * (wanted - 1) + [True]


def test_autoreset_in_the_next_step():
    envs = gymnasium.make_vec("cortado/Carry-v0", 2, vectorization_mode="vector_entry_point", max_episode_steps=2)
    assert envs.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.NEXT_STEP
    first, _ = envs.reset(seed=1)
    zero = np.zeros((2, 2))
    found = [envs.step(zero) for _ in range(4)]
    assert [one[3].tolist() for one in found] == [[False] * 2, [True] * 2, [False] * 2, [False] * 2]
    assert not found[2][1].any() and found[3][1].all()  # the third step begins new episodes, in place of its actions
    assert not np.array_equal(found[2][0], first) and not found[2][0][:, envs.unwrapped.layout["progress"]].any()


def test_autoreset_in_the_same_step_and_disabled():
    settings = {"num_envs": 2, "max_episode_steps": 1}
    envs = cortado.environments.make_vec("Carry", **settings, autoreset_mode="SameStep")
    envs.reset(seed=1)
    seen, _, _, truncated, infos = envs.step(np.zeros((2, 2)))
    progress = envs.layout["progress"]
    assert truncated.all() and infos["_final_obs"].all() and not seen[:, progress].any()
    assert np.isclose(infos["final_obs"][1][progress], 1 / 75)
    envs = cortado.environments.make_vec("Carry", **settings, autoreset_mode="Disabled")
    envs.reset(seed=1)
    ended = envs.step(np.zeros((2, 2)))[0]
    mask = np.array([False, True])
    seen, _ = envs.reset(options={"reset_mask": mask})
    assert np.array_equal(seen[0], ended[0]) and not np.array_equal(seen[1], ended[1])
    with pytest.raises(InputError, match="environment 0, but must come after reset"):
        envs.step(np.zeros((2, 2)))


def broken(scenes, number):
    """Lets a particle of a scene fly away in the next step."""
    velocities = np.from_dlpack(scenes.state["velocities"]).copy()
    velocities[number, 0, 0] = 1e6
    scenes.state = replace(scenes.state, arrays=scenes.state.arrays.copy())
    scenes.state.arrays.set({"velocities": velocities[..., :2]})


def test_an_episode_that_diverges_is_terminated_with_a_sentence(environments):
    env = environments("Splash").unwrapped
    before, _ = env.reset(seed=1)
    broken(env.scenes, 0)
    seen, reward, terminated, truncated, info = env.step(np.zeros(2))
    assert terminated and not truncated and np.array_equal(seen, before) and reward == 0.0
    assert info["diverged"].startswith("The episode ended in its step 1: The simulation diverged")
    with pytest.raises(InputError, match="after the end of an episode, but must come after reset"):
        env.step(np.zeros(2))
    env.reset(seed=1)
    assert np.isfinite(env.step(np.zeros(2))[1])


def test_in_a_batch_the_others_go_on():
    envs = cortado.environments.make_vec("Carry", 3, precision="float64")
    envs.reset(seed=1)
    broken(envs.scenes, 1)
    seen, rewards, terminated, _, infos = envs.step(np.zeros((3, 2)))
    assert terminated.tolist() == [False, True, False] and infos["_diverged"].tolist() == terminated.tolist()
    assert np.isfinite(seen).all() and rewards[1] == 75 * -12.0
    alone = cortado.environments.make_vec("Carry", 1, precision="float64")
    alone.reset(seed=3)
    both = [envs.step(np.full((3, 2), 0.5)), alone.step(np.zeros((1, 2))) and alone.step(np.full((1, 2), 0.5))]
    assert np.array_equal(both[0][0][2], both[1][0][0]) and both[0][1][1] == 0.0 and np.isfinite(both[0][0]).all()


class OfOtherSteps(Carry):
    def __init__(self, length):
        super().__init__()
        self.__dict__["length"] = length

    def scene_of(self, **tables):
        return super().scene_of(**tables, solver={"time_step": self.length})


@pytest.mark.parametrize(("length", "said"), [("auto", "'auto'"), (0.001, "0.001")])
def test_steps_of_another_length_than_those_of_actuators_are_refused(length, said):
    """A cup that was sent on with 0.6 m/s went with 0.3 m/s where steps were chosen."""
    sentence = f"Carry has solver.time_step = {said}, but must have the time_step of the task, 0.0025 s"
    with pytest.raises(InputError, match=sentence):
        cortado.environments.FluidEnv(OfOtherSteps(length))


def test_steps_before_the_first_episode_and_other_bad_calls(environments):
    env, make = environments("Carry").unwrapped, cortado.environments.make_vec
    envs = make("Carry", 2, autoreset_mode="Disabled")
    task = cortado.environments.FluidEnv("Carry").scenes.task
    own = "size is 'large', but must be left out, as the task is a Task object"
    for call, words in [
        (lambda: make("Juggle"), "task is 'Juggle', but must be one of Carry"),
        (lambda: make("Carry", particles=1000), "particles is 1000, but must be from 0 to 96, the scene's particles"),
        (lambda: make("Carry", render_mode="human"), "render_mode is 'human'"),
        (lambda: make("Carry", 1, autoreset_mode="never"), "autoreset_mode is 'never', but must be one of"),
        (lambda: cortado.environments.FluidEnv(task, size="large"), own),
        (lambda: envs.reset(options={"reset_mask": np.zeros(2, dtype=bool)}), "reset_mask"),
        (lambda: envs.reset(seed=[1, 2, 3]), "seed has 3 numbers"),
        (lambda: envs.step(np.zeros((2, 2))), "must come after reset"),
        (lambda: env.reset(options={"goal": 0.3}), "options has 'goal', but may have state only"),
    ]:
        with pytest.raises(InputError, match=words):
            call()
    env.reset(seed=1)
    for bad in (0, 76):
        with pytest.raises(InputError, match="actions"):
            env.twin(bad)


def test_pictures(environments):
    env = environments("Carry").unwrapped
    assert env.render() is None
    env.render_mode = "rgb_array"
    env.reset(seed=1)
    picture = env.render()
    env.render_mode = None
    assert picture.shape == (200, 320, 3) and picture.dtype == np.uint8 and picture.std() > 10.0


@pytest.fixture(scope="module")
def carried():
    """The end of a step of two scenes, whose cups have leant."""
    simulation = Simulation(TASKS["Carry"]().scene, precision="float64", batch=2)
    path = {"cup.displacement": np.full((2, 1, 2), 0.003), "cup.turn": np.array([[0.3], [-0.2]])}
    state = simulation.step(simulation.on_device(), path)
    return StepEnd(state.arrays, np.array([[0.3], [0.5]]), np.array([1, 2]))


LOWER, UPPER, CHOSEN = np.array([-0.05, -0.04]), np.array([0.02, 0.03]), np.array([3, 10, 40])
TARGETS, WEIGHTS = np.random.default_rng(0).normal(size=(2, 96, 2)), np.random.default_rng(1).uniform(size=(2, 96))
TERMS = {
    "share": Share(OneBox(tuple(LOWER), tuple(UPPER)), 0.01, solid="cup"),
    "spread": Spread(CHOSEN, 2.0),
    "missed": Missed(TARGETS, WEIGHTS),
    "distance": Distance("cup"),
}


def test_terms_are_what_numpy_finds(carried):
    x = carried.state.numpy(2)["positions"]
    place, angle = carried.state.numpy(2)["cup.position"], carried.state.numpy(2)["cup.turn"][..., None]
    c, s, (r_x, r_y) = np.cos(angle), np.sin(angle), np.split(x - place, 2, axis=-1)
    y = np.concatenate([c * r_x + s * r_y, c * r_y - s * r_x], axis=-1)
    squares = ((y - np.clip(y, LOWER, UPPER)) ** 2).sum(axis=-1)
    pairs = np.abs(x[:, CHOSEN, None] - x[:, None, CHOSEN]).sum(axis=-1).mean(axis=(1, 2))
    expected = {
        "share": (1.0 / (1.0 + squares / 1e-4)).mean(axis=1),
        "spread": pairs / 2.0,
        "missed": [(WEIGHTS[k] * ((x[k] - TARGETS[k]) ** 2).sum(axis=1)).sum() for k in range(2)],
        "distance": np.abs(place[:, 0, 0] - carried.goal[:, 0]),
    }
    for name, term in TERMS.items():
        assert np.allclose(term.values(carried), expected[name], rtol=1e-12), name
    assert (expected["share"] < 0.9).all()


def adjoint_of(term, at, dimension, h):
    """By field the products of a term's adjoint with a direction, held against differences: with respect to where
    particles are, and where the cup is and how it leans, about z alone; of each scene on its own."""
    factor, bar, generator = np.array([2.0, -0.7]), at.state.like(), np.random.default_rng(2)
    term.adjoint(at, factor, bar)
    fields, bars, products = at.state.numpy(dimension), bar.numpy(dimension), {}
    for field in ("positions", "cup.position", "cup.turn"):
        dot = generator.standard_normal(fields[field].shape)
        if dimension == 3 and field == "cup.turn":
            dot[..., :2] = 0.0

        def moved(h, field=field, dot=dot):
            state = at.state.copy()
            state.set({field: fields[field] + h * dot})
            return term.values(replace(at, state=state))

        difference = factor * (moved(h) - moved(-h)) / (2.0 * h)
        products[field] = (bars[field] * dot).reshape(2, -1).sum(axis=1)
        assert np.allclose(products[field], difference, rtol=1e-7, atol=1e-9), field
    return products


@pytest.mark.parametrize("name", TERMS)
def test_adjoints_of_terms_are_differences(carried, name):
    assert adjoint_of(TERMS[name], carried, 2, 1e-6)["positions"].any() != (name == "distance")


def test_terms_in_space_are_what_numpy_finds_with_derivatives_of_differences():
    coarse = type("Coarse", (TASKS["CarryInSpace"],), {"coarse_spacing": 0.025})().scene
    simulation = Simulation(coarse, precision="float64", batch=2)
    path = {"cup.displacement": np.full((2, 1, 3), 0.003), "cup.turn": np.array([[[0, 0, 0.3]], [[0, 0, -0.2]]])}
    state = simulation.step(simulation.on_device(), path)
    lower, upper = np.array([-0.05, -0.04, -0.03]), np.array([0.02, 0.03, 0.05])
    share = Share(OneBox(tuple(lower), tuple(upper)), 0.01, solid="cup")
    at = StepEnd(state.arrays, np.array([[0.3], [0.9]]), np.array([1, 2]))
    fields = at.state.numpy(3)
    c, s = (f(fields["cup.turn"][:, 0, 2:]) for f in (np.cos, np.sin))
    r = fields["positions"] - fields["cup.position"]
    y = np.stack([c * r[..., 0] + s * r[..., 1], c * r[..., 1] - s * r[..., 0], r[..., 2]], axis=-1)
    squares = ((y - np.clip(y, lower, upper)) ** 2).sum(axis=-1)
    expected = (1.0 / (1.0 + squares / 1e-4)).mean(axis=1)
    assert np.allclose(share.values(at), expected, rtol=1e-12) and (expected < 0.9).all()
    term = Miss(share)
    assert np.allclose(term.values(at), np.abs(expected - [0.3, 0.9]), rtol=1e-12)
    assert (np.sign(expected - [0.3, 0.9]) == [1.0, -1.0]).all()
    assert all(products.all() for products in adjoint_of(term, at, 3, 3e-7).values())
    at.state.set({"cup.turn": np.array([[[0.1, 0, 0]], [[0, 0, 0]]])})
    with pytest.raises(InputError, match=r"cup is turned by \[0.1, 0.0, 0.0\], but must turn about z alone"):
        share.values(at)


def test_terms_see_fluid_that_has_gone_around_a_period(carried):
    domain = Domain((-0.1, 0.0), (0.35, 0.25))
    fields, generator = carried.state.numpy(2), np.random.default_rng(4)

    def lapped(turns):
        state = carried.state.copy()
        state.set({"positions": fields["positions"] + turns * np.array(domain.lengths)})
        return replace(carried, state=state, domain=domain)

    turns = generator.integers(-2, 4, fields["positions"].shape)
    x = lapped(turns).state.numpy(2)["positions"]
    images = [x + np.array([i, j]) * domain.lengths for i in range(-6, 7) for j in range(-6, 7)]
    apart = np.abs(np.stack([image[:, CHOSEN, None] - x[:, None, CHOSEN] for image in images])).sum(-1).min(axis=0)
    lower, upper = np.array([0.2, 0.2]), np.array([0.28, 0.27])
    squares = np.stack([((y - np.clip(y, lower, upper)) ** 2).sum(axis=-1) for y in images]).min(axis=0)
    assert np.allclose(TERMS["spread"].values(lapped(turns)), apart.mean(axis=(1, 2)) / 2.0, rtol=1e-9)
    share = Share(OneBox(tuple(lower), tuple(upper)), 0.01)
    assert np.allclose(share.values(lapped(turns)), (1.0 / (1.0 + squares / 1e-4)).mean(axis=1), rtol=1e-9)
    for term in (TERMS["share"], TERMS["spread"], share, TERMS["distance"]):
        assert np.allclose(term.values(lapped(turns)), term.values(lapped(0)), rtol=1e-9)
        bars = [carried.state.like() for _ in range(2)]
        for bar, laps in zip(bars, (turns, 0), strict=True):
            term.adjoint(lapped(laps), np.ones(2), bar)
        for name, array in bars[0].numpy(2).items():
            assert np.allclose(array, bars[1].numpy(2)[name], rtol=1e-7, atol=1e-9), name
