"""`latte` and `latte_dense`: milk flows from a nozzle into coffee, which shall look as if a hidden path had been drawn.

After LatteArt of FluidLab (Xian et al. 2023): the actions say where the nozzle goes, and when they end the cup stands
for a while. `latte` compares the last pictures; `latte_dense` has FluidLab's loss, the squared distance of each
particle of milk from where it is under the hidden path, at many times.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from typing import Any, Self

import numpy as np

from cortado import Problem, Scene, Simulation, image_losses
from cortado.losses import Frames, Image, Loss
from cortado.losses.loss import Adjoint, Snapshot
from cortado.optimisation.transforms import Affine
from cortado.scene.parameter_values import Arrays

from .task import COFFEE, MILK, Controls, NoLoss, Score, Task, scene_of

LAG = 0.08
"""Of the pouring: in so long the nozzle comes nearer to where it is sent, by a factor of e."""
REACH = 0.6
"""How far from the middle the nozzle can be sent along an axis, in radii of the cup."""
VISCOSITY = 0.3
"""Of coffee and milk [Pa s]: thick enough for a line of milk to stay where it is poured."""
CIRCLE = 0.5
"""Radius of the path where searches begin, over the reach."""
FRAMES = 20
"""States that the dense loss looks at."""


@dataclass(frozen=True)
class Latte(Task):
    """A cup of a radius of so many particles, coffee of so many layers, and a nozzle that pours while there are
    actions; a cup in the plane, with the area of the opening a length, where ``dimension`` is 2."""

    name = "latte"
    dimension: int
    radius: int
    layers: int
    opening: int
    """Radius of the nozzle, in spacings."""
    column: int
    """Milk, in spacings of its column above the nozzle."""
    spacing: float
    time_step: float
    actions: int
    repeats: int
    """Steps that an action takes."""
    standing: int
    """Steps after the last action."""

    @classmethod
    def small(cls) -> Self:
        return cls(2, 12, 6, 1, 25, 0.0025, 0.0014, actions=25, repeats=6, standing=50)

    @classmethod
    def large(cls) -> Self:
        return cls(3, 17, 9, 1, 60, 0.0021, 0.0012, actions=250, repeats=4, standing=320)

    @property
    def steps(self) -> int:
        return self.actions * self.repeats + self.standing

    @property
    def cup(self) -> float:
        """Radius [m]."""
        return self.radius * self.spacing

    @property
    def speed(self) -> float:
        """Of the milk in the nozzle [m/s]: all of it has come out after the last action."""
        return self.column * self.spacing / (self.actions * self.repeats * self.time_step)

    @property
    def outlet(self) -> np.ndarray:
        """(d,) the opening in the middle of the cup, two spacings above the coffee [m]."""
        return np.array([0.0, (self.layers + 2) * self.spacing, 0.0])[: self.dimension]

    @property
    def scene(self) -> Scene:
        coffee, height = self.layers * self.spacing, 2.5 * self.layers * self.spacing
        radius, area = self.opening * self.spacing, self.spacing ** (self.dimension - 1)
        cup: dict[str, Any]
        pool: dict[str, Any]
        if self.dimension == 2:
            cup = {"shape": "box", "lower": [-self.cup, 0.0], "upper": [self.cup, height]}
            pool = {"shape": "box", "lower": [-self.cup, 0.0], "upper": [self.cup, coffee]}
            render = {"view": "plane", "resolution": [48, 30]}
        else:
            base = [0.0, 0.0, 0.0]
            cup = {"shape": "cylinder", "base": base, "radius": self.cup, "height": height}
            pool = {"shape": "cylinder", "base": base, "radius": self.cup, "height": coffee}
            render = {"view": "top", "resolution": [64, 64]}

        def poured(flow_rate: float) -> Scene:
            jet = {"phase": "milk", "outlet": self.outlet, "radius": radius, "length": self.column * self.spacing}
            return scene_of(
                self.name,
                self.spacing,
                self.time_step,
                cup,
                phase=[{**one, "viscosity": VISCOSITY} for one in (COFFEE, MILK)],
                fluid=[{**pool, "phase": "coffee"}],
                emitter=[{**jet, "flow_rate": flow_rate}],
                render=render,
            )

        (emitter,) = poured(area).emitter
        return poured(area * self.speed / emitter.speed(self.spacing))

    @cached_property
    def controls(self) -> Controls:
        axes = [0, 2][: self.dimension - 1]
        follow = 1.0 - np.exp(-1.0 / (LAG * self.actions))
        k, j = np.arange(self.actions)[:, None], np.arange(self.actions)
        response = np.where(j <= k, follow * (1.0 - follow) ** np.maximum(k - j, 0), 0.0)
        # The nozzle moves evenly from where it was at the end of one action to where it is at that of the next.
        times = np.minimum((np.arange(self.steps) + 1.0) / self.repeats, self.actions)
        hats = np.maximum(1.0 - np.abs(times[:, None] - 1.0 - j), 0.0)
        matrix = REACH * self.cup * np.einsum("sk,da->sdka", hats @ response, np.eye(self.dimension)[:, axes])
        base = np.tile(self.outlet, (self.steps, 1))
        return Controls({"nozzle.path": Affine(base, matrix.reshape(self.steps, self.dimension, -1))})

    @cached_property
    def baseline(self) -> np.ndarray:
        """A circle, in the plane its breadth alone: milk that falls on one point says nothing of where it should go."""
        return CIRCLE * np.stack([np.sin(self._angle), -np.cos(self._angle)][: self.dimension - 1], axis=1).ravel()

    @property
    def _angle(self) -> np.ndarray:
        """(actions,) once around."""
        return 2.0 * np.pi * np.arange(self.actions) / self.actions

    @cached_property
    def known(self) -> np.ndarray:
        """The hidden path: the outline of a heart, in the plane its breadth alone."""
        angle = self._angle
        height = (13 * np.cos(angle) - 5 * np.cos(2 * angle) - 2 * np.cos(3 * angle) - np.cos(4 * angle)) / 17
        return np.stack([np.sin(angle) ** 3, -height][: self.dimension - 1], axis=1).ravel()

    def loss(self, simulation: Simulation) -> Loss | Frames:
        renderer = simulation.renderer()
        end = self._hidden(simulation, [self.steps])[self.steps]
        target = renderer.render(end.state.positions, end.state.mass_fractions, end.colours)
        return Image(renderer, target, image_losses.Pyramid())

    def score(self, problem: Problem, parameters: Arrays) -> Score:
        end = problem.end(parameters)
        image = Latte.loss(self, problem.simulation)
        assert isinstance(image, Image)
        milk = self.milk_distances(problem.simulation)[self.steps]
        return {
            "-PSNR [dB]": -image_losses.psnr(image.image(end), image.target),
            "milk from its place [m]": float(np.sqrt(milk.value(end))),
        }

    def milk_distances(self, simulation: Simulation) -> dict[int, "MilkDistance"]:
        """FluidLab's loss at some steps, by their number."""
        steps = np.linspace(0, self.steps, FRAMES + 1).astype(int)[1:].tolist()
        states = self._hidden(simulation, steps)
        (emitter,) = simulation.scene.emitter
        upstream, n = emitter.sample(self.spacing).upstream, simulation.particles
        return {
            step: MilkDistance(
                np.arange(n - len(upstream), n)[upstream < self.speed * step * self.time_step],
                states[step].positions,
            )
            for step in steps
        }

    def _hidden(self, simulation: Simulation, steps: Iterable[int]) -> dict[int, Snapshot]:
        """States under the hidden path."""
        problem = Problem(simulation, self.steps, NoLoss())
        return problem.states(self.controls.parameters(self.known), steps)


@dataclass(frozen=True)
class LatteDense(Latte):
    """The same with the squared distances of all milk that has been poured, at many times."""

    name = "latte_dense"

    def loss(self, simulation: Simulation) -> Frames:
        return Frames(self.milk_distances(simulation))


class MilkDistance:
    """The mean squared distance of some particles from where they are in another run [m2], over the number of
    frames."""

    def __init__(self, particles: np.ndarray, target: np.ndarray):
        """``particles`` (m,) by number; ``target`` (n, d) of all [m]."""
        self.particles, self.target = particles, target
        self.fingerprint = sha256(particles.tobytes() + target.tobytes()).hexdigest()

    def value(self, end: Snapshot) -> float:
        return float((self._away(end) ** 2).sum() / max(len(self.particles), 1))

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        bar = np.zeros_like(end.positions)
        bar[self.particles] = 2.0 / max(len(self.particles), 1) * self._away(end)
        return self.value(end), (bar, np.zeros_like(bar))

    def _away(self, end: Snapshot) -> np.ndarray:
        """(m, d)"""
        return end.positions[self.particles] - self.target[self.particles]
