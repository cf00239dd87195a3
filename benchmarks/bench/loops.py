"""Loops of JAX in which a policy acts in every step, timed beside the same steps in one call."""

import json
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import cortado.jax
from benchmarks.bench.environment import environment
from benchmarks.bench.learning import device_name, seconds
from cortado import Scene, Simulation

WEIGHTS = (-0.5, -0.3, 0.1)
"""Weights of the policy, for the mean place and velocity of the fluid, and a constant."""


def tank(side: int) -> Scene:
    """Return a square of fluid in the plane, that many spacings wide and high, in a tank of twice its width."""
    width = 0.02 * side
    return Scene.model_validate(
        {
            "dimension": 2,
            "discretisation": {"spacing": 0.02, "jitter": 0.05},
            "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 0.01}],
            "fluid": [{"shape": "box", "lower": [0.0, 0.0], "upper": [width, width], "phase": "water"}],
            "container": {"shape": "box", "lower": [0.0, 0.0], "upper": [2.0 * width, 2.0 * width]},
            "solver": {"kind": "projection", "time_step": 0.002 * (15.0 / side) ** 0.5},
        }
    )


def bench_loops(side: int, steps: int, repeats: int, device: str, as_json: bool) -> str:
    """Return as text the times of a loop in which a policy leans the tank before every step, and of one call of as many
    steps under what it does first, both compiled: the least of ``repeats``, taken in turn."""
    simulation = Simulation(tank(side), device)
    first = cortado.jax.state(simulation)
    middle = float(first["positions"][:, 0].mean())

    def leaning(weights: Any, state: Any) -> Any:
        place, speed = state["positions"][:, 0].mean() - middle, state["velocities"][:, 0].mean()
        lean = 4.0 * jnp.tanh(weights @ jnp.stack([5.0 * place, speed, jnp.ones_like(speed)]))
        return {"gravity": jnp.stack([lean, jnp.full_like(lean, -9.81)])}

    def in_a_loop(weights: Any) -> Any:
        def act(state: Any, _: Any) -> Any:
            return cortado.jax.step(simulation, state, leaning(weights, state)), None

        return jax.lax.scan(act, first, length=steps)[0]["positions"][:, 0].mean()

    def at_once(weights: Any) -> Any:
        return cortado.jax.step(simulation, first, leaning(weights, first), steps)["positions"][:, 0].mean()

    weights, rows = jnp.array(WEIGHTS), dict[str, dict[str, float]]()
    for name, made in (("value", lambda loss: loss), ("value and gradient", jax.value_and_grad)):
        works = {kind: partial(jax.jit(made(loss)), weights) for kind, loss in (("calls", in_a_loop), ("one", at_once))}
        times: dict[str, list[float]] = {kind: [] for kind in works}
        for number in range(3 + repeats):  # a CPU captures in the second
            for kind, work in works.items():
                time = 1e3 * seconds(partial(_done, work), device)
                times[kind] += [time] if number >= 3 else []
        least = {kind: float(np.min(own)) for kind, own in times.items()}
        rows[name] = {**least, "ratio": least["calls"] / least["one"]}
    found = {
        "device": device_name(device, environment()["processor"]),
        "particles": simulation.particles,
        "steps": steps,
        "ms": rows,
    }
    if as_json:
        return json.dumps(found, indent=2)
    head = f"{simulation.particles} particles on {found['device']}, {steps} steps:"
    lines = [
        f"{name:20}{steps} calls {row['calls']:8.2f} ms, one call {row['one']:8.2f} ms, ratio {row['ratio']:5.2f}"
        for name, row in rows.items()
    ]
    return "\n".join([head, *lines])


def _done(work: Callable[[], Any]) -> None:
    jax.block_until_ready(work())
