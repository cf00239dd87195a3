"""``python -m benchmarks.gradients.policies``: policies trained in closed loop, with gradients and without.

A network looks at the fluid of the tasks Carry and Splash before every action and is to bring in as much reward as it
can, over 800 steps. It is trained by L-BFGS (Nocedal 1980) on the gradients of `cortado.jax.step` or
`cortado.torch.step`, exact and by `AdjointViscosity`, and by the cross-entropy method (CEM) on values alone, all with
the same number of simulated steps. A gradient counts as many steps as it takes time: it is timed at the start against
values of the same episode. Episodes differ in their first positions, by 2 % of a spacing. What is shown is the mean
reward of an action in four test episodes, which nobody trains with and which do not count.

    python -m benchmarks.gradients.policies --task carry --seeds 1 --steps 200 --budget 20000    # small, minutes
    python -m benchmarks.gradients.policies --task carry --processes 15                          # a core each
    python -m benchmarks.gradients.policies --task carry --method CEM --device cuda:0            # batches
    python -m benchmarks.gradients.policies --task carry --framework torch --method AdjointViscosity Exact
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import cortado.jax
from cortado import DivergedError, Simulation, gradients
from cortado.environments.catalogue import Carry, Letter, Splash
from cortado.environments.task import Actuator, Task
from cortado.pictures.plots import PALETTE, drawing

HIDDEN = 8
METHODS = {"AdjointViscosity": gradients.AdjointViscosity(), "Exact": None, "CEM": None}
TASKS = {"carry": Carry(), "splash": Splash()}
JITTER, TESTS, CHECKS = 0.02, 4, 10
"""Of first positions [spacings]; test episodes; how often they are run."""
PAIRS, FIRST, FARTHEST, TRIES = 8, 1.0, 3.0, 6
"""Of L-BFGS: changes that it remembers, length of the first step and greatest length of a step, both in weights, and
how often a step is shortened."""
SHORTER, ENOUGH = 0.35, 1e-4
"""Factor by which a step is shortened, and share of the slope by which it has to lower the loss (Armijo 1966)."""
POPULATION, ELITE, WIDTH, NARROWEST = 20, 5, 0.5, 0.05
"""Of CEM: policies of a generation, how many of them lead, first and least standard deviation of the weights."""
Row = dict[str, Any]


class InJax:
    """The operations of a loop on arrays of JAX."""

    layers, cat, stack, tanh, sin, cos = cortado.jax, jnp.concatenate, jnp.stack, jnp.tanh, jnp.sin, jnp.cos
    least = staticmethod(lambda x: x.min(-1))
    compiled = staticmethod(jax.jit)

    @staticmethod
    def array(x: Any) -> Any:
        return jnp.asarray(x, jnp.float32)

    @staticmethod
    def scan(act: Callable[[Any, Any], tuple[Any, Any]], begun: Any, count: int) -> Any:
        return jax.lax.scan(act, begun, jnp.arange(count, dtype=jnp.float32))[1]

    @staticmethod
    def with_slope(loss: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        return jax.jit(jax.value_and_grad(loss))


class Driven:
    """An actuator: the parameter over the steps of an action, linear in its state and the action."""

    def __init__(self, xp: Any, actuator: Actuator, steps: int, time_step: float):
        a = len(actuator.axes)
        now = np.zeros((4, 2, a))
        now[1, 0] = now[2, 1] = 1.0
        after, rows = actuator.advance(now, np.arange(4)[:, None] // 3 * np.ones((4, a)), steps, time_step)
        self._base, self._after, self._rows = (xp.array(x) for x in (rows[0], after[1:], rows[1:] - rows[0]))
        self._wide = None if actuator.is_number else xp.array(np.eye(len(actuator.rest))[list(actuator.axes)])

    def __call__(self, now: Any, u: Any) -> tuple[Any, Any]:
        """Return the state (2, a) after an action (a,), and the parameter (steps, d) or (steps,)."""
        given = now[0], now[1], u
        after = sum(own * x for own, x in zip(self._after, given, strict=True))
        wide = given if self._wide is None else [x @ self._wide for x in given]
        return after, self._base + sum(own * x for own, x in zip(self._rows, wide, strict=True))


@dataclass(frozen=True)
class Loop:
    """A task in closed loop: minus the mean reward of its actions as a function of a policy's weights."""

    task: Task
    simulation: Simulation
    actions: int

    @property
    def steps(self) -> int:
        """Steps of the simulation in an episode."""
        return self.actions * self.task.substeps

    @property
    def sizes(self) -> tuple[int, int]:
        """Numbers that the policy sees, and that it says."""
        return 8 + 3 * self._axes, self._axes

    @property
    def _axes(self) -> int:
        return sum(len(one.axes) for one in self.task.actuators)

    def weights(self, seed: int) -> NDArray[Any]:
        """Draw the weights (w,) of a first policy, which does little."""
        (seen, said), random = self.sizes, np.random.default_rng(seed)
        inner, outer = random.normal(0.0, 1.0 / np.sqrt(seen), (seen, HIDDEN)), random.normal(0.0, 0.1, (HIDDEN, said))
        return np.concatenate([inner.ravel(), np.zeros(HIDDEN), outer.ravel(), np.zeros(said)])

    def starts(self, random: np.random.Generator, count: int) -> NDArray[Any]:
        """Draw first positions (count, n, 2)."""
        x = self.simulation.positions
        return x + JITTER * self.task.spacing * random.standard_normal((count, *x.shape))

    def loss(self, estimator: Any, xp: Any = InJax) -> Callable[[Any, Any], Any]:
        """Return the loss of weights (w,) and first positions (n, 2), differentiable by an estimator."""
        task, simulation, first = self.task, self.simulation, xp.layers.state(self.simulation)
        driven = [Driven(xp, one, task.substeps, task.time_step) for one in task.actuators]
        (seen, said), rewarded = self.sizes, REWARDS[task.name](xp, task, simulation)

        def loss(weights: Any, positions: Any) -> Any:
            inner, bias, outer, last = _cut(weights, [seen * HIDDEN, HIDDEN, HIDDEN * said, said])

            def act(carried: Any, number: Any) -> tuple[Any, Any]:
                state, now = carried
                x, v = state["positions"], state["velocities"]
                fluid = [x.mean(0) - middle, 0.3 * v.mean(0), 5.0 * _spread(x), _spread(v)]
                own = [own.ravel() for own in now]
                known = xp.cat([*fluid, *own, zeros[:said] + number / self.actions])
                u = xp.tanh(xp.tanh(known @ inner.reshape(seen, HIDDEN) + bias) @ outer.reshape(HIDDEN, said) + last)
                parts, after, rows = _cut(u, axes), [], {}
                for one, actuator, was, part in zip(driven, task.actuators, now, parts, strict=True):
                    later, rows[actuator.parameter] = one(was, part)
                    after.append(later)
                state = xp.layers.step(simulation, state, rows, task.substeps, estimator)
                return (state, after), rewarded(state)

            axes, zeros = [len(one.axes) for one in task.actuators], xp.array(np.zeros(2 * said))
            middle = xp.array(simulation.positions.mean(0))
            rest = [part.reshape(2, -1) for part in _cut(zeros, [2 * count for count in axes])]
            begun = {**first, "positions": positions}, rest
            return -xp.scan(act, begun, self.actions).mean()

        return loss


