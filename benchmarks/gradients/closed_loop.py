"""``python -m benchmarks.gradients.closed_loop``: gradients of a policy that acts every five steps.

The exact adjoint and `AdjointViscosity` stand beside the gradient of the loss smoothed over policies and first states.
A policy with three weights leans a square tank with 225 particles by their mean place and velocity, and is to bring
them to a place. Smoothed is the linear regression of half-differences of the loss over mirrored pairs of policies, with
normal changes of the weights and of first velocities.
"""

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import cortado.jax
from cortado import Scene, Simulation, gradients

EVERY = 5
"""Steps between two actions."""
WEIGHTS = (-0.5, -0.3, 0.1)
SPREAD, SCATTER = 0.05, 0.01
"""Standard deviations, in smoothing, of the weights and of first velocities [m/s]."""
APART, STIRRED = 0.15, 0.05
"""Standard deviations of the weights and of first velocities [m/s] of different seeds."""
AT_ONCE = 16
"""Policies in one batch."""


def tank(device: str = "cpu") -> Simulation:
    """Make the simulation."""
    return Simulation(
        Scene.model_validate(
            {
                "dimension": 2,
                "discretisation": {"spacing": 0.02, "jitter": 0.05},
                "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 0.01}],
                "fluid": [{"shape": "box", "lower": [0.0, 0.0], "upper": [0.3, 0.3], "phase": "water"}],
                "container": {"shape": "box", "lower": [0.0, 0.0], "upper": [0.6, 0.6]},
                "solver": {"kind": "projection", "time_step": 0.002},
            }
        ),
        device,
    )


def loss_of(simulation: Simulation, steps: int, gradient: Any) -> Any:
    """Return the loss of weights and of a scatter of first velocities, as JAX differentiates it by an estimator."""
    first = cortado.jax.state(simulation)

    def loss(weights: Any, scatter: Any) -> Any:
        def act(state: Any, _: Any) -> Any:
            place, speed = state["positions"][:, 0].mean() - 0.3, state["velocities"][:, 0].mean()
            lean = 4.0 * jnp.tanh(weights @ jnp.stack([5.0 * place, speed, jnp.ones_like(speed)]))
            gravity = jnp.stack([lean, jnp.full_like(lean, -9.81)])
            return cortado.jax.step(simulation, state, {"gravity": gravity}, EVERY, gradient), None

        begun = {**first, "velocities": first["velocities"] + scatter}
        end, _ = jax.lax.scan(act, begun, length=steps // EVERY)
        return 100.0 * ((end["positions"][:, 0] - 0.4) ** 2).mean()

    return loss


def smoothed(loss: Any, weights: Any, first: Any, pairs: int, random: np.random.Generator) -> tuple[Any, Any]:
    """Return the gradient of the smoothed loss with respect to the weights, and its standard error. The loss is that of
    `AT_ONCE` policies in one batch."""
    changes = random.normal(0.0, SPREAD, (pairs, len(WEIGHTS)))
    policies = np.stack([weights + changes, weights - changes], axis=1).reshape(-1, AT_ONCE, len(WEIGHTS))
    scatter = np.repeat(first + random.normal(0.0, SCATTER, (pairs, *first.shape)), 2, axis=0)
    scattered = scatter.reshape(-1, AT_ONCE, *first.shape)
    ends = [
        loss(jnp.asarray(w, jnp.float32), jnp.asarray(v, jnp.float32)) for w, v in zip(policies, scattered, strict=True)
    ]
    found = 0.5 * np.subtract(*np.reshape(ends, (pairs, 2)).T)
    gradient, *_ = np.linalg.lstsq(changes, found, rcond=None)
    rest = found - changes @ gradient
    variance = (rest**2).sum() / (pairs - len(WEIGHTS))
    return gradient, np.sqrt(variance * np.diag(np.linalg.inv(changes.T @ changes)))


def main() -> None:
    """Print a row for each number of steps and each seed, and then the least and the median over seeds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, nargs="+", default=[100, 200, 400, 800])
    parser.add_argument("--pairs", type=int, default=48, help=f"pairs of policies, a multiple of {AT_ONCE // 2}")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5], help="policies and first states")
    parser.add_argument("--device", default="cpu")
    asked = parser.parse_args()
    simulation, rows = tank(asked.device), []
    print("| steps | seed | smoothed, its standard error | exact: cosine, size | `AdjointViscosity`: cosine, size |")
    for steps in asked.steps:
        value = jax.jit(jax.vmap(loss_of(simulation, steps, None)))
        slopes = [jax.jit(jax.grad(loss_of(simulation, steps, own))) for own in (None, gradients.AdjointViscosity())]
        cosines = []
        for seed in asked.seeds:
            random = np.random.default_rng(seed)
            weights = np.array(WEIGHTS) + random.normal(0.0, APART, len(WEIGHTS))
            first = random.normal(0.0, STIRRED, simulation.positions.shape)
            wanted, error = smoothed(value, weights, first, asked.pairs, random)
            at = jnp.asarray(weights, jnp.float32), jnp.asarray(first, jnp.float32)
            own = [np.array(slope(*at), dtype=np.float64) for slope in slopes]
            sizes = [np.linalg.norm(one) / np.linalg.norm(wanted) for one in own]
            cosines.append([one @ wanted / np.linalg.norm(one) / np.linalg.norm(wanted) for one in own])
            found = " | ".join(f"{cosine:.2f}, {size:.2g}" for cosine, size in zip(cosines[-1], sizes, strict=True))
            noise = np.linalg.norm(error) / np.linalg.norm(wanted)
            print(f"| {steps} | {seed} | {np.round(wanted, 2).tolist()}, {noise:.0%} | {found} |", flush=True)
        each = zip(np.min(cosines, axis=0), np.median(cosines, axis=0), strict=True)
        rows.append(f"| {steps} | " + " | ".join(f"{least:.2f}, {median:.2f}" for least, median in each) + " |")
    print("\n| steps | exact: least cosine, median | `AdjointViscosity` |", *rows, sep="\n")


if __name__ == "__main__":
    main()
