"""What an environment is about: a scene, what actions move, what a step is rewarded with, and how episodes begin.

An environment is one subclass in a file of `cortado.environments.tasks`.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cortado.environments.actuators import Actuator
from cortado.environments.reward import Reward
from cortado.errors import InputError, shown
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

FINENESS = {"small": 1, "large": 3}
"""By how much finer a scene of a size is: so many times more particles along each axis, and shorter steps."""
JITTER = 0.02
"""Standard deviation of the noise of first positions, in spacings."""
WATER = {"name": "water", "rest_density": 1000.0, "viscosity": 0.05, "colour": [0.1, 0.3, 0.8]}
COFFEE = {"name": "coffee", "rest_density": 1000.0, "viscosity": 0.05, "colour": [0.20, 0.09, 0.04]}
MILK = {"name": "milk", "rest_density": 950.0, "viscosity": 0.05, "colour": [0.95, 0.92, 0.85]}


@dataclass(frozen=True)
class Task(ABC):
    """In the plane, of two sizes."""

    size: str = "small"
    """"small", 100 to 200 particles for a processor, or "large", with nine times as many, for a GPU."""
    name: ClassVar[str]
    horizon: ClassVar[int]
    """Steps of the environment after which an episode is truncated."""
    repeats: ClassVar[int]
    """Steps of the small simulation in one of the environment."""
    coarse_spacing: ClassVar[float]
    """Of the small size [m]."""
    coarse_step: ClassVar[float]
    """Time step of the small size [s]."""
    lowest: ClassVar[float]
    """No step is rewarded with less: what a diverged episode gets for each step that it lacks."""
    free_solids: ClassVar[tuple[str, ...]] = ()
    """Names of those that the fluid moves, which are observed."""
    goal_names: ClassVar[tuple[str, ...]] = ()
    """What the numbers of a goal are, with their units."""

    def __post_init__(self) -> None:
        if self.size not in FINENESS:
            raise InputError(f'size is {shown(self.size)}, but must be "small" or "large".')

    @property
    def spacing(self) -> float:
        """[m]"""
        return self.coarse_spacing / FINENESS[self.size]

    @property
    def time_step(self) -> float:
        """Of the simulation [s]."""
        return self.coarse_step / FINENESS[self.size]

    @property
    def substeps(self) -> int:
        """Steps of the simulation in one of the environment."""
        return self.repeats * FINENESS[self.size]

    @property
    @abstractmethod
    def scene(self) -> Scene:
        """What is simulated."""

    @property
    @abstractmethod
    def actuators(self) -> tuple[Actuator, ...]:
        """What actions move; the numbers of an action are theirs, in this order."""

    @property
    def driven(self) -> list[str]:
        """Names of the parameters that actions drive."""
        return [one.parameter for one in self.actuators]

    @abstractmethod
    def reward(self, simulation: Simulation) -> Reward:
        """Of a step, given a simulation of the scene."""

    @property
    def goals(self) -> tuple[NDArray, NDArray]:
        """(g,), (g,) bounds within which goals of episodes are drawn."""
        return np.zeros(0), np.zeros(0)

    def scene_of(self, **tables: Any) -> Scene:
        """A scene with what all have in common."""
        common: dict[str, Any] = {
            "name": self.name,
            "discretisation": {"spacing": self.spacing},
            "solver": {"time_step": self.time_step},
        }
        return Scene(dimension=2, **{**common, **tables})
