"""Batches of environments in Stable-Baselines3: its checks, its meanings of ends and seeds, and that PPO learns."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from cortado import InputError
from cortado.environments import FluidEnv, make_vec

pytest.importorskip("stable_baselines3")
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecMonitor, VecNormalize

from cortado.environments.stable_baselines import StableBaselinesVecEnv

STEPS = 3


def made(num_envs=3, **settings):
    return StableBaselinesVecEnv("Carry", num_envs, **{"max_episode_steps": STEPS, "particles": 4, **settings})


@pytest.fixture(scope="module")
def envs():
    return made()


def throw(scenes, number):
    """Lets a particle of a scene fly away in the next step."""
    arrays = scenes.state.arrays.copy()
    velocities = arrays.numpy(2)["velocities"]
    velocities[number, 0, 0] = 1e6
    arrays.set({"velocities": velocities})
    scenes.state = replace(scenes.state, arrays=arrays)


def test_its_checker_has_nothing_to_say(recwarn):
    check_env(FluidEnv("Carry", render_mode="rgb_array"), warn=True)
    assert not [str(one.message) for one in recwarn if issubclass(one.category, UserWarning)]


def test_a_batch_is_what_its_own_vector_of_single_environments_is(envs):
    """Observations, rewards, ends, terminal observations and flags, bit for bit, also of the next episodes."""

    def single():
        from gymnasium.wrappers import TimeLimit

        return TimeLimit(FluidEnv("Carry", particles=4), STEPS)

    other = DummyVecEnv([single] * 3)
    for one in (envs, other):
        one.seed(5)
    assert np.array_equal(envs.reset(), other.reset())
    assert envs.observation_space == other.observation_space and envs.action_space == other.action_space
    for actions in np.random.default_rng(0).uniform(-1.0, 1.0, (2 * STEPS + 1, 3, 2)).astype(np.float32):
        (seen, rewards, dones, infos), (*wanted, told) = envs.step(actions), other.step(actions)
        for found, expected in zip((seen, rewards, dones), wanted, strict=True):
            assert found.dtype == expected.dtype and np.array_equal(found, expected)
        for info, one in zip(infos, told, strict=True):
            assert info.keys() == one.keys() and info["TimeLimit.truncated"] == one["TimeLimit.truncated"]
            if "terminal_observation" in one:
                assert np.array_equal(info["terminal_observation"], one["terminal_observation"])


def test_an_episode_that_diverged_is_not_truncated(envs):
    envs.reset()
    throw(envs.envs.scenes, 1)
    _, rewards, dones, infos = envs.step(np.zeros((3, 2)))
    assert dones.tolist() == [False, True, False] and rewards[1] == -12.0 * 75
    assert [info["TimeLimit.truncated"] for info in infos] == [False] * 3
    assert "diverged" in infos[1]["diverged"] and "terminal_observation" in infos[1] and "diverged" not in infos[0]
    assert np.isfinite(envs.step(np.zeros((3, 2)))[0]).all()


def test_seeds_and_options_are_used_once(envs):
    seeds = envs.seed(7)
    first, again = envs.reset(), envs.reset()
    assert seeds == [7, 8, 9] and not np.array_equal(first, again)
    envs.seed(7)
    assert np.array_equal(envs.reset(), first)
    assert np.array_equal(first, make_vec("Carry", 3, particles=4).reset(seed=7)[0])
    state = envs.envs.save()
    envs.step(np.ones((3, 2)))
    envs.set_options({"state": state})
    assert np.array_equal(envs.reset(), first) and not np.array_equal(envs.reset(), first)
    envs.set_options([{"state": state}, {}, {}])
    with pytest.raises(InputError, match="options differ from environment to environment"):
        envs.reset()
    envs.set_options()


def test_attributes_and_methods_of_single_environments(envs):
    envs.seed(7)
    envs.reset()
    envs.step(np.zeros((3, 2)))
    assert envs.get_attr("step_number") == [1, 1, 1]
    assert np.array_equal(envs.get_attr("goal", [2, 0]), envs.envs.scenes.goal[[2, 0]])
    assert envs.has_attr("layout") and not envs.has_attr("price")
    envs.set_attr("price", 3, indices=1)
    assert envs.get_attr("price", 1) == [3] and not envs.has_attr("price")
    twin, other = envs.env_method("twin", 2, indices=[2, 0])
    assert twin.value(np.zeros((2, 2))) == envs.envs.twin(2, 2).value(np.zeros((2, 2))) != other.value(np.zeros((2, 2)))
    env = FluidEnv("Carry", particles=4)
    (state,) = envs.env_method("save", indices=-1)
    assert np.array_equal(env.restore(state), envs.envs._observations[2])
    assert envs.env_is_wrapped(Monitor) == [False] * 3 and len(pickle.dumps(envs)) > 0
    for call, words in [
        (lambda: envs.set_attr("goal", 1.0), "goal cannot be set, as it belongs to the batch"),
        (lambda: envs.get_attr("goal", 3), "indices is 3, but must be whole numbers below 3"),
        (lambda: made(autoreset_mode="Disabled"), "autoreset_mode is given, but must be left out"),
        (lambda: envs.step_wait(), r"step_wait is called without actions, but must come after step_async"),
    ]:
        with pytest.raises(InputError, match=words):
            call()


def test_pictures_and_the_wrappers_of_the_library():
    envs = made(2, render_mode="rgb_array")
    envs.reset()
    assert envs.render_mode == "rgb_array" and envs.render().shape == (400, 320, 3)
    wrapped = VecNormalize(VecCheckNan(VecMonitor(envs)))
    model = PPO("MlpPolicy", wrapped, n_steps=4, batch_size=4, seed=1)
    model.learn(8)
    returns, lengths = evaluate_policy(model, wrapped, n_eval_episodes=2, return_episode_rewards=True)
    assert lengths == [STEPS, STEPS] and np.isfinite(returns).all()


def test_ppo_learns_to_carry():
    """In 4,000 steps it learns to go to the right: nowhere has a return of -9.6, there at full speed one of -6.7."""
    settings = {"particles": 0, "max_episode_steps": 25}
    model = PPO("MlpPolicy", made(8, **settings), n_steps=64, batch_size=64, learning_rate=1e-3, seed=1, gamma=0.95)
    judged = made(8, **settings)

    def mean_return(policy):
        judged.seed(100)
        seen, total = judged.reset(), 0.0
        for _ in range(25):
            seen, rewards, _, _ = judged.step(policy(seen))
            total += rewards.mean()
        return total

    nothing = mean_return(lambda seen: np.zeros((8, 2)))
    model.learn(4096)
    learnt = mean_return(lambda seen: model.predict(seen, deterministic=True)[0])
    assert nothing < -9.0 and learnt > nothing + 0.5
