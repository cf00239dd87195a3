"""`pour_jug`: a jug turns and moves, and its water shall be in a glass.

After PourWater of SoftGym (Lin et al. 2020). The controls, in blocks of time, are by how much faster or slower than
steadily the jug turns, and how fast it moves sideways.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from cortado import Problem, Scene, Simulation
from cortado.losses import Frames
from cortado.losses.loss import Adjoint, Snapshot
from cortado.optimisation.transforms import Affine
from cortado.scene.parameter_values import Arrays

from .task import WATER, Controls, Score, Task, blocks_of, scene_of

WALL = 4.0
"""Thickness of the jug and of the glass [spacings]."""
VISCOSITY = 0.3
"""Thick enough not to splash out of the glass [Pa s]."""
FRAMES = 5
"""States, from when most of the water falls to the end of the run, in which it is looked for."""
FIRST = 0.64
"""That of them which comes first, over the run."""


@dataclass(frozen=True)
class PourJug(Task):
    """Lengths in spacings, but for the spacing [m]."""

    name = "pour_jug"
    spacing: float
    time_step: float
    turning: int
    """Steps."""
    blocks: int
    jug: tuple[int, int] = (12, 12)
    """Width and depth of its water."""
    turn: float = 2.4
    """By which the jug is turned, clockwise, if nothing is searched [rad]; at most twice as fast, and not back."""
    aside: float = 3.3
    """How far the jug could move, in widths of its water."""

    @classmethod
    def small(cls) -> Self:
        return cls(0.0125, 0.0022, 550, blocks=110)

    @classmethod
    def large(cls) -> Self:
        return cls(0.005, 0.0011, 1100, blocks=50, jug=(36, 36))

    @property
    def steps(self) -> int:
        return self.turning

    @cached_property
    def glass(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of what is inside of it, (2,) each [m]."""
        width, depth = self.spacing * np.array(self.jug)
        left = 1.7 * width
        return np.array([left, -1.9 * depth]), np.array([left + 1.3 * width, -0.8 * depth])

    @property
    def scene(self) -> Scene:
        width, depth = (float(size) for size in self.spacing * np.array(self.jug))
        (lower, upper), wall = self.glass, WALL * self.spacing
        cup = {"shape": "cup", "thickness": wall}
        jug = {"base": [0.5 * width, -wall], "radius": 0.5 * width, "height": wall + 1.3 * depth}
        glass: dict[str, Any] = {"base": [float(0.5 * (lower[0] + upper[0])), float(lower[1]) - wall]}
        glass |= {"radius": float(0.5 * (upper[0] - lower[0])), "height": wall + float(upper[1] - lower[1])}
        floor = float(lower[1]) - wall
        return scene_of(
            "pour_jug",
            self.spacing,
            self.time_step,
            {"shape": "box", "lower": [-1.0 * width, floor], "upper": [3.8 * width, 2.0 * depth]},
            discretisation={"spacing": self.spacing},
            phase=[{**WATER, "viscosity": VISCOSITY}],
            fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [width, depth], "phase": "water"}],
            solid=[
                {**cup, **jug, "name": "jug", "motion": "path", "angular_velocity": 0.0},
                {**cup, **glass, "name": "glass"},
            ],
            solver={"kind": "projection", "time_step": self.time_step},
            render={"view": "plane", "resolution": [192, 192]},
        )

    @cached_property
    def controls(self) -> Controls:
        steadily = -self.turn * np.arange(1, self.steps + 1) / self.steps
        so_far = np.cumsum(blocks_of(self.steps, self.blocks), axis=0) / self.steps
        reach = self.aside * self.jug[0] * self.spacing
        aside = reach * np.einsum("sb,d->sdb", so_far, [1.0, 0.0])
        turn = Affine(steadily, -self.turn * so_far)
        return Controls({"jug.turn": turn, "jug.displacement": Affine(np.zeros((self.steps, 2)), aside)})

    @property
    def known(self) -> np.ndarray:
        """What a search found, smoothed: turned faster at first, and moved to over the glass meanwhile."""
        times = (np.arange(self.blocks) + 0.5) / self.blocks
        faster = np.interp(times, [0.4, 0.7], [0.8, 0.0])
        aside = np.interp(times, [0.0, 0.1, 0.3, 0.42, 0.8], [0.55, 0.25, 0.32, 0.7, 0.0])
        return np.concatenate([faster, aside])

    def loss(self, simulation: Simulation) -> Frames:
        at = np.linspace(self.steps, FIRST * self.steps, FRAMES).astype(int)
        return Frames({int(step): Outside(*self.glass, 1.0 / FRAMES) for step in at})

    def score(self, problem: Problem, parameters: Arrays) -> Score:
        lower, upper = self.glass
        end = problem.end(parameters).positions
        return {"outside": 1.0 - float(((end > lower) & (end < upper)).all(axis=1).mean())}


@dataclass(frozen=True)
class Outside:
    """Mean squared distance of the water to the inside of a glass, over its squared width."""

    lower: np.ndarray
    upper: np.ndarray
    weight: float

    @property
    def fingerprint(self) -> str:
        return repr(self)

    def value(self, end: Snapshot) -> float:
        return self.weight * float((self._apart(end) ** 2).sum(axis=1).mean())

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        bar = 2.0 * self.weight / (len(end.positions) * self._width) * self._apart(end)
        return self.value(end), (bar, np.zeros_like(end.velocities))

    @property
    def _width(self) -> float:
        return float(self.upper[0] - self.lower[0])

    def _apart(self, end: Snapshot) -> np.ndarray:
        """(n, 2) from the nearest point of the inside, over the width."""
        x = end.positions
        return (x - np.clip(x, self.lower, self.upper)) / self._width
