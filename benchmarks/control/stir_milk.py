"""`stir_milk`: a stick is drawn through coffee with a band of milk, seen from above, until it matches pictures.

As baristas etch: the actions say where the stick is sent, which follows with a lag, and the target is what a hidden
path of the stick leaves. Pictures are compared at many times, the last one at the end.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np

from cortado import Problem, Scene, Simulation, image_losses
from cortado.losses import Frames, Image
from cortado.optimisation.transforms import Affine
from cortado.scene.parameter_values import Arrays

from .task import COFFEE, MILK, Controls, NoLoss, Score, Task, scene_of

LAG = 0.08
"""Of the run: in so long the stick comes nearer to where it is sent, by a factor of e."""
VISCOSITY = 0.3
"""Of coffee and milk [Pa s]: thick enough for a line to stay where it is drawn."""
STICK = 2.0
"""Radius of the stick [spacings]."""
FRAMES = 10
"""Pictures that are compared."""


@dataclass(frozen=True)
class StirMilk(Task):
    """A square cup with so many particles along each side, full, without gravity in its plane."""

    name = "stir_milk"
    cells: int
    spacing: float
    """[m]"""
    time_step: float
    actions: int
    repeats: int
    """Steps that an action takes."""
    reach: float = 0.55
    """How far from the middle the stick can be sent along an axis, in half the width of the cup."""

    @classmethod
    def small(cls) -> Self:
        return cls(14, 0.004, 0.004, actions=125, repeats=2)

    @classmethod
    def large(cls) -> Self:
        return cls(60, 0.004 / 3.0, 0.0008, actions=100, repeats=12)

    @property
    def steps(self) -> int:
        return self.actions * self.repeats

    @property
    def scene(self) -> Scene:
        half = 0.5 * self.cells * self.spacing
        band = round(0.15 * self.cells) * self.spacing

        def box(phase: str, lower: float, upper: float) -> dict[str, Any]:
            return {"shape": "box", "lower": [-half, lower], "upper": [half, upper], "phase": phase}

        stick = {"name": "stick", "shape": "sphere", "centre": [0.0, 0.0], "radius": STICK * self.spacing}
        return scene_of(
            "stir_milk",
            self.spacing,
            self.time_step,
            {"shape": "box", "lower": [-half, -half], "upper": [half, half]},
            discretisation={"spacing": self.spacing},
            phase=[{**one, "viscosity": VISCOSITY} for one in (COFFEE, {**MILK, "rest_density": 1000.0})],
            fluid=[box("coffee", -half, -band), box("milk", -band, band), box("coffee", band, half)],
            solid=[{**stick, "motion": "path", "velocity": [0.0, 0.0]}],
            forces={"gravity": [0.0, 0.0]},
            solver={"kind": "projection", "time_step": self.time_step},
            render={"view": "plane", "resolution": [2 * self.cells, 2 * self.cells]},
        )

    @cached_property
    def controls(self) -> Controls:
        follow = 1.0 - np.exp(-1.0 / (LAG * self.actions))
        k, j = np.arange(self.actions)[:, None], np.arange(self.actions)
        response = np.where(j <= k, follow * (1.0 - follow) ** np.maximum(k - j, 0), 0.0)
        times = (np.arange(self.steps) + 1.0) / self.repeats
        hats = np.maximum(1.0 - np.abs(times[:, None] - 1.0 - j), 0.0)
        reach = self.reach * 0.5 * self.cells * self.spacing
        matrix = reach * np.einsum("sk,da->sdka", hats @ response, np.eye(2))
        return Controls({"stick.displacement": Affine(np.zeros((self.steps, 2)), matrix.reshape(self.steps, 2, -1))})

    @cached_property
    def known(self) -> np.ndarray:
        """The hidden path: a lying eight."""
        angle = 2.0 * np.pi * (np.arange(self.actions) + 1.0) / self.actions
        return np.stack([np.sin(angle), np.sin(2.0 * angle)], axis=1).ravel()

    def loss(self, simulation: Simulation) -> Frames:
        steps = np.linspace(0, self.steps, FRAMES + 1).astype(int)[1:].tolist()
        states = Problem(simulation, self.steps, NoLoss()).states(self.controls.parameters(self.known), steps)
        renderer, losses = simulation.renderer(), {}
        for step, state in states.items():
            target = renderer.render(state.state.positions, state.state.mass_fractions, state.colours)
            losses[step] = Image(renderer, target, image_losses.Pyramid())
        return Frames(losses)

    def score(self, problem: Problem, parameters: Arrays) -> Score:
        assert isinstance(problem.loss, Frames)
        last = problem.loss.losses[self.steps]
        assert isinstance(last, Image)
        return {"-PSNR [dB]": -image_losses.psnr(last.image(problem.end(parameters)), last.target)}