def _cut(x: Any, lengths: list[int]) -> list[Any]:
    ends = np.cumsum(lengths).tolist()
    return [x[end - length : end] for end, length in zip(ends, lengths, strict=True)]


def _spread(x: Any) -> Any:
    return ((x - x.mean(0)) ** 2).mean(0) ** 0.5


def share(xp: Any, x: Any, lower: Any, upper: Any, width: float) -> Any:
    """Return the share of particles (n, 2) in boxes (boxes, 2), as `cortado.environments.terms.Share` counts them."""
    way = x[:, None] - x[:, None].clip(xp.array(lower), xp.array(upper))
    return (1.0 / (1.0 + xp.least((way**2).sum(-1)) / width**2)).mean()


def carried(xp: Any, task: Carry, simulation: Simulation) -> Callable[[Any], Any]:
    """Return the reward of Carry, whose goal is in the middle of all goals."""
    goal, middle = float(np.mean(task.goals)), simulation.scene.solid[0].middle()
    lower, upper = -middle, np.array([task.width, task.height]) - middle

    def reward(state: Any) -> Any:
        place, turn = state["cup.position"][0], state["cup.turn"][0]
        cos, sin = xp.cos(turn), xp.sin(turn)
        x, y = (state["positions"] - place).T
        own = xp.stack([cos * x + sin * y, cos * y - sin * x], -1)
        return -abs(place[0] - goal) - 10.0 + 10.0 * share(xp, own, lower[None], upper[None], task.coarse_spacing)

    return reward


def splashed(xp: Any, task: Splash, simulation: Simulation) -> Callable[[Any], Any]:
    """Return the reward of Splash, whose goal is in the middle of all goals."""
    (lower,), (upper,) = Letter(task.half)(np.mean(task.goals, axis=0)[None])
    return lambda state: share(xp, state["positions"], lower, upper, task.coarse_spacing)


REWARDS: dict[str, Any] = {"Carry": carried, "Splash": splashed}


