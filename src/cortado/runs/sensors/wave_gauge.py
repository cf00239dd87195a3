"""The height of the surface above a place."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.fixed import fixed
from cortado.runs.sensors.sensor import ACROSS, Reading, Weights, direction, in_dimension, point, positive


@fixed
class WaveGauge:
    """How high the fluid stands at a place: its volume in a column around it over the column's cross-section,

    h = floor + sum_i V w_i,   w_i = w(r_i / radius) with the integral 1,

    where r_i is the horizontal distance and V the volume of a particle at rest. Fluid that is in the air counts too.
    The column is to be away from side walls by its radius.
    """

    def __init__(self, position: Any, floor: float = 0.0, radius: float | None = None, up: Any = None):
        """``position`` (d,) [m], of which the component along ``up`` does not matter; ``floor``: where the fluid stands
        on, along ``up`` [m]; ``radius`` [m], two support radii of the scene's smoothing kernel if left out; ``up``
        (d,), +y if left out."""
        self.position, self.floor = point("position", position), float(floor)
        self.radius = None if radius is None else positive("radius", radius)
        self.up = direction("up", np.eye(len(self.position))[1] if up is None else up)

    def __repr__(self) -> str:
        return f"WaveGauge({self.position.tolist()}, {self.floor}, {self.radius}, {self.up.tolist()})"

    def columns(self, dimension: int) -> dict[str, str]:
        return {"height": "m"}

    def value(self, at: Reading) -> NDArray[Any]:
        _, radius, weights = self._around(at)
        return np.array([self.floor + self._scale(at, radius) * weights.values.sum()])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        apart, radius, weights = self._around(at)
        return {"positions": (bar[0] * self._scale(at, radius) * weights.slopes / radius**2)[:, None] * apart}

    def _scale(self, at: Reading, radius: float) -> float:
        across = at.dimension - 1
        return at.lattice.volume * ACROSS[across] / radius**across

    def _around(self, at: Reading) -> tuple[NDArray[Any], float, Weights]:
        """(n, d) the horizontal way from the place to the particles, and their weights."""
        radius = 2.0 * at.lattice.support if self.radius is None else self.radius
        apart = at["positions"] - in_dimension("position", self.position, at.dimension)
        apart = apart - (apart @ self.up)[:, None] * self.up
        return apart, radius, Weights.of(np.linalg.norm(apart, axis=1) / radius)
