"""How strongly gravity that is scheduled pulls, which bounds the time steps that are chosen."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cortado.scene.motions import Course
from cortado.scene.parameter_values import Tilt
from cortado.scene.parameters import Changing
from cortado.scene.scene import Scene
from cortado.scene.stability import gravity_limits

PARTS = 8
"""Into which a step is cut: gravity that changes within it is looked at after each."""


@dataclass(frozen=True, eq=False)
class Pull:
    """Of a gravity that changes, as such or by a tilt."""

    scene: Scene
    course: Course
    upright: Callable[[NDArray], NDArray]
    """Gravity (k, d) [m/s2] of values of the course."""
    greatest: float
    """No step is longer [s]."""

    @classmethod
    def of(cls, scene: Scene, courses: Mapping[str, Changing], greatest: float) -> "dict[str, Pull]":
        """Those among the courses of parameters in a scene, by what they are in words."""
        upright: dict[str, Callable[[NDArray], NDArray]] = {
            "gravity": np.asarray,
            "tilt": Tilt(scene.forces.gravity).gravity,
        }
        return {
            f"the scheduled {name}": cls(scene, one, upright[name], greatest)
            for name, one in courses.items()
            if name in upright and isinstance(one, Course)
        }

    def longest(self, time: float) -> float:
        """A step that begins at a time [s] may be so long [s]: it is over before gravity is too strong for it."""
        ways = np.linspace(0.0, self.greatest, PARTS + 1)
        known = np.array(self.course.times) - time
        ways = np.concatenate([ways, known[(known > 0.0) & (known < self.greatest)]])
        limits = np.minimum.reduce([*gravity_limits(self.scene, self.upright(self.course.at(time + ways))).values()])
        return float(np.maximum(limits, ways).min())
