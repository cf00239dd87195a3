"""Controllers of environments on the same budget of simulated steps: a cross-entropy method, gradients, and PPO."""

import json
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

import cortado
from cortado.environments import EnvState, FluidVectorEnv, Twin, make_vec
from cortado.errors import DivergedError, InputError

POPULATION, ELITE, SPREAD = 16, 4, 0.5
"""Sequences of actions that the cross-entropy method tries at a time, of which the best decide on the next; and their
first standard deviation."""
STEP_BACK = 3
"""Steps that a step back counts for, besides the step itself: see `benchmarks/control/README.md`."""
LEARNING_RATE = 0.1
"""Of Adam, along gradients of `AdjointViscosity`."""


def bench_learners(
    tasks: Sequence[str], episodes: int, seed: int, size: str, device: str, policies: bool, as_json: bool
) -> str:
    """Return as text what each controller makes of the episode of a seed of each task, for so many ``episodes`` of
    simulated steps; PPO, whose policy learns in other episodes, with ``policies`` alone."""
    rows = [row_of(task, episodes, seed, {"size": size, "device": device}, policies) for task in tasks]
    if as_json:
        return json.dumps({"episodes": episodes, "seed": seed, "returns": rows}, indent=2)
    names = list(rows[0])
    cells = [names, *([one if isinstance(one, str) else f"{one:.4g}" for one in row.values()] for row in rows)]
    return "\n".join("  ".join(f"{cell:>14}" for cell in line) for line in cells)


def row_of(task: str, episodes: int, seed: int, settings: dict[str, Any], policies: bool) -> dict[str, Any]:
    """Return the returns of one task by controller."""
    envs = make_vec(task, 1, **settings)
    envs.reset(seed=[seed])
    start, twin = envs.save(), envs.twin(0)
    tried = make_vec(task, POPULATION, **settings)
    found: dict[str, Any] = {"task": task, "nothing": float(returns(envs, start, np.zeros((1, *twin.shape)))[0])}
    found["cem"] = cross_entropy(tried, start[[0] * POPULATION], twin.shape, episodes, seed)
    found["gradient"] = descended(twin, episodes // (1 + STEP_BACK))
    if policies:
        found["ppo"] = learnt(task, envs, start, episodes, seed, settings)
    return found


def returns(envs: FluidVectorEnv, start: EnvState, actions: NDArray) -> NDArray[np.float64]:
    """Return the sum of rewards (envs,) of an episode from a state, under actions (envs, steps, a)."""
    envs.restore(start)
    total, going = np.zeros(len(actions)), np.ones(len(actions), dtype=bool)
    for step in range(actions.shape[1]):
        _, rewards, terminated, truncated, _ = envs.step(actions[:, step])
        total += np.where(going, rewards, 0.0)
        going &= ~(terminated | truncated)
    return total


def cross_entropy(envs: FluidVectorEnv, start: EnvState, shape: tuple[int, int], episodes: int, seed: int) -> float:
    """Return the greatest return of sequences of actions that the cross-entropy method tries (Rubinstein 1999)."""
    random, mean, spread, best = np.random.default_rng(seed), np.zeros(shape), np.full(shape, SPREAD), -np.inf
    for _ in range(episodes // POPULATION):
        tried = np.clip(mean + spread * random.standard_normal((POPULATION, *shape)), -1.0, 1.0)
        found = returns(envs, start, tried)
        elite = tried[np.argsort(found)[-ELITE:]]
        mean, spread, best = elite.mean(axis=0), elite.std(axis=0) + 0.05, max(best, float(found.max()))
    return best


def descended(twin: Twin, updates: int) -> float:
    """Return the greatest return that Adam meets in so many gradients; a run that diverges ends the search."""
    best = np.inf

    def loss(named: Any) -> Any:
        nonlocal best
        value, gradient = twin.search.value_and_gradient(named, cortado.gradients.AdjointViscosity())
        best = min(best, value)
        return value, gradient

    start = twin.named(np.zeros(twin.shape))
    bounds = dict.fromkeys(start, (-1.0, 1.0))
    with suppress(DivergedError):  # Adam evaluates once more after its last update
        cortado.optimise(loss, start, cortado.optimisers.Adam(LEARNING_RATE), updates - 1, bounds=bounds)
    return -best


def learnt(
    task: str, envs: FluidVectorEnv, start: EnvState, episodes: int, seed: int, settings: dict[str, Any]
) -> float:
    """Return the return of the policy that PPO has learnt in other episodes, in the episode that begins at a state.
    Raises `InputError` without Stable-Baselines3."""
    try:
        from stable_baselines3 import PPO

        from cortado.environments.stable_baselines import StableBaselinesVecEnv
    except ImportError:
        raise InputError("Stable-Baselines3 is missing; install it with pip install stable-baselines3.") from None
    steps, many = envs.scenes.task.horizon, 8
    model = PPO("MlpPolicy", StableBaselinesVecEnv(task, many, **settings), n_steps=steps, seed=seed)
    model.learn(episodes * steps)
    seen, total = envs.restore(start), 0.0
    for _ in range(steps):
        seen, rewards, terminated, _, _ = envs.step(model.predict(seen, deterministic=True)[0])
        total += float(rewards[0])
        if terminated[0]:
            break
    return total
