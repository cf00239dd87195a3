"""What a control task is: a scene, controls, a loss, a score, and a solution to be measured by.

A task is an object. One with other parameters, such as the path of a moving solid, is one file more.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from cortado import Problem, Scene, Simulation
from cortado.losses import Frames, Loss
from cortado.optimisation.transforms import Affine
from cortado.scene.parameter_values import Arrays

GRAVITY = 9.81
"""[m/s2]"""
WATER = {"name": "water", "rest_density": 1000.0, "viscosity": 0.05, "colour": [0.1, 0.3, 0.8]}
COFFEE = {"name": "coffee", "rest_density": 1000.0, "viscosity": 0.05, "colour": [0.20, 0.09, 0.04]}
MILK = {"name": "milk", "rest_density": 950.0, "viscosity": 0.05, "colour": [0.95, 0.92, 0.85]}
Score = dict[str, float]


@dataclass(frozen=True)
class Controls:
    """Numbers from -1 to 1, of which parameters of the scene over time are made."""

    mappings: Mapping[str, Affine]
    """By the name of a parameter, such as gravity: from its share of the numbers to it, (steps, ...)."""

    @property
    def numbers(self) -> int:
        """How many there are."""
        return sum(self._shares)

    @property
    def _shares(self) -> list[int]:
        return [mapping.matrix.shape[-1] for mapping in self.mappings.values()]

    def named(self, u: np.ndarray) -> Arrays:
        """The share of each parameter in the numbers (numbers,)."""
        return dict(zip(self.mappings, np.split(u, np.cumsum(self._shares)[:-1]), strict=True))

    def flat(self, named: Arrays) -> np.ndarray:
        """(numbers,) of the shares."""
        return np.concatenate([named[name] for name in self.mappings])

    def parameters(self, u: np.ndarray) -> Arrays:
        """What a `Problem` is given."""
        return {name: self.mappings[name].parameter(share) for name, share in self.named(u).items()}

    def adjoint(self, u: np.ndarray, bars: Arrays) -> np.ndarray:
        """(numbers,) the adjoint of the numbers for those of the parameters."""
        return self.flat(
            {name: self.mappings[name].adjoint(share, bars[name]) for name, share in self.named(u).items()}
        )


class Task(ABC):
    """A fluid to be moved, and how well that was done."""

    name: ClassVar[str]

    @classmethod
    @abstractmethod
    def small(cls) -> Self:
        """For a CPU, some 144 particles and 200 steps in the plane."""

    @classmethod
    @abstractmethod
    def large(cls) -> Self:
        """For a GPU, 1,000 steps or more."""

    @property
    @abstractmethod
    def steps(self) -> int:
        """Of time, in one run."""

    @property
    @abstractmethod
    def scene(self) -> Scene:
        """The fluid and its container."""

    @property
    @abstractmethod
    def controls(self) -> Controls:
        """What a search may change."""

    @abstractmethod
    def loss(self, simulation: Simulation) -> Loss | Frames:
        """What a search lowers."""

    @abstractmethod
    def score(self, problem: Problem, parameters: Arrays) -> Score:
        """How well some parameters do, in numbers with a meaning; each is better the smaller it is."""

    @property
    @abstractmethod
    def known(self) -> np.ndarray:
        """(numbers,) controls that are known to do better than the baseline."""

    @property
    def baseline(self) -> np.ndarray:
        """(numbers,) what one would do without a search, and where all searches begin."""
        return np.zeros(self.controls.numbers)

    def problem(self, device: str = "cpu", precision: str = "float32") -> Problem:
        """The task as what can be differentiated."""
        simulation = Simulation(self.scene, device, precision)
        return Problem(simulation, self.steps, self.loss(simulation))


class NoLoss:
    """For problems that are only run."""

    def value(self, end: Any) -> float:
        return 0.0

    def value_and_adjoint(self, end: Any) -> tuple[float, tuple[np.ndarray, ...]]:
        return 0.0, (np.zeros_like(end.positions), np.zeros_like(end.velocities))


def scene_of(name: str, spacing: float, time_step: float, container: Mapping[str, Any], **tables: Any) -> Scene:
    """A scene with what all tasks have in common, but for these tables; lengths in m, times in s."""
    dimension = len(container["lower" if "lower" in container else "base"])
    form = {} if "solver" in tables else {"viscosity": "pairwise"}  # the report's, which PCISPH alone has
    common: dict[str, Any] = {
        "discretisation": {"spacing": spacing, "support": 2.0, "kernel": "cubic_spline"},
        "container": container,
        "forces": {"gravity": [0.0, -GRAVITY, 0.0][:dimension], **form},
        "solver": {"kind": "pcisph", "time_step": time_step, "minimum_iterations": 4, "maximum_iterations": 4},
    }
    return Scene(name=name, dimension=dimension, **{**common, **tables})


def blocks_of(steps: int, blocks: int) -> np.ndarray:
    """(steps, blocks) which block of time a step is in: 1 there, 0 elsewhere."""
    return np.eye(blocks)[np.arange(steps) * blocks // steps]


def shaken(steps: int, blocks: int, strength: float, dimension: int, axes: int) -> Controls:
    """Gravity in blocks of time, as somebody feels it who stands in a container that is shaken along its first axes:
    the numbers of the first block, of the second, and so on; ``strength`` is the greatest acceleration [m/s2]."""
    base = np.zeros((steps, dimension))
    base[:, 1] = -GRAVITY
    matrix = np.einsum("sb,da->sdba", strength * blocks_of(steps, blocks), np.eye(dimension, axes))
    return Controls({"gravity": Affine(base, matrix.reshape(steps, dimension, blocks * axes))})
