"""`carry`: a tank moves from one place to another in a given time, and its water shall be at rest afterwards.

After SoftGym's TransportWater (Lin et al. 2020), as seen from the tank: it feels its own acceleration as gravity. The
controls are accelerations in blocks of time, projected so that the tank always arrives, and stands.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from cortado import Problem, Scene, Simulation
from cortado.losses import Frames
from cortado.losses.loss import Adjoint, Snapshot
from cortado.optimisation.transforms import Affine
from cortado.scene.parameter_values import Arrays

from .task import GRAVITY, WATER, Controls, Score, Task, blocks_of, scene_of

FRAMES = 20
"""States on the way at which water above the rim is counted, and as many after the arrival."""
MODES = (1,)
"""Of the water, that the known solution leaves at rest; a moved tank excites odd ones alone."""
GREATEST = 3.0
"""How far an acceleration may be from the baseline's, in those of the baseline."""


@dataclass(frozen=True)
class Carry(Task):
    """Water of so many particles, moved over a distance by the first steps; for the others the tank stands."""

    name = "carry"
    spill: ClassVar[float] = 1.0
    """Weight of the water above the rim."""
    cells: tuple[int, int]
    spacing: float
    time_step: float
    distance: float
    moving: int
    standing: int
    blocks: int

    @classmethod
    def small(cls) -> Self:
        return cls((12, 12), 0.025, 0.004, 0.2, moving=150, standing=50, blocks=25)

    @classmethod
    def large(cls) -> Self:
        return cls((48, 24), 0.0125, 0.002, 0.6, moving=700, standing=300, blocks=50)

    @property
    def steps(self) -> int:
        return self.moving + self.standing

    @property
    def width(self) -> float:
        """[m]"""
        return self.cells[0] * self.spacing

    @property
    def depth(self) -> float:
        """[m]"""
        return self.cells[1] * self.spacing

    @property
    def rim(self) -> float:
        """Above it water is spilt [m]."""
        return 1.15 * self.depth

    @property
    def scene(self) -> Scene:
        return scene_of(
            "carry",
            self.spacing,
            self.time_step,
            {"shape": "box", "lower": [0.0, 0.0], "upper": [self.width, 1.8 * self.depth]},
            phase=[WATER],
            fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [self.width, self.depth], "phase": "water"}],
            render={"view": "plane", "resolution": [3 * self.cells[0], (27 * self.cells[1]) // 5]},
        )

    @cached_property
    def _arrival(self) -> np.ndarray:
        """(2, blocks) by which accelerations make the last velocity [m/s] and the distance [m]."""
        in_steps, dt = blocks_of(self.moving, self.blocks), self.time_step
        left = (self.moving - np.arange(self.moving)) * dt
        return np.stack([dt * in_steps.sum(axis=0), dt * left @ in_steps])

    @cached_property
    def _full_throttle(self) -> np.ndarray:
        """(blocks,) [m/s2]: one acceleration for the first half of the time, its opposite for the second."""
        signs = np.sign(0.5 * (self.blocks - 1) - np.arange(self.blocks))
        return self.distance / (self._arrival[1] @ signs) * signs

    @cached_property
    def accelerations(self) -> Affine:
        """(steps,) along x [m/s2], of which each brings the tank to rest where it shall be."""
        free = np.eye(self.blocks) - np.linalg.pinv(self._arrival) @ self._arrival
        greatest = GREATEST * np.abs(self._full_throttle).max()
        return Affine(self._along @ self._full_throttle, greatest * self._along @ free)

    @property
    def _along(self) -> np.ndarray:
        """(steps, blocks) which block a step is in, none while the tank stands."""
        along = np.zeros((self.steps, self.blocks))
        along[: self.moving] = blocks_of(self.moving, self.blocks)
        return along

    @property
    def controls(self) -> Controls:
        base, matrix = np.zeros((self.steps, 2)), np.zeros((self.steps, 2, self.blocks))
        base[:, 0], base[:, 1] = -self.accelerations.base, -GRAVITY
        matrix[:, 0] = -self.accelerations.matrix
        return Controls({"gravity": Affine(base, matrix)})

    @cached_property
    def known(self) -> np.ndarray:
        """By linear theory: of all accelerations that arrive, and leave the first waves at rest, the least ones."""
        k = np.array(MODES) * np.pi / self.width
        phases = np.outer(np.sqrt(GRAVITY * k * np.tanh(k * self.depth)), self.time_step * np.arange(self.moving))
        waves = np.concatenate([np.cos(phases), np.sin(phases)]) @ blocks_of(self.moving, self.blocks)
        constraints = np.concatenate([self._arrival, self.time_step * waves])
        wanted = np.concatenate([[0.0, self.distance], np.zeros(len(waves))])
        accelerations = np.linalg.lstsq(constraints, wanted, rcond=None)[0]
        return self.accelerations.coordinate(self._along @ accelerations)

    @property
    def frames(self) -> dict[int, "Slosh"]:
        """What is measured, by the number of steps before it."""
        moving = np.linspace(0, self.moving, FRAMES, endpoint=False).astype(int)[1:]
        standing = np.linspace(self.moving, self.steps, FRAMES + 1).astype(int)[1:]
        spill, energy = self.spill / (len(moving) + len(standing)), 1.0 / len(standing)
        on_the_way = {int(step): Slosh(self.depth, self.rim, 0.0, spill) for step in moving}
        return on_the_way | {int(step): Slosh(self.depth, self.rim, energy, spill) for step in standing}

    def loss(self, simulation: Simulation) -> Frames:
        return Frames(self.frames)

    def score(self, problem: Problem, parameters: Arrays) -> Score:
        states, frames = problem.states(parameters, self.frames), self.frames
        accelerations = -parameters["gravity"][: self.moving, 0]
        velocities = self.time_step * np.cumsum(accelerations)
        return {
            "distance [m]": abs(self.distance - self.time_step * velocities.sum()),
            "spilt": max(float((states[step].positions[:, 1] > self.rim).mean()) for step in frames),
            "slosh energy": sum(one.energy * one.kinetic(states[step]) for step, one in frames.items()),
        }


@dataclass(frozen=True)
class Slosh:
    """A part of the loss: twice the kinetic energy of the water over the work that lifts it by its depth, on average
    the whole energy of waves, and the mean squared height of water above the rim, over the depth."""

    depth: float
    rim: float
    energy: float
    """Weight of the energy."""
    spill: float
    """Weight of the water above the rim."""

    @property
    def fingerprint(self) -> str:
        return repr(self)

    def kinetic(self, end: Snapshot) -> float:
        return float((end.velocities**2).sum() / len(end.velocities) / (GRAVITY * self.depth))

    def value(self, end: Snapshot) -> float:
        return self.energy * self.kinetic(end) + self.spill * float((self._above(end) ** 2).mean())

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        n, x_bar = len(end.positions), np.zeros_like(end.positions)
        x_bar[:, 1] = 2.0 * self.spill / (n * self.depth) * self._above(end)
        return self.value(end), (x_bar, 2.0 * self.energy / (n * GRAVITY * self.depth) * end.velocities)

    def _above(self, end: Snapshot) -> np.ndarray:
        """(n,) height above the rim over the depth, 0 for water below."""
        return np.maximum(end.positions[:, 1] - self.rim, 0.0) / self.depth
