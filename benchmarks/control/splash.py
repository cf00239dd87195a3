"""`splash`: a dam breaks, and its box is shaken so that the last picture of the water is the letter L."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from cortado import Problem, Scene, Simulation, image_losses
from cortado.losses import Image
from cortado.scene.parameter_values import Arrays

from .task import WATER, Controls, NoLoss, Score, Task, scene_of, shaken

STRENGTH = 12.0
"""Greatest acceleration of the box along an axis [m/s2]."""


@dataclass(frozen=True)
class Splash(Task):
    """A square column of so many particles, in a box twice as wide and as high; of some layers, none in the plane."""

    name = "splash"
    cells: int
    """A multiple of 4, so that the letter has the area of the column."""
    layers: int
    width: float
    """Of the box [m]."""
    time_step: float
    blocks: int
    """Of time, in each of which the controls are constant."""
    repeats: int
    """Steps in a block."""

    @classmethod
    def small(cls) -> Self:
        return cls(12, 0, 0.6, 0.003, blocks=25, repeats=8)

    @classmethod
    def large(cls) -> Self:
        return cls(32, 8, 0.6, 0.001, blocks=50, repeats=20)

    @property
    def steps(self) -> int:
        return self.blocks * self.repeats

    @property
    def dimension(self) -> int:
        return 3 if self.layers else 2

    @property
    def scene(self) -> Scene:
        return self._scene([((0.0, 0.0), (1.0, 1.0))])

    def _scene(self, boxes: list[tuple[tuple[float, float], tuple[float, float]]]) -> Scene:
        """With water in boxes, lower and upper corners in half the width of the container."""
        half, spacing = 0.5 * self.width, 0.5 * self.width / self.cells
        depth = [self.layers * spacing] if self.layers else []
        fluid = [
            {
                "shape": "box",
                "lower": [half * x for x in lower] + [0.0 for _ in depth],
                "upper": [half * x for x in upper] + depth,
                "phase": "water",
            }
            for lower, upper in boxes
        ]
        container = {"shape": "box", "lower": [0.0] * self.dimension, "upper": [self.width, self.width, *depth]}
        tables = {"phase": [WATER], "fluid": fluid, "render": self._view(depth)}
        return scene_of("splash", spacing, self.time_step, container, **tables, **self._solved(spacing))

    def _solved(self, spacing: float) -> dict[str, Any]:
        """What the scene has instead of the solver and the kernel of all tasks."""
        return {}

    def _view(self, depth: list[float]) -> dict[str, Any]:
        """From the front."""
        if not depth:
            return {"view": "plane", "resolution": [36, 36]}
        middle = [0.5 * self.width, 0.5 * self.width]
        return {
            "view": "volume",
            "resolution": [64, 64],
            "position": [*middle, 4.0 * self.width],
            "look_at": [*middle, depth[0]],
            "field_of_view": 15.5,
            "extinction": 4.0 / depth[0],
        }

    @property
    def letter(self) -> Scene:
        """Water that is the letter: a foot along the floor, and a stem at the wall."""
        return self._scene([((0.0, 0.0), (2.0, 0.25)), ((0.0, 0.25), (0.5, 1.25))])

    @cached_property
    def controls(self) -> Controls:
        return shaken(self.steps, self.blocks, STRENGTH, self.dimension, axes=2)

    @property
    def known(self) -> np.ndarray:
        """The box is jerked so that its water goes to the right first, and up the left wall at the end."""
        u = np.zeros((self.blocks, 2))
        u[:, 0] = np.where(np.arange(self.blocks) < self.blocks // 2, 0.3, -0.5)
        return u.ravel()

    def loss(self, simulation: Simulation) -> Image:
        written = Simulation(self.letter, simulation.device.alias, simulation.precision.name)
        end = Problem(written, 0, NoLoss()).end({})
        target = written.renderer().render(end.state.positions, end.state.mass_fractions, end.colours)
        return Image(simulation.renderer(), target, image_losses.Pyramid())

    def score(self, problem: Problem, parameters: Arrays) -> Score:
        end = problem.end(parameters)
        assert isinstance(problem.loss, Image)
        return {"-PSNR [dB]": -image_losses.psnr(problem.loss.image(end), problem.loss.target)}


class SplashProjection(Splash):
    """The same by the projection, with that solver's own kernel."""

    name = "splash_projection"

    def _solved(self, spacing: float) -> dict[str, Any]:
        solver = {"kind": "projection", "time_step": self.time_step}
        return {"discretisation": {"spacing": spacing}, "solver": solver}
