"""The controls of the leaderboard, with respect to which gradients are taken: a new one is an entry in `CONTROLS`.

Every control is linear in its coordinates: a parameter of the problem is ``weights @ u``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Protocol

import numpy as np

from cortado import Simulation
from cortado.optimisation.transforms import Bijector, TimeInterpolation

SCATTER = 2.0
"""Standard deviation of what is drawn about the middle of a control, in spreads."""


class Control(Protocol):
    """One parameter of the problem, as a function of coordinates u."""

    @property
    def parameter(self) -> str:
        """Its name in `cortado.Problem`."""

    def fits(self, simulation: Simulation) -> bool:
        """Whether the scene can be controlled so."""

    def spread(self, simulation: Simulation) -> float:
        """The width of the ensemble over which the true gradient is averaged, in units of the parameter."""

    def bijector(self, simulation: Simulation, steps: int) -> Bijector:
        """From coordinates to the parameter."""

    def drawn(self, simulation: Simulation, steps: int, random: np.random.Generator) -> np.ndarray:
        """Coordinates about the scene's own, at random."""


@dataclass(frozen=True, eq=False)
class Linear:
    """p = weights @ u, row by row of the parameter."""

    weights: np.ndarray
    """(rows of p, rows of u)"""

    def parameter(self, u: np.ndarray) -> np.ndarray:
        return self.weights @ u

    def coordinate(self, parameter: np.ndarray) -> np.ndarray:
        return np.linalg.lstsq(self.weights, parameter, rcond=None)[0]

    def adjoint(self, u: np.ndarray, bar: np.ndarray) -> np.ndarray:
        return self.weights.T @ bar


class Identity:
    """p = u."""

    def parameter(self, u: np.ndarray) -> np.ndarray:
        return u

    coordinate = parameter

    def adjoint(self, u: np.ndarray, bar: np.ndarray) -> np.ndarray:
        return bar


@dataclass(frozen=True)
class GravityBlocks:
    """Gravity, constant in equal blocks of time: u (blocks, d) [m/s2]."""

    blocks: int
    parameter: str = "gravity"

    def fits(self, simulation: Simulation) -> bool:
        return True

    def spread(self, simulation: Simulation) -> float:
        return 0.5

    def bijector(self, simulation: Simulation, steps: int) -> Bijector:
        block = np.arange(steps) * self.blocks // steps
        return Linear(np.eye(self.blocks)[block])

    def drawn(self, simulation: Simulation, steps: int, random: np.random.Generator) -> np.ndarray:
        noise = random.standard_normal((self.blocks, simulation.dimension))
        return np.asarray(simulation.scene.forces.gravity) + SCATTER * self.spread(simulation) * noise


@dataclass(frozen=True)
class GravityEachStep(GravityBlocks):
    """Gravity of each step: u (steps, d) [m/s2]. What is drawn is constant in blocks."""

    blocks: int = 4

    def bijector(self, simulation: Simulation, steps: int) -> Bijector:
        return Identity()

    def drawn(self, simulation: Simulation, steps: int, random: np.random.Generator) -> np.ndarray:
        return super().bijector(simulation, steps).parameter(super().drawn(simulation, steps, random))


@dataclass(frozen=True)
class VelocityModes:
    """First velocities as a sum of cosines of at most half a wave along each axis of the fluid: u (2^d, d) [m/s]."""

    parameter: str = "initial_velocities"

    def fits(self, simulation: Simulation) -> bool:
        return not simulation.scene.emitter

    def spread(self, simulation: Simulation) -> float:
        return 0.1

    def bijector(self, simulation: Simulation, steps: int) -> Bijector:
        x = simulation.positions
        lower, upper = x.min(axis=0), x.max(axis=0)
        waves = np.cos(np.pi * (x - lower) / (upper - lower))
        modes = product((0, 1), repeat=simulation.dimension)
        return Linear(np.stack([np.prod(waves ** np.array(mode), axis=1) for mode in modes], axis=1))

    def drawn(self, simulation: Simulation, steps: int, random: np.random.Generator) -> np.ndarray:
        noise = random.standard_normal((2**simulation.dimension, simulation.dimension))
        return SCATTER * self.spread(simulation) * noise


@dataclass(frozen=True)
class NozzlePath:
    """The path of a nozzle, interpolated between knots at even times: u (knots, d) [m]."""

    knots: int = 4
    parameter: str = "nozzle.path"

    def fits(self, simulation: Simulation) -> bool:
        return bool(simulation.scene.emitter)

    def spread(self, simulation: Simulation) -> float:
        return 0.5 * simulation.scene.discretisation.spacing

    def bijector(self, simulation: Simulation, steps: int) -> Bijector:
        return TimeInterpolation(steps, self.knots)

    def drawn(self, simulation: Simulation, steps: int, random: np.random.Generator) -> np.ndarray:
        (emitter,) = simulation.scene.emitter
        noise = random.standard_normal((self.knots, simulation.dimension))
        return np.asarray(emitter.outlet) + SCATTER * self.spread(simulation) * noise


@dataclass(frozen=True)
class PaddlePath:
    """How a paddle has moved, its velocity constant in equal blocks of time: u (blocks, d) [m/s]."""

    blocks: int
    parameter: str = "paddle.displacement"

    def fits(self, simulation: Simulation) -> bool:
        return any(solid.name == "paddle" for solid in simulation.scene.solid)

    def spread(self, simulation: Simulation) -> float:
        return 0.05

    def bijector(self, simulation: Simulation, steps: int) -> Bijector:
        block = np.arange(steps) * self.blocks // steps
        time_step = simulation.scene.solver.fixed_time_step("a path in blocks")
        return Linear(time_step * np.cumsum(np.eye(self.blocks)[block], axis=0))

    def drawn(self, simulation: Simulation, steps: int, random: np.random.Generator) -> np.ndarray:
        return SCATTER * self.spread(simulation) * random.standard_normal((self.blocks, simulation.dimension))


CONTROLS: Mapping[str, Control] = {
    "gravity-4": GravityBlocks(4),
    "gravity-16": GravityBlocks(16),
    "gravity-each-step": GravityEachStep(),
    "velocity-modes": VelocityModes(),
    "nozzle-path": NozzlePath(),
    "paddle-4": PaddlePath(4),
}
