"""Base classes of control tasks, and actuators that convert actions to a parameter over time."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import as_numbers
from cortado.environments.terms import Reward
from cortado.errors import InputError, shown
from cortado.optimisation.transforms import Affine
from cortado.scene.scene import Scene
from cortado.simulation import Simulation


@dataclass(frozen=True)
class Actuator(ABC):
    """An actuator converts actions from -1 to 1 to the driven components of a parameter. The command is the action
    times ``greatest``. During an environment step the command changes linearly from its last value."""

    parameter: str
    """Name of the driven parameter, such as "cup.displacement"."""
    rest: tuple[float, ...]
    """Value of the parameter before any action (d,). A scalar parameter has one component."""
    axes: tuple[int, ...]
    """Indices of the driven components (a,)."""
    greatest: tuple[float, ...]
    """Command of each driven component for an action of 1 (a,)."""
    is_number: bool = False
    """True if the parameter is a scalar, such as an angle in the plane."""

    @abstractmethod
    def after(self, q: NDArray, command: NDArray, time_step: float) -> NDArray:
        """Return the driven components (..., a) after a simulation step that begins with the components ``q``."""

    def at_rest(self, members: int) -> NDArray:
        """Return the driven components and the commands before any action (members, 2, a)."""
        return np.zeros((members, 2, len(self.axes)))

    def advance(self, now: NDArray, u: NDArray, steps: int, time_step: float) -> tuple[NDArray, NDArray]:
        """Take ``steps`` simulation steps with actions ``u`` (members, a). Return the final components and commands
        (members, 2, a), and the parameter after each step. The parameter is (members, steps, d) or (members, steps)."""
        driven, last = [now[:, 0]], now[:, 1]
        wanted = np.array(self.greatest) * u
        for j in range(steps):
            driven.append(self.after(driven[-1], last + (wanted - last) * ((j + 1) / steps), time_step))
        return np.stack([driven[-1], wanted], axis=1), self.value(np.stack(driven[1:], axis=1))

    def value(self, q: NDArray) -> NDArray:
        """Return the parameter (..., d), or (...) for a scalar, from its driven components (..., a)."""
        found = np.tile(np.array(self.rest, dtype=np.float64), (*q.shape[:-1], 1))
        found[..., self.axes] += q
        return found[..., 0] if self.is_number else found

    def over(self, actions: int, steps: int, time_step: float, begun: NDArray | None = None) -> Affine:
        """Return the parameter as an affine function of actions (actions, a). Each action lasts ``steps`` simulation
        steps. ``begun`` has the initial components and commands (1, 2, a). By default the actuator begins at rest."""
        a = len(self.axes)
        units = np.concatenate([np.zeros((1, actions, a)), np.eye(actions * a).reshape(-1, actions, a)])
        now, parts = np.repeat(self.at_rest(1) if begun is None else begun, len(units), axis=0), []
        for k in range(actions):
            now, rows = self.advance(now, units[:, k], steps, time_step)
            parts.append(rows)
        base, *columns = np.concatenate(parts, axis=1)
        return Affine(base, np.stack([one - base for one in columns], axis=-1).reshape(*base.shape, actions, a))


@dataclass(frozen=True)
class Velocity(Actuator):
    """An actuator whose command is the time derivative of the driven component [m/s or rad/s]."""

    def after(self, q: NDArray, command: NDArray, time_step: float) -> NDArray:
        return q + time_step * command


@dataclass(frozen=True)
class Position(Actuator):
    """An actuator whose command is the target value of the driven component."""

    lag: float = 0.1
    """Time constant of the approach to the target [s]."""

    def after(self, q: NDArray, command: NDArray, time_step: float) -> NDArray:
        return q + time_step / self.lag * (command - q)


@dataclass(frozen=True)
class Task(ABC):
    """The base class of control tasks. A task has a scene, actuators, a reward and goals, in two sizes."""

    size: str = "small"
    """"small", for a CPU, or "large", for a GPU. The large size has `finer` times as many particles along each axis."""
    dimension: ClassVar[int] = 2
    finer: ClassVar[int] = 3
    """Spacing and time step of the small size, divided by the spacing and time step of the large size."""
    name: ClassVar[str]
    horizon: ClassVar[int]
    """Number of environment steps before an episode is truncated."""
    repeats: ClassVar[int]
    """Number of simulation steps in an environment step of the small size."""
    coarse_spacing: ClassVar[float]
    """Particle spacing of the small size [m]."""
    coarse_step: ClassVar[float]
    """Time step of the small size [s]."""
    lowest: ClassVar[float]
    """Least reward of a step. After a diverged episode, each missing step counts with this reward."""
    free_solids: ClassVar[tuple[str, ...]] = ()
    """Names of the rigid bodies that are observed."""
    goal_names: ClassVar[tuple[str, ...]] = ()
    """Descriptions of the components of a goal, with units."""

    def __post_init__(self) -> None:
        if self.size not in ("small", "large"):
            raise InputError(f'size is {shown(self.size)}, but must be "small" or "large".')
        needed = ("name", "horizon", "repeats", "coarse_spacing", "coarse_step", "lowest")
        if missing := [name for name in needed if not hasattr(self, name)]:
            raise InputError(f"{type(self).__name__} has no {', '.join(missing)}, but must have {', '.join(needed)}.")

    @property
    def fineness(self) -> int:
        return self.finer if self.size == "large" else 1

    @property
    def spacing(self) -> float:
        """Particle spacing [m]."""
        return self.coarse_spacing / self.fineness

    @property
    def time_step(self) -> float:
        """Time step of the simulation [s]."""
        return self.coarse_step / self.fineness

    @property
    def substeps(self) -> int:
        return self.repeats * self.fineness

    @property
    @abstractmethod
    def scene(self) -> Scene:
        """The simulated scene."""

    @property
    @abstractmethod
    def actuators(self) -> tuple[Actuator, ...]:
        """Actuators, in the order of the components of an action."""

    @property
    def driven(self) -> list[str]:
        return [one.parameter for one in self.actuators]

    @abstractmethod
    def reward(self, simulation: Simulation) -> Reward:
        """Return the reward function of an environment step. ``simulation`` simulates the scene of the task."""

    @property
    def goals(self) -> tuple[NDArray, NDArray]:
        """Lower and upper bounds of the random goals (g,)."""
        return np.zeros(0), np.zeros(0)

    def scene_of(self, **tables: Any) -> Scene:
        common: dict[str, Any] = {"name": self.name, "discretisation": {"spacing": self.spacing}}
        common["solver"] = {"time_step": self.time_step}
        return Scene(dimension=self.dimension, **{**common, **tables})


def checked_scene(task: Task) -> Scene:
    scene = task.scene
    found, wanted = scene.solver.time_step, task.time_step
    if found == "auto" or not np.isclose(found, wanted, rtol=1e-6, atol=0.0):
        own = f"the time_step of the task, {wanted:g} s, with which its actuators compute"
        said = f"the scene of the task {task.name} has solver.time_step = {shown(found)}"
        raise InputError(f"{said}, but must have {own}.")
    return scene


def checked_actions(what: str, given: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    array = as_numbers(what, given)
    if array.shape != shape:
        raise InputError(f"{what} has shape {array.shape}, but must be {shape}.")
    if not np.isfinite(array).all():
        raise InputError(f"{what} has a value that is not finite, but must be numbers from -1 to 1.")
    return np.clip(array, -1.0, 1.0)


def split(actuators: Sequence[Actuator], actions: NDArray) -> list[NDArray]:
    return np.split(actions, np.cumsum([len(one.axes) for one in actuators])[:-1], axis=-1)
