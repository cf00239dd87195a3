"""Saved states of environments: copies and pickles go on with the same bits, and twins begin where a state is."""

import copy
import pickle
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

import cortado
import cortado.environments
from cortado import InputError
from cortado.environments import FluidEnv, make_vec, scenes
from cortado.environments.catalogue import TASKS, Carry


class Timed(Carry):
    name = "Timed"

    @property
    def scene(self):
        tables = super().scene.model_dump(exclude_unset=True)
        block = {"name": "block", "shape": "box", "lower": [-0.5, 0.0], "upper": [-0.4, 0.1]}
        tables["solid"] = [*tables["solid"], {**block, "motion": "path", "velocity": [0.05, 0.0]}]
        return cortado.Scene(**tables)


MADE = {"Timed": Timed}
pytestmark = pytest.mark.filterwarnings("ignore:.*time_step is:cortado.CortadoWarning")


def batch(name, count=2):
    """In float64 with a free body, whose kernels in float32 few need."""
    task, precision = MADE[name]() if name in MADE else name, "float64" if name == "Raft" else "float32"
    return make_vec(task, count, max_episode_steps=4, precision=precision)


@pytest.fixture(scope="module")
def batches():
    made = {}

    def of(name):
        return made[name] if name in made else made.setdefault(name, batch(name))

    return of


def actions_of(envs, count, seed=0):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, *envs.action_space.shape))


def gone_on(envs, actions):
    return [[np.asarray(part).tobytes() for part in envs.step(action)[:4]] for action in actions]


def lost(envs):
    """Lets a particle of the second scene fly away in the next step."""
    fields = envs.scenes.state.arrays.copy()
    velocities = fields.numpy(2)["velocities"]
    velocities[1, 0, 0] = 1e6
    fields.set({"velocities": velocities})
    envs.scenes.state = replace(envs.scenes.state, arrays=fields)


@pytest.mark.parametrize("name", ["Latte", "Raft", "Timed"])
def test_batches_that_are_saved_copied_and_pickled_go_on_with_the_same_bits(batches, name):
    """Beyond the end of an episode, so that their generators draw the next one: with a nozzle, a body that floats, and
    a block on a path of its own."""
    envs = batches(name)
    actions = actions_of(envs, 6)
    envs.reset(seed=3)
    gone_on(envs, actions[:2])
    state = envs.save()
    copied = {"Latte": copy.deepcopy, "Timed": lambda envs: pickle.loads(pickle.dumps(envs))}
    copies = [copied[name](envs)] if name in copied else []
    fresh = batch(name)
    fresh.restore(pickle.loads(pickle.dumps(state)))
    wanted = gone_on(envs, actions[2:])
    assert wanted[0] != wanted[3]
    for other in (*copies, fresh):
        assert gone_on(other, actions[2:]) == wanted
    for _ in range(2):
        envs.restore(state)
        assert gone_on(envs, actions[2:]) == wanted


def test_what_the_scene_itself_changes_goes_on_from_step_to_step(batches):
    envs = batches("Timed")
    envs.reset(seed=3)
    gone_on(envs, actions_of(envs, 3))
    place, task = envs.scenes.state["block.position"].numpy()[:, 0, 0], envs.scenes.task
    assert np.allclose(place, -0.45 + 0.05 * 3 * task.substeps * task.time_step, atol=1e-6)


def test_a_single_one_goes_on_through_the_wrappers_of_gymnasium():
    env = gymnasium.make("cortado/Splash-v0", max_episode_steps=4)
    actions = actions_of(env, 4)
    env.reset(seed=3)
    env.step(actions[0])
    state, other = env.unwrapped.save(), pickle.loads(pickle.dumps(env))

    def rest(one):
        found = [one.step(action)[:4] for action in actions[1:]]
        return [(seen.tobytes(), *others) for seen, *others in (*found, one.reset(seed=None))]

    wanted = rest(env)
    assert wanted[2][3] and rest(other) == wanted and rest(copy.deepcopy(env)) != wanted
    fresh = gymnasium.make("cortado/Splash-v0")
    seen, _ = fresh.reset(options={"state": state})
    assert np.array_equal(seen, state.observations[0])
    found = rest(fresh)
    assert [one[:2] for one in found] == [one[:2] for one in wanted] and not found[2][3]


def test_a_restored_one_is_truncated_where_its_task_ends():
    env = gymnasium.make("cortado/Splash-v0")
    env.reset(seed=1)
    zero, horizon = np.zeros(2), TASKS["Splash"].horizon
    for _ in range(horizon - 2):
        env.step(zero)
    state = env.unwrapped.save()
    for _ in range(2):
        env.reset(options={"state": state})
        assert [env.step(zero)[3] for _ in range(2)] == [False, True]
    ended = env.unwrapped.save()
    env.reset(seed=1)
    env.unwrapped.restore(ended)
    with pytest.raises(InputError, match="after the end of an episode, but must come after reset"):
        env.unwrapped.step(zero)


