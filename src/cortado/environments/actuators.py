"""What actions move: from numbers between -1 and 1, held for a step of an environment, to a parameter over time.

All of it is linear in the actions, so that derivatives with respect to them are a matrix.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cortado.optimisation.transforms import Affine


@dataclass(frozen=True)
class Actuator(ABC):
    """Drives some components of one parameter over time. Within a step of the environment its command goes evenly from
    the former one to ``greatest`` times the action, so that nothing jumps."""

    parameter: str
    """Its name, such as "cup.displacement"."""
    rest: tuple[float, ...]
    """(d,) The parameter before any action; a single entry where it is a number."""
    axes: tuple[int, ...]
    """(a,) Which components are driven."""
    greatest: tuple[float, ...]
    """(a,) The command of an action of 1."""
    is_number: bool = False
    """Whether the parameter is a number at each step, as a turn in the plane is."""

    @abstractmethod
    def after(self, q: NDArray, command: NDArray, time_step: float) -> NDArray:
        """(..., a) the driven components after a step of the simulation."""

    def at_rest(self, members: int) -> NDArray:
        """(members, 2, a) the driven components, and the commands, before any action."""
        return np.zeros((members, 2, len(self.axes)))

    def advance(self, now: NDArray, u: NDArray, steps: int, time_step: float) -> tuple[NDArray, NDArray]:
        """From `at_rest` or what this returned, and actions (members, a), to the same after so many steps of the
        simulation, and the parameter after each of them, (members, steps, d) or (members, steps)."""
        driven, last = [now[:, 0]], now[:, 1]
        wanted = np.array(self.greatest) * u
        for j in range(steps):
            driven.append(self.after(driven[-1], last + (wanted - last) * ((j + 1) / steps), time_step))
        return np.stack([driven[-1], wanted], axis=1), self.value(np.stack(driven[1:], axis=1))

    def value(self, q: NDArray) -> NDArray:
        """(..., d) or (...) the parameter, given the driven components (..., a)."""
        found = np.tile(np.array(self.rest, dtype=np.float64), (*q.shape[:-1], 1))
        found[..., self.axes] += q
        return found[..., 0] if self.is_number else found

    def over(self, actions: int, steps: int, time_step: float) -> Affine:
        """The parameter over so many actions, each of so many steps of the simulation, as a function of the actions
        (actions, a)."""
        a = len(self.axes)
        units = np.concatenate([np.zeros((1, actions, a)), np.eye(actions * a).reshape(-1, actions, a)])
        now, parts = self.at_rest(len(units)), []
        for k in range(actions):
            now, rows = self.advance(now, units[:, k], steps, time_step)
            parts.append(rows)
        base, *columns = np.concatenate(parts, axis=1)
        return Affine(base, np.stack([one - base for one in columns], axis=-1).reshape(*base.shape, actions, a))


@dataclass(frozen=True)
class Velocity(Actuator):
    """Actions are velocities: q' = c, with ``greatest`` in m/s or rad/s."""

    def after(self, q: NDArray, command: NDArray, time_step: float) -> NDArray:
        return q + time_step * command


@dataclass(frozen=True)
class Position(Actuator):
    """Actions are places, or any other value, that is approached with a lag: q' = (c - q) / lag."""

    lag: float = 0.1
    """[s]"""

    def after(self, q: NDArray, command: NDArray, time_step: float) -> NDArray:
        return q + time_step / self.lag * (command - q)


def split(actuators: Sequence[Actuator], actions: NDArray) -> list[NDArray]:
    """Of actions (..., a), those of each actuator."""
    return np.split(actions, np.cumsum([len(one.axes) for one in actuators])[:-1], axis=-1)
