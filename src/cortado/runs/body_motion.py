"""The sensor of where a free body is, how it is turned, and how fast it goes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.calls import fixed
from cortado.errors import InputError, shown
from cortado.runs.particle_sums import NoSum, Summed
from cortado.runs.sensor import Reading, SensedScene
from cortado.scene.motions import Pose, angular_velocity_name, position_name, velocity_name


@fixed
class BodyMotion(Summed):
    """A sensor of a free body: the position of its middle, its rotation, and how fast it goes and turns.

    The rotation is the angle in the plane and the rotation vector in space, of at most half a turn: at a half turn it
    jumps by a whole one, where its derivative goes on."""

    def __init__(self, solid: str):
        """Take the name of a ``solid`` of the scene that moves freely."""
        if not isinstance(solid, str) or not solid:
            raise InputError(f"solid is {shown(solid)}, but must be the name of a solid.")
        self.solid = solid

    def columns(self, dimension: int) -> dict[str, str]:
        axes = "xyz"[:dimension]
        turns = [""] if dimension == 2 else [f"_{axis}" for axis in axes]
        found = dict.fromkeys(axes, "m") | {f"rotation{turn}": "rad" for turn in turns}
        found |= {f"velocity_{axis}": "m/s" for axis in axes}
        return found | {f"angular_velocity{turn}": "rad/s" for turn in turns}

    def summed(self, at: SensedScene) -> NoSum:
        free = [table.name for table in at.solids if table.motion == "free"]
        if self.solid not in free:
            wanted = f"the name of a free body, of {shown(free)}" if free else "of a scene with free bodies"
            raise InputError(f"solid is {shown(self.solid)}, but must be {wanted}.")
        return NoSum()

    def reading(self, at: Reading, found: NDArray[Any]) -> NDArray[Any]:
        pose = self._pose(at)
        fast = (at[name(self.solid)].ravel() for name in (velocity_name, angular_velocity_name))
        return np.concatenate([pose.position, pose.angles, *fast])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        pose, d, turns = self._pose(at), at.dimension, 2 * at.dimension - 3
        position, rotation, velocity, spin = np.split(bar, np.cumsum([d, turns, d]))
        bars = {position_name(self.solid): position[None], velocity_name(self.solid): velocity[None]}
        bars |= {angular_velocity_name(self.solid): spin if turns == 1 else spin[None]}
        return bars | pose.angle_bars(rotation)

    def _pose(self, at: Reading) -> Pose:
        self.summed(at)
        return Pose.of(self.solid, True, at)