def test_scenes_of_a_state_are_chosen_and_come_again(batches):
    envs = batches("Carry")
    actions = actions_of(envs, 3)
    envs.reset(seed=3)
    envs.step(actions[0])
    state = envs.save()
    wanted = [envs.step(action)[:2] for action in actions[1:]]
    many, single = make_vec("Carry", 4, max_episode_steps=4), FluidEnv("Carry")
    for saved in (state, pickle.loads(pickle.dumps(state))):
        many.restore(saved[[1, 0, 1, 0]])
        single.restore(saved[1])
        for action, (seen, rewards) in zip(actions[1:], wanted, strict=True):
            found, given = many.step(action[[1, 0, 1, 0]])[:2]
            assert np.array_equal(found, seen[[1, 0, 1, 0]]) and np.array_equal(given, rewards[[1, 0, 1, 0]])
            found, given = single.step(action[1])[:2]
            assert np.array_equal(found, seen[1]) and given == rewards[1]


def test_scenes_that_diverged_stay_so(batches):
    envs = batches("Splash")
    envs.reset(seed=3)
    lost(envs)
    actions = actions_of(envs, 3)
    assert envs.step(actions[0])[2].tolist() == [False, True]
    other = pickle.loads(pickle.dumps(envs))
    assert other.scenes._lost == {1} and gone_on(other, actions[1:]) == gone_on(envs, actions[1:])


@pytest.mark.parametrize("name", ["Raft", "Timed"])
def test_batches_that_are_cut_for_the_cores_have_the_bits_of_single_ones(name, monkeypatch):
    monkeypatch.setattr(scenes, "parts_of", lambda simulation: 1)
    whole = batch(name, 3)
    monkeypatch.setattr(scenes, "parts_of", lambda simulation: 2)
    cut = batch(name, 3)
    actions = actions_of(cut, 6)
    for envs in (whole, cut):
        envs.reset(seed=3)
        lost(envs)
    assert len(cut.scenes._steps.steppers) == 2 and gone_on(cut, actions) == gone_on(whole, actions)
    assert pickle.loads(pickle.dumps(cut)).scenes.state["positions"].shape == cut.scenes.state["positions"].shape


@pytest.mark.parametrize("name", ["Latte", "Raft", "Timed"])
def test_a_twin_begins_where_a_state_is(name):
    env = FluidEnv(MADE[name]() if name in MADE else name, precision="float64")
    actions = actions_of(env, 3)
    env.reset(seed=5)
    env.step(actions[0])
    state, later = env.save(), actions[1:]
    rewards = [env.step(action)[1] for action in later]
    whole, twin = env.twin(3), env.twin(2, state)
    value, gradient = twin.value_and_gradient(later)
    assert abs(value + sum(rewards)) < 1e-12 * max(1.0, abs(value))
    assert np.allclose(gradient, whole.value_and_gradient(actions)[1][1:], rtol=1e-9, atol=1e-13)
    direction, h = np.random.default_rng(1).standard_normal(gradient.shape), 1e-6
    difference = (twin.value(later + h * direction) - twin.value(later - h * direction)) / (2.0 * h)
    assert gradient.any() and np.isclose(difference, (gradient * direction).sum(), rtol=1e-5, atol=1e-9)
    assert env.twin(state=state).shape[0] == env.scenes.task.horizon - 1
    env.restore(state)
    assert [env.step(action)[1] for action in later] == rewards


def test_states_of_others_are_refused_in_a_sentence(batches):
    envs, single = batches("Carry"), FluidEnv("Carry")
    envs.reset(seed=3)
    single.reset(seed=3)
    state, own = envs.save(), single.save()
    carried = r"1 scene of the task Carry, small, in float32 with \d+ observed numbers"
    splash, double = FluidEnv("Splash"), FluidEnv("Carry", precision="float64")
    wider = type("Carry", (Carry,), {"floor": -0.2})
    for call, words in [
        (lambda: single.restore(state), f"state is of 2 scenes of .*, but must be of {carried}"),
        (lambda: splash.restore(own), f"state is of {carried}, but must be of 1 scene of the task Splash"),
        (lambda: double.restore(own), "but must be of 1 scene of the task Carry, small, in float64"),
        (lambda: FluidEnv(wider()).restore(own), "state is of another scene than that of 1 scene of the task Carry"),
        (lambda: single.restore({"positions": 0}), "state is a table, but must be an EnvState, as save"),
        (lambda: single.reset(seed=1, options={"state": own}), "seed is given, but must be left out with a state"),
        (lambda: envs.reset(options={"state": state, "reset_mask": np.ones(2, bool)}), "reset_mask is given, but must"),
        (lambda: splash.save(), r"save is called before the first reset\(\), but must come after it"),
        (lambda: state[[2]], r"numbers are \[2\], but must be scene numbers from 0 to 1"),
    ]:
        with pytest.raises(InputError, match=words):
            call()
    assert repr(state).startswith("EnvState(2 scenes of the task Carry") and len(state) == 2
    splash.close()
    for call in (splash.save, lambda: splash.restore(own)):
        with pytest.raises(InputError, match=r"after close\(\)"):
            call()
