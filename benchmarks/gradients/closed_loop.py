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
from numpy.typing import NDArray

import cortado.jax
from cortado import Scene, Simulation, gradients

EVERY = 5
"""Steps between two actions."""
WEIGHTS = (-0.5, -0.3, 0.1)
SPREAD, SCATTER = 0.05, 0.01
"""Standard deviations of the weights, and of first velocities [m/s]."""


def tank() -> Simulation:
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
        )
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


def smoothed(loss: Any, shape: tuple[int, ...], pairs: int, seed: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the gradient of the smoothed loss with respect to the weights, and its standard error."""
    random, found = np.random.default_rng(seed), []
    changes = random.normal(0.0, SPREAD, (pairs, len(WEIGHTS)))
    for change in changes:
        scatter = jnp.asarray(random.normal(0.0, SCATTER, shape), dtype=jnp.float32)
        ends = [float(loss(jnp.array(WEIGHTS) + sign * change, scatter)) for sign in (1.0, -1.0)]
        found.append(0.5 * (ends[0] - ends[1]))
    gradient, *_ = np.linalg.lstsq(changes, np.array(found), rcond=None)
    rest = np.array(found) - changes @ gradient
    variance = (rest**2).sum() / (pairs - len(WEIGHTS))
    return gradient, np.sqrt(variance * np.diag(np.linalg.inv(changes.T @ changes)))


def main() -> None:
    """Print a row for each number of steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, nargs="+", default=[100, 200, 400, 800])
    parser.add_argument("--pairs", type=int, default=48, help="pairs of policies for the smoothed gradient")
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    simulation, weights = tank(), jnp.array(WEIGHTS)
    print("| steps | smoothed, its standard error | exact: cosine, size | `AdjointViscosity`: cosine, size |")
    for steps in asked.steps:
        still = jnp.zeros(simulation.positions.shape, dtype=jnp.float32)
        wanted, error = smoothed(jax.jit(loss_of(simulation, steps, None)), still.shape, asked.pairs, asked.seed)
        row = f"| {steps} | {np.round(wanted, 3).tolist()}, {np.round(error, 3).tolist()} |"
        for estimator in (None, gradients.AdjointViscosity()):
            own = np.array(jax.jit(jax.grad(loss_of(simulation, steps, estimator)))(weights, still), dtype=np.float64)
            size = np.linalg.norm(own) / np.linalg.norm(wanted)
            row += f" {own @ wanted / np.linalg.norm(own) / np.linalg.norm(wanted):.2f}, {size:.3g} |"
        print(row, flush=True)


if __name__ == "__main__":
    main()
