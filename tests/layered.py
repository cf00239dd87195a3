"""What the tests of layers in PyTorch and in JAX share: a fluid that is sheared, and its problems."""

from typing import Any

import numpy as np

from cortado import Problem, Scene, Simulation, losses
from scenes import plane

STIFF = 20.0
"""Pa s: what a viscosity is given in units of, so that all derivatives are of a size."""


def sheared(**changes: Any) -> Scene:
    """8 x 8 particles of a viscous fluid that is pushed along the floor of a box, under a gravity with a schedule."""
    thick = [{"name": "water", "rest_density": 1000.0, "viscosity": STIFF}]
    return plane(phase=thick, **changes)


def scheduled() -> Scene:
    """Under a gravity that changes."""
    course = {"times": [0.0, 0.03, 0.06, 0.2], "values": [[0.0, -9.81], [4.0, -9.81], [-3.0, -7.0], [0.0, -9.81]]}
    return sheared(schedule={"gravity": course})


def shear(simulation: Simulation) -> np.ndarray:
    """(n, d) first velocities [m / s] that a viscosity slows."""
    found = np.zeros(simulation.positions.shape)
    found[:, 0] = 2.0 * simulation.positions[:, 1]
    return found


def matched(simulation: Simulation, steps: int = 12) -> Problem:
    """A problem that looks at all positions."""
    return Problem(simulation, steps, losses.FinalPositions(simulation.positions + 0.02))


POINT = {"gravity": [0.4, -9.0], "viscosity": 0.7 * STIFF}
