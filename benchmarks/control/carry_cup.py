"""`carry_cup`: as `carry`, but the cup itself moves, and water that is spilt is lost."""

from functools import cached_property
from typing import Self

import numpy as np

from cortado import Problem, Scene
from cortado.optimisation.transforms import Affine
from cortado.scene.parameter_values import Arrays

from .carry import Carry
from .task import WATER, Controls, Score, scene_of

WALL = 4.0
"""Thickness of the cup [spacings]."""


class CarryCup(Carry):
    """Water in a cup that goes from one place to another; nothing else holds it."""

    name = "carry_cup"
    spill = 10.0

    @classmethod
    def small(cls) -> Self:
        return cls((16, 10), 0.0125, 0.003, 0.4, moving=240, standing=60, blocks=240)

    @classmethod
    def large(cls) -> Self:
        return cls((48, 30), 0.0042, 0.001, 0.4, moving=800, standing=200, blocks=100)

    @property
    def scene(self) -> Scene:
        wall = WALL * self.spacing
        cup = {"name": "cup", "shape": "cup", "base": [0.5 * self.width, -wall], "radius": 0.5 * self.width}
        cup |= {"height": wall + 1.4 * self.depth, "thickness": wall, "motion": "path", "velocity": [0.0, 0.0]}
        reach = self.width + self.distance
        room = {"lower": [-2.0 * self.depth, -2.0 * self.depth], "upper": [reach + 2.0 * self.depth, 3.0 * self.depth]}
        return scene_of(
            "carry_cup",
            self.spacing,
            self.time_step,
            {"shape": "box", **room},
            discretisation={"spacing": self.spacing},
            phase=[WATER],
            fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [self.width, self.depth], "phase": "water"}],
            solid=[cup],
            solver={"kind": "projection", "time_step": self.time_step},
            render={"view": "plane", "resolution": [192, 96]},
        )

    @cached_property
    def controls(self) -> Controls:
        twice = self.time_step**2 * np.cumsum(np.cumsum(np.eye(self.steps), axis=0), axis=0)
        base, matrix = np.zeros((self.steps, 2)), np.zeros((self.steps, 2, self.blocks))
        base[:, 0] = twice @ self.accelerations.base
        matrix[:, 0] = twice @ self.accelerations.matrix
        return Controls({"cup.displacement": Affine(base, matrix)})

    def score(self, problem: Problem, parameters: Arrays) -> Score:
        states, frames, path = problem.states(parameters, self.frames), self.frames, parameters["cup.displacement"]
        end = states[self.steps].positions
        left, right = path[-1, 0], path[-1, 0] + self.width
        lost = (end[:, 1] < 0.0) | (end[:, 0] < left) | (end[:, 0] > right)
        return {
            "distance [m]": abs(self.distance - path[-1, 0]),
            "spilt": float(lost.mean()),
            "slosh energy": sum(one.energy * one.kinetic(states[step]) for step, one in frames.items()),
        }
