"""A dam breaks in a box that is shaken, until its water has the shape of the letter L.

The reward is the share of the water that is in the letter: in its foot along the floor, or in its stem, which stands at
a goal's place, each particle counted smoothly (`cortado.environments.terms.Share`).
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from cortado.environments.actuators import Actuator, Position
from cortado.environments.reward import Reward
from cortado.environments.task import WATER, Task
from cortado.environments.terms import Share
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

HALF = 0.3
"""Half of the width of the box [m]."""
GRAVITY, STRENGTH, LAG = 9.81, 12.0, 0.05
"""What the box is shaken with at most, besides gravity [m/s2], and how it follows [s]."""


class Splash(Task):
    """Actions: the acceleration of the box along x and y, which its water feels as gravity that leans, and grows. Goal:
    where the left side of the stem is."""

    name = "Splash"
    horizon, repeats = 40, 5
    coarse_spacing, coarse_step = HALF / 12, 0.003
    lowest = 0.0
    goal_names: ClassVar[tuple[str, ...]] = ("x of the stem [m]",)

    @property
    def scene(self) -> Scene:
        return self.scene_of(
            container={"shape": "box", "lower": [0.0, 0.0], "upper": [2.0 * HALF, 2.0 * HALF]},
            phase=[WATER],
            fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [HALF, HALF], "phase": "water"}],
            forces={"gravity": [0.0, -GRAVITY]},
        )

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        return (Position("gravity", (0.0, -GRAVITY), (0, 1), (-STRENGTH, -STRENGTH), lag=LAG),)

    @property
    def goals(self) -> tuple[NDArray, NDArray]:
        return np.array([0.0]), np.array([1.5 * HALF])

    def reward(self, simulation: Simulation) -> Reward:
        return Reward(((1.0, Share(Letter(), self.coarse_spacing)),))


@dataclass(frozen=True)
class Letter:
    """The boxes of the foot and of the stem, which have the area of the water."""

    def __call__(self, goal: NDArray) -> tuple[NDArray, NDArray]:
        lower, upper = np.zeros((len(goal), 2, 2)), np.zeros((len(goal), 2, 2))
        upper[:, 0] = [2.0 * HALF, 0.25 * HALF]
        lower[:, 1, 0], lower[:, 1, 1] = goal[:, 0], 0.25 * HALF
        upper[:, 1, 0], upper[:, 1, 1] = goal[:, 0] + 0.5 * HALF, 1.25 * HALF
        return lower, upper
