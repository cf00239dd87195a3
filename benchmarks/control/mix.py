"""`mix`: milk lies in a corner of a cup of coffee, and the cup is shaken until milk is everywhere.

After Mixing of FluidLab (Xian et al. 2023), which lowers minus the sum of distances between pairs of milk particles,
component by component, and stirs where here the cup is shaken.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from cortado import Problem, Scene, Simulation
from cortado.losses import Frames
from cortado.losses.loss import Adjoint, Snapshot
from cortado.scene.parameter_values import Arrays

from .task import COFFEE, GRAVITY, MILK, Controls, Score, Task, scene_of, shaken

STRENGTH = 6.0
"""Greatest acceleration of the cup along an axis [m/s2]."""
FRAMES = 10
"""States in the last quarter of the run, over which the distances are averaged."""


@dataclass(frozen=True)
class Mix(Task):
    """A cup of coffee of so many particles along each axis, upwards the second; milk fills the left half of the upper
    part."""

    name = "mix"
    cells: tuple[int, ...]
    milk: int
    """Height of the upper part, in particles."""
    width: float
    """[m]"""
    time_step: float
    blocks: int
    """Of time, in each of which the controls are constant."""
    repeats: int
    """Steps in a block."""

    @classmethod
    def small(cls) -> Self:
        return cls((16, 9), 4, 0.08, 0.002, blocks=25, repeats=8)

    @classmethod
    def large(cls) -> Self:
        return cls((20, 20, 20), 8, 0.08, 0.001, blocks=60, repeats=20)

    @property
    def steps(self) -> int:
        return self.blocks * self.repeats

    @property
    def spacing(self) -> float:
        """[m]"""
        return self.width / self.cells[0]

    @property
    def scene(self) -> Scene:
        upper = self.spacing * np.array(self.cells)
        border, half = upper[1] - self.milk * self.spacing, upper[0] / 2

        def box(phase: str, lower: list[float], *cut: tuple[int, float]) -> dict[str, Any]:
            corner = upper.copy()
            for axis, at in cut:
                corner[axis] = at
            lowest = [*lower, 0.0][: len(upper)]
            return {"shape": "box", "lower": lowest, "upper": corner.tolist(), "phase": phase}

        roof = upper.copy()
        roof[1] *= 1.8
        view: dict[str, Any] = {"view": "plane", "resolution": [64, 65]}
        if len(upper) == 3:
            middle = [upper[0] / 2, 0.45 * roof[1], upper[2] / 2]
            camera = [upper[0] / 2, 0.45 * roof[1], 5.0 * upper[0]]
            view = {"view": "volume", "resolution": [64, 96], "position": camera, "look_at": middle}
            view |= {"field_of_view": 24.0, "extinction": 8.0 / upper[2]}
        return scene_of(
            "mix",
            self.spacing,
            self.time_step,
            {"shape": "box", "lower": [0.0] * len(upper), "upper": roof.tolist()},
            phase=[COFFEE, MILK],
            fluid=[
                box("coffee", [0.0, 0.0], (1, border)),
                box("coffee", [half, border]),
                box("milk", [0.0, border], (0, half)),
            ],
            render=view,
        )

    @cached_property
    def controls(self) -> Controls:
        return shaken(self.steps, self.blocks, STRENGTH, len(self.cells), axes=len(self.cells))

    @property
    def known(self) -> np.ndarray:
        """The cup is shaken from side to side as fast as its first wave goes."""
        k = np.pi / self.width
        frequency = np.sqrt(GRAVITY * k * np.tanh(k * self.cells[1] * self.spacing))
        times = (np.arange(self.blocks) + 0.5) / self.blocks * self.steps * self.time_step
        u = np.zeros((self.blocks, len(self.cells)))
        u[:, 0] = np.sin(frequency * times)
        return u.ravel()

    def loss(self, simulation: Simulation) -> Frames:
        everywhere = spread(simulation.positions)
        milk = np.flatnonzero(simulation.mass_fractions[:, 1])
        steps = np.linspace(0.75 * self.steps, self.steps, FRAMES).astype(int)
        return Frames({int(step): Unmixed(milk, everywhere, 1.0 / FRAMES) for step in steps})

    def score(self, problem: Problem, parameters: Arrays) -> Score:
        end, simulation = problem.end(parameters), problem.simulation
        milk = np.flatnonzero(simulation.mass_fractions[:, 1])
        return {
            "unmixed at the end": Unmixed(milk, spread(simulation.positions), 1.0).value(end),
            "unlike neighbours missing": 1.0 - unlike_neighbours(end.positions, milk, 1.5 * self.spacing),
        }


def spread(x: np.ndarray) -> float:
    """The mean distance of all pairs of points (n, d), component by component: that of two is |dx| + |dy| + |dz|."""
    n = len(x)
    return float(2.0 * ((2.0 * np.arange(n) - n + 1.0) @ np.sort(x, axis=0)).sum() / n**2)


def unlike_neighbours(x: np.ndarray, milk: np.ndarray, reach: float) -> float:
    """How many of the neighbours of milk are coffee, over how many would be if milk were anywhere at random; positions
    (n, d), numbers of milk particles (m,)."""
    is_milk = np.zeros(len(x), dtype=bool)
    is_milk[milk] = True
    near = ((x[milk, None] - x) ** 2).sum(axis=2) < reach**2
    near[np.arange(len(milk)), milk] = False
    return float((near & ~is_milk).sum() / near.sum() / (1.0 - is_milk.mean()))


@dataclass(frozen=True, eq=False)
class Unmixed:
    """1 - how far the particles of milk are spread, over how far all particles were at the start, times a weight: 0
    where milk is everywhere alike."""

    milk: np.ndarray
    """(m,) numbers of its particles"""
    everywhere: float
    weight: float

    @property
    def fingerprint(self) -> str:
        return f"{len(self.milk)} {self.everywhere} {self.weight}"

    def value(self, end: Snapshot) -> float:
        return self.weight * (1.0 - spread(end.positions[self.milk]) / self.everywhere)

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        x, n = end.positions[self.milk], len(self.milk)
        ranks = np.argsort(np.argsort(x, axis=0), axis=0)
        bar = np.zeros_like(end.positions)
        bar[self.milk] = -2.0 * self.weight / (n**2 * self.everywhere) * (2.0 * ranks - n + 1.0)
        return self.value(end), (bar, np.zeros_like(bar))