class Descent:
    """L-BFGS with a search along each direction, on one episode until no step lowers its loss, then on another."""

    def __init__(
        self, loop: Loop, estimator: Any, weights: NDArray[Any], random: np.random.Generator, device: str, xp: Any
    ):
        self._loop, self._random, self._weights, self._xp = loop, random, weights, xp
        self._value, self._slope = xp.compiled(loop.loss(None, xp)), xp.with_slope(loop.loss(estimator, xp))
        self._begin()
        given = self._given(weights)
        self._longer = seconds(device, self._slope, *given) / seconds(device, self._value, *given)

    def _begin(self) -> None:
        """Draw an episode, of which nothing is known yet."""
        self._start = self._xp.array(self._loop.starts(self._random, 1)[0])
        self._pairs: list[tuple[NDArray[Any], NDArray[Any]]] = []
        self._last: tuple[float, NDArray[Any]] | None = None

    def _given(self, weights: NDArray[Any]) -> tuple[Any, Any]:
        return self._xp.array(weights), self._start

    def _along(self, slope: NDArray[Any]) -> NDArray[Any]:
        """Return the direction of descent, by the two loops of Nocedal (1980)."""
        found, shares = slope.copy(), []
        for moved, turned in reversed(self._pairs):
            shares.append(moved @ found / (moved @ turned))
            found -= shares[-1] * turned
        moved, turned = self._pairs[-1] if self._pairs else (FIRST * slope / np.linalg.norm(slope), slope)
        found *= (moved @ turned) / (turned @ turned)
        for (moved, turned), own in zip(self._pairs, reversed(shares), strict=True):
            found += moved * (own - turned @ found / (moved @ turned))
        found *= -min(1.0, FARTHEST / float(np.linalg.norm(found)))
        return found

    def update(self) -> tuple[NDArray[Any], float]:
        """Return weights with a lower loss, or the same after a search in vain, and what it cost [episodes]."""
        cost, (loss, slope) = 0.0, self._last or self._measure()
        if self._last is None:
            cost += self._longer
        step = self._along(slope)
        for _ in range(TRIES):
            found, cost = self._loss(self._weights + step), cost + 1.0
            if found < loss + ENOUGH * (step @ slope):
                break
            step = SHORTER * step
        else:
            self._last, self._pairs, was_fresh = (loss, slope), [], not self._pairs
            if was_fresh:
                self._begin()
            return self._weights, cost
        self._weights = self._weights + step
        self._last = self._measure()
        turned = self._last[1] - slope
        if step @ turned > 1e-3 * np.linalg.norm(step) * np.linalg.norm(turned):
            self._pairs = [*self._pairs, (step, turned)][-PAIRS:]
        return self._weights, cost + self._longer

    def _loss(self, weights: NDArray[Any]) -> float:
        """Return the loss of an episode; infinite if particles were lost."""
        try:
            return float(self._value(*self._given(weights)))
        except (DivergedError, jax.errors.JaxRuntimeError):
            return np.inf

    def _measure(self) -> tuple[float, NDArray[Any]]:
        loss, slope = self._slope(*self._given(self._weights))
        return float(loss), np.nan_to_num(np.asarray(slope, np.float64), posinf=0.0, neginf=0.0)


class CrossEntropy:
    """The cross-entropy method, whose generations are batches."""

    def __init__(self, loop: Loop, weights: NDArray[Any], random: np.random.Generator):
        self._loop, self._random, self._value = loop, random, jax.jit(jax.vmap(loop.loss(None)))
        self._mean, self._width = weights, np.full(weights.shape, WIDTH)

    def update(self) -> tuple[NDArray[Any], float]:
        """Return the mean of the next generation, and what it cost [episodes]."""
        drawn = self._mean + self._width * self._random.standard_normal((POPULATION, len(self._mean)))
        starts = np.repeat(self._loop.starts(self._random, 1), POPULATION, axis=0)
        losses = rewards(self._loop, self._value, drawn, starts)
        best = drawn[np.argsort(-losses)[:ELITE]]
        self._mean, self._width = best.mean(0), np.maximum(best.std(0), NARROWEST)
        return self._mean, float(POPULATION)


def rewards(loop: Loop, value: Any, weights: NDArray[Any], starts: NDArray[Any]) -> NDArray[Any]:
    """Return rewards (b,) of policies (b, w) and starts (b, n, 2); of lost episodes the lowest."""
    found = -np.asarray(value(jnp.asarray(weights, jnp.float32), jnp.asarray(starts, jnp.float32)))
    return np.where(np.isfinite(found), found, loop.task.lowest)


