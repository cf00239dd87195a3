"""A paddle makes waves that bring a raft to a place, and keep it level.

The reward is -(x - x*)^2 / l^2 - 2 (1 - cos angle), with the goal x* and the length l of the raft.
"""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from cortado.environments.actuators import Actuator, Position
from cortado.environments.reward import Reward
from cortado.environments.task import WATER, Task
from cortado.environments.terms import Pose
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

LENGTH = 0.25
"""Of the raft [m]."""
REACH, LAG = 0.05, 0.1
"""How far the paddle can be sent [m], and how it follows [s]."""


class Raft(Task):
    """Actions: where the paddle is sent to, along x. Goal: where the middle of the raft shall be."""

    name = "Raft"
    horizon, repeats = 40, 8
    coarse_spacing, coarse_step = 0.025, 0.003
    lowest = -15.0
    free_solids: ClassVar[tuple[str, ...]] = ("raft",)
    goal_names: ClassVar[tuple[str, ...]] = ("x of the raft [m]",)

    @property
    def scene(self) -> Scene:
        paddle = {"name": "paddle", "shape": "box", "lower": [0.06, -0.1], "upper": [0.16, 0.4]}
        raft = {"name": "raft", "shape": "box", "lower": [0.36, 0.15], "upper": [0.36 + LENGTH, 0.25]}
        return self.scene_of(
            container={"shape": "box", "lower": [-0.2, 0.0], "upper": [0.96, 0.5]},
            phase=[{**WATER, "viscosity": 0.1}],
            fluid=[{"shape": "box", "lower": [0.16, 0.0], "upper": [0.96, 0.2], "phase": "water"}],
            solid=[
                {**paddle, "motion": "path", "velocity": [0.0, 0.0], "colour": [0.6, 0.6, 0.65]},
                {**raft, "motion": "free", "density": 500.0, "colour": [0.6, 0.4, 0.2]},
            ],
        )

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        return (Position("paddle.displacement", (0.0, 0.0), (0,), (REACH,), lag=LAG),)

    @property
    def goals(self) -> tuple[NDArray, NDArray]:
        return np.array([0.45]), np.array([0.6])

    def reward(self, simulation: Simulation) -> Reward:
        return Reward(((-1.0, Pose("raft", LENGTH)),))
