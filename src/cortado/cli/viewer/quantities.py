"""What particles of a state may be coloured by, each computed when it is asked for, and where a loss pulls them."""

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any

import numpy as np

from cortado.cli.viewer.window import PULL, Quantity
from cortado.errors import InputError
from cortado.gradients import Exact
from cortado.losses import CentreOfMassAlong, Loss, Snapshot
from cortado.losses.loss import ADJOINT_FIELDS, by_field
from cortado.rollout.rollout import Rollout
from cortado.scene.restart import RestartState
from cortado.scene.scene import Scene
from cortado.scene.stability import longest_step
from cortado.simulation import Simulation
from cortado.solvers.particles import ParticleSolver

UNITS = {"speed": "m/s", "density": "kg/m³", "pressure": "Pa", "vorticity": "1/s", "wall_force": "N"}
"""Of what every state has."""
HEIGHT_UNITS = {**UNITS, PULL: "m/m"}
"""The same, where the loss is the height of the centre of mass."""
AHEAD = 1.0 / 50.0
"""[s] from a state to the one whose height is the loss."""


def quantities_of(
    velocities: np.ndarray, simulation: Callable[[], Simulation], state: RestartState, controls: Mapping[str, Any]
) -> dict[str, Quantity]:
    """By name what is known of particles with velocities (n, d) [m/s] in a state, under ``controls`` as of
    `Simulation.run`. All but the speed raise `InputError` where the solver does not know them."""
    return {
        "speed": lambda: np.linalg.norm(velocities, axis=1),
        "density": lambda: densities(simulation().rollout(1, controls, state)),
        "pressure": lambda: simulation().quantity("pressure", state, controls),
        "vorticity": lambda: sizes_of(simulation().quantity("vorticity", state, controls)),
        "wall_force": lambda: sizes_of(simulation().quantity("wall_force", state, controls)),
    }


def own_fields(fields: Mapping[str, np.ndarray], particles: int) -> dict[str, Quantity]:
    """By name those of a state's further fields, such as ones that parts keep, that have a number or a vector for each
    particle."""
    own = {name: array for name, array in fields.items() if name not in ADJOINT_FIELDS and array.ndim in (1, 2)}
    return {name: partial(sizes_of, array) for name, array in own.items() if len(array) == particles}


def sizes_of(values: np.ndarray) -> np.ndarray:
    """(n,) numbers as they are, or the lengths of vectors (n, k)."""
    return values if values.ndim == 1 else np.linalg.norm(values, axis=-1)


def densities(rollout: Rollout) -> np.ndarray:
    """(n,) of the first state of a rollout [kg/m3]."""
    solver = rollout.solver
    if not isinstance(solver, ParticleSolver):
        raise InputError("The solver of this scene has no densities of particles to show.")
    return solver.densities(rollout.initial, rollout.parameters)


def pull_on_height(
    simulation: Callable[[], Simulation], state: RestartState, controls: Mapping[str, Any]
) -> Callable[[], np.ndarray]:
    """Computes, once, the pull (n, d) [m/m] of a loss that is the height of the centre of mass `AHEAD` of a state."""

    @cache
    def pull() -> np.ndarray:
        made = simulation()
        steps = max(round(AHEAD / longest_step(made.scene)), 1)
        loss = CentreOfMassAlong(upwards(made.scene), state["reference_density"])
        return pull_of(made, made.rollout(steps, controls, state), loss)

    return pull


def pull_of(simulation: Simulation, rollout: Rollout, loss: Loss) -> np.ndarray:
    """(n, d) minus the exact derivative of a loss of a rollout's last state with respect to its first positions."""
    colours = np.array([phase.colour for phase in simulation.scene.phase])
    end = Snapshot(rollout.forward().copy(), simulation.dimension, colours)
    bar = simulation.solver.new_state()
    bar.set(by_field(loss.value_and_adjoint(end)[1], simulation.dimension))
    first = rollout.backward(Exact().derivative(rollout), {rollout.steps: bar})
    return -first.numpy(simulation.dimension, only=["positions"])["positions"].astype(np.float64)


def upwards(scene: Scene) -> np.ndarray:
    """(d,) against the scene's gravity; along y where there is none."""
    gravity = np.asarray(scene.forces.gravity, dtype=np.float64)
    size = float(np.linalg.norm(gravity))
    return -gravity / size if size else np.eye(len(gravity))[1]