@dataclass(frozen=True)
class Job:
    """The training of one seed's policy by one method."""

    task: str
    method: str
    seed: int
    steps: int
    budget: int
    device: str
    framework: str

    def run(self) -> Row:
        """Return rewards of test episodes over the number of simulated steps."""
        task = TASKS[self.task]
        loop = Loop(task, Simulation(task.scene, self.device, "float32"), max(self.steps // task.substeps, 1))
        value, random = jax.jit(jax.vmap(loop.loss(None))), np.random.default_rng([self.seed])
        tests = loop.starts(np.random.default_rng(0), TESTS)
        weights, taken, history = loop.weights(self.seed), 0.0, list[tuple[float, float]]()

        def check() -> None:
            found = rewards(loop, value, np.repeat(weights[None], TESTS, axis=0), tests).mean()
            history.append((taken, float(found)))
            print(f"{self.task} {self.method} {self.seed}: {taken:,.0f} {found:.4f}", flush=True)

        check()
        method = (
            CrossEntropy(loop, weights, random)
            if self.method == "CEM"
            else Descent(loop, METHODS[self.method], weights, random, self.device, operations(self.framework))
        )
        cost = 0.0
        while taken + cost <= self.budget:
            weights, episodes = method.update()
            cost = episodes * loop.steps
            taken += cost
            if taken >= len(history) * self.budget / CHECKS or taken + cost > self.budget:
                check()
        own = {"task": self.task, "method": self.method, "seed": self.seed}
        return {**own, "steps": [at for at, _ in history], "rewards": [reward for _, reward in history]}


def operations(name: str) -> Any:
    """Return the operations of a framework on arrays: "jax" or "torch"."""
    if name == "jax":
        return InJax
    from benchmarks.gradients.in_torch import InTorch

    return InTorch


def seconds(device: str, function: Any, *given: Any) -> float:
    """Return how long a call takes, of the processor or on a GPU: the shorter one of two, after the first."""
    ends = []
    for _ in range(3):
        jax.block_until_ready(function(*given))
        ends.append(time.process_time() if device == "cpu" else time.perf_counter())
    return float(np.diff(ends).min())


def draw(rows: list[Row], path: Path) -> None:
    """Draw the rewards of all seeds, and their median, over simulated steps, a panel for each task."""
    names = list(dict.fromkeys(row["task"] for row in rows))
    with drawing(path, 4.6 * len(names), 4.0) as figure:
        for panel, name in zip(np.atleast_1d(figure.subplots(1, len(names))), names, strict=True):
            for colour, method in zip(PALETTE, METHODS, strict=False):
                own = [row for row in rows if (row["task"], row["method"]) == (name, method)]
                for row in own:
                    panel.plot(np.array(row["steps"]) / 1e3, row["rewards"], color=colour, alpha=0.3, linewidth=0.8)
                if own:
                    at = np.linspace(0.0, min(row["steps"][-1] for row in own), 50)
                    each = [np.interp(at, row["steps"], row["rewards"]) for row in own]
                    panel.plot(at / 1e3, np.median(each, axis=0), color=colour, linewidth=2.0, label=method)
            panel.set(title=name, xlabel="simulated steps [1,000]", ylabel="mean reward of an action, test episodes")
            panel.legend()


def table(rows: list[Row]) -> str:
    """Return the table of last rewards."""
    lines = [
        "| task | method | reward at last: median [least, greatest] | first |",
        "|---|---|---|---|",
    ]
    for task, method in dict.fromkeys((row["task"], row["method"]) for row in rows):
        own = [row for row in rows if (row["task"], row["method"]) == (task, method)]
        last, first = ([row["rewards"][k] for row in own] for k in (-1, 0))
        ends = f"{np.median(last):.4f} [{min(last):.4f}, {max(last):.4f}]"
        lines.append(f"| {task} | {method} | {ends} | {np.median(first):.4f} |")
    return "\n".join(lines)


def main() -> None:
    """Train, and write the rows, a picture and a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--method", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--steps", type=int, default=800, help="simulated steps of an episode")
    parser.add_argument("--budget", type=int, default=112_000, help="simulated steps of a training")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--framework", choices=["jax", "torch"], default="jax", help="of the gradients")
    parser.add_argument("--processes", type=int, default=1, help="more than 1: a seed and method at a time in each")
    parser.add_argument("--out", type=Path, default=Path("runs/policies"), help="files of former calls are kept")
    asked = parser.parse_args()
    each = [(task, method, seed) for task in asked.task for method in asked.method for seed in asked.seeds]
    jobs = [Job(*own, asked.steps, asked.budget, asked.device, asked.framework) for own in each]
    asked.out.mkdir(parents=True, exist_ok=True)
    if asked.processes > 1:
        os.environ.setdefault("CORTADO_CORES", "1")
        with ProcessPoolExecutor(asked.processes, get_context("spawn")) as pool:
            found = list(pool.map(Job.run, jobs))
    else:
        found = [job.run() for job in jobs]
    for own, row in zip(each, found, strict=True):
        (asked.out / f"{'-'.join(map(str, own))}.json").write_text(json.dumps(row))
    rows = [json.loads(file.read_text()) for file in sorted(asked.out.glob("*.json"))]
    draw(rows, asked.out / "policies.png")
    (asked.out / "policies.md").write_text(table(rows) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
