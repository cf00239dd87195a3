"""`steer_raft`: a paddle makes waves, which shall bring a raft to a place, level and at a given time.

The controls are the amplitudes of the waves of which the paddle's path is made; it begins at rest. Nothing else moves
the raft, and its pose at the end alone is judged.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from cortado import Problem, Scene, Simulation
from cortado.losses import SolidPose
from cortado.optimisation.transforms import Affine
from cortado.scene.parameter_values import Arrays

from .task import WATER, Controls, Score, Task, scene_of

POOL, WALL, ROOF = 0.8, 0.1, 0.5
"""Length of the water, thickness of the paddle and height of the container [m]."""
DEPTH = 0.2
"""Of the water [m]."""
RAFT = (0.25, 0.1)
"""Its length and height [m]; it is half as dense as water, so that its middle is at the surface."""
BEGIN, WANTED = 0.325, 0.46
"""How far the middle of the raft is from the paddle at first, and where it shall be at the end [m]."""
VISCOSITY = 0.1
"""[Pa s]"""
KNOWN = (0.9, 1.0, 1.0, 0.9, 0.7, 0.7, 0.5, 0.5, 0.7, 0.7)
"""What a search found, rounded."""


@dataclass(frozen=True)
class SteerRaft(Task):
    """A raft in the plane, and a paddle that goes along a path of so many waves."""

    name = "steer_raft"
    spacing: float
    """[m]"""
    time_step: float
    moving: int
    """Steps."""
    modes: int
    amplitude: float = 0.04
    """Of the longest wave [m]; that of k half periods is 1 / k of it."""

    @classmethod
    def small(cls) -> Self:
        return cls(0.025, 0.003, 320, modes=10)

    @classmethod
    def large(cls) -> Self:
        return cls(0.0125, 0.00096, 1000, modes=60)

    @property
    def steps(self) -> int:
        return self.moving

    @property
    def scene(self) -> Scene:
        middle = np.array([BEGIN, DEPTH])
        lower, upper = ((middle + sign * 0.5 * np.array(RAFT)).tolist() for sign in (-1.0, 1.0))
        paddle = {"name": "paddle", "shape": "box", "lower": [-WALL, -WALL], "upper": [0.0, ROOF - WALL]}
        raft = {"name": "raft", "shape": "box", "lower": lower, "upper": upper, "motion": "free", "density": 500.0}
        return scene_of(
            "steer_raft",
            self.spacing,
            self.time_step,
            {"shape": "box", "lower": [-0.36, 0.0], "upper": [POOL, ROOF]},
            discretisation={"spacing": self.spacing},
            phase=[{**WATER, "viscosity": VISCOSITY}],
            fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [POOL, DEPTH], "phase": "water"}],
            solid=[{**paddle, "motion": "path", "velocity": [0.0, 0.0]}, raft],
            solver={"kind": "projection", "time_step": self.time_step},
            render={"view": "plane", "resolution": [232, 100]},
        )

    @cached_property
    def controls(self) -> Controls:
        """Waves along x, (1 - cos(pi k t / T)) / k of the amplitude."""
        k = np.arange(1, self.modes + 1)
        waves = (1.0 - np.cos(np.pi * np.arange(1, self.steps + 1)[:, None] / self.steps * k)) / k
        matrix = np.einsum("sk,d->sdk", self.amplitude * waves, [1.0, 0.0])
        return Controls({"paddle.displacement": Affine(np.zeros((self.steps, 2)), matrix)})

    @property
    def known(self) -> np.ndarray:
        return np.concatenate([KNOWN, np.zeros(self.modes - len(KNOWN))])

    def loss(self, simulation: Simulation) -> SolidPose:
        return SolidPose("raft", [WANTED, DEPTH], 0.0, length=RAFT[1])

    def score(self, problem: Problem, parameters: Arrays) -> Score:
        return {"off its pose [m]": float(np.sqrt(problem.value(parameters)))}
