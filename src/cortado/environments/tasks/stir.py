"""Milk lies in a corner of a cup of coffee, and a spoon stirs until it is everywhere.

After Mixing of FluidLab (Xian et al. 2023), with its reward but for scale: the mean distance of all pairs of milk
particles, component by component, over that of all particles at the start, less 1.
"""

import numpy as np
from numpy.typing import NDArray

from cortado.environments.actuators import Actuator, Position
from cortado.environments.reward import Reward
from cortado.environments.task import COFFEE, MILK, Task
from cortado.environments.terms import Spread
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

WIDTH, DEPTH, MILKY = 0.08, 0.045, 0.02
"""Of the cup, of what is in it, and of the part whose left half is milk [m]."""
SPOON, RADIUS, REACH, LAG = (0.04, 0.0225), 0.01, (0.018, 0.005), 0.1
"""Where the spoon begins, its radius, how far it can be sent [m], and how it follows [s]."""


class Stir(Task):
    """Actions: where the spoon, a disc in the plane, is sent to."""

    name = "Stir"
    horizon, repeats = 50, 16
    coarse_spacing, coarse_step = 0.005, 0.001
    lowest = -1.0

    @property
    def scene(self) -> Scene:
        border, half = DEPTH - MILKY, 0.5 * WIDTH
        coffee, milk = {"shape": "box", "phase": "coffee"}, {"shape": "box", "phase": "milk"}
        spoon = {"name": "spoon", "shape": "sphere", "centre": SPOON, "radius": RADIUS, "slip": "no"}
        return self.scene_of(
            container={"shape": "box", "lower": [0.0, 0.0], "upper": [WIDTH, 1.8 * DEPTH]},
            phase=[COFFEE, MILK],
            fluid=[
                {**coffee, "lower": [0.0, 0.0], "upper": [WIDTH, border]},
                {**coffee, "lower": [half, border], "upper": [WIDTH, DEPTH]},
                {**milk, "lower": [0.0, border], "upper": [half, DEPTH]},
            ],
            solid=[{**spoon, "motion": "path", "velocity": [0.0, 0.0], "colour": [0.6, 0.6, 0.65]}],
        )

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        return (Position("spoon.displacement", (0.0, 0.0), (0, 1), REACH, lag=LAG),)

    def reward(self, simulation: Simulation) -> Reward:
        milk = np.flatnonzero(simulation.mass_fractions[:, 1])
        return Reward(((1.0, Spread(milk, _spread(simulation.positions))),), constant=-1.0)


def _spread(x: NDArray) -> float:
    """The mean distance of all pairs of points (n, d), component by component [m]."""
    n = len(x)
    return float(2.0 * ((2.0 * np.arange(n) - n + 1.0) @ np.sort(x, axis=0)).sum() / n**2)
