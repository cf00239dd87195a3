"""The force and the torque of the fluid on a solid."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError, shown
from cortado.fixed import fixed
from cortado.runs.sensors.sensor import Reading, load_columns
from cortado.scene.quantities import load_name


@fixed
class SolidLoad:
    """The force of the fluid on a solid, and its torque about the solid's position:

    F = sum_i f_i,   T = sum_i (x_i - c) x f_i,

    over all particles, where -f_i is the mass of particle i times the acceleration that the walls of the solid give it
    in the step that begins at the state, by pressure and, without slip, by viscosity; c is where the middle of the
    solid is at the end of that step, as its walls are. So the solid gets what momentum the fluid loses to it. Contact,
    gravity and buoyancy in air are not in it, nor forces of one's own between fluid and walls.
    """

    def __init__(self, solid: str):
        """``solid``: its name in the scene."""
        if not isinstance(solid, str) or not solid:
            raise InputError(f"solid is {shown(solid)}, but must be the name of a solid.")
        self.solid = solid

    def __repr__(self) -> str:
        return f"SolidLoad({self.solid!r})"

    def columns(self, dimension: int) -> dict[str, str]:
        return load_columns(dimension)

    def value(self, at: Reading) -> NDArray[Any]:
        return np.asarray(at[load_name(self.solid)])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        return {load_name(self.solid): bar}
