"""How far what moves along given paths has come, which bounds the time steps that are chosen."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import inf, log

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.rollout.step_bounds import greatest_step
from cortado.rollout.step_sizes import GROWTH
from cortado.scene.motions import Course, Knots, displacement_name, reach, told, turn_name
from cortado.scene.parameter_values import Arrays
from cortado.scene.parameters import Changing
from cortado.scene.scene import Scene
from cortado.scene.stability import SOLID_STEP

LEAST = 1e-4
"""A path makes no step shorter than this part of the greatest: what goes further then has jumped."""
Moved = Sequence[tuple[float, Changing | None]]
"""The courses that move something, each with the length that makes a speed of its rate [m] or, of a place, 1."""


def moved_by(scene: Scene, values: Arrays, courses: Mapping[str, Changing]) -> dict[str, Moved]:
    """What courses of parameters move in a scene, by what it is in words, with parameters that replace the scene's."""
    found: dict[str, Moved] = {"the nozzle": [(1.0, courses.get("nozzle_path"))]}
    for solid in told(scene.solid):
        shift, turn = (courses.get(name(solid.name)) for name in (displacement_name, turn_name))
        found[f"the solid {solid.name!r}"] = [(1.0, shift), (reach(solid, values), turn)]
    return found


@dataclass(frozen=True, eq=False)
class Travel:
    """Of the fastest point on any of some paths, whose speed is constant between times."""

    times: NDArray[np.float64]
    """(k,) from 0 on [s]"""
    speeds: NDArray[np.float64]
    """(k,) after each of the times, 0 after the last [m/s]"""
    lengths: NDArray[np.float64]
    """(k,) how far it has come [m]"""
    furthest: float
    """How far it may go in a step [m]."""
    least: float
    """That no step has to be shorter than [s]."""

    @classmethod
    def of(cls, scene: Scene, values: Arrays, moved: Iterable[Moved]) -> "Travel":
        """Of what moves in a scene, with parameters that replace the scene's."""
        known = [[(arm, c) for arm, c in one if isinstance(c, Knots | Course)] for one in moved]
        times = np.unique(np.concatenate([[0.0], *(c.times for one in known for _, c in one)]))
        speeds = np.zeros(len(times))
        for one in known:
            rates = [arm * np.linalg.norm(c.rates(times).reshape(len(times), -1), axis=1) for arm, c in one]
            speeds = np.maximum(speeds, sum(rates, np.zeros(len(times))))
        lengths = np.concatenate([[0.0], np.cumsum(speeds[:-1] * np.diff(times))])
        furthest = SOLID_STEP * scene.discretisation.spacing
        return cls(times, speeds, lengths, furthest, LEAST * greatest_step(scene, values))

    def longest(self, time: float) -> float:
        """A step that begins at a time [s] may be so long [s]; infinite where the paths end before."""
        reached = float(self.at(time)) + self.furthest
        k = int(np.searchsorted(self.lengths, reached, side="right")) - 1
        if self.speeds[k] == 0.0:
            return inf
        end = self.times[k] + (reached - self.lengths[k]) / self.speeds[k]
        return max(float(end - time), self.least)

    def at(self, times: ArrayLike) -> NDArray[np.float64]:
        """How far it has come at times [s], of their shape [m]."""
        return np.asarray(np.interp(np.asarray(times), self.times, self.lengths))

    def steps(self, duration: float, longest: float) -> float:
        """How many steps it needs at most in so many seconds beside those that are as long as the ``longest`` [s]: to
        go its way, and until they are long again wherever it becomes slower."""
        begins = np.concatenate([self.times, self.times - duration])
        way = float((self.at(begins + duration) - self.at(begins)).max())
        with np.errstate(divide="ignore"):
            bounds = np.clip(self.furthest / self.speeds, self.least, max(longest, self.least))
        grown = sum(log(after / before) for before, after in pairwise(bounds) if after > before)
        return min(way / self.furthest, duration / self.least) + grown / log(GROWTH)
