"""The height of the surface above a place."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.fixed import fixed
from cortado.runs.sensors.sensor import ACROSS, Reading, Seen, direction, point, positive, reach_of


@fixed
class WaveGauge:
    """How high the fluid stands at a place: its volume in a column around it over the column's cross-section,

    h = floor + sum_i V w_i,   w_i = w(r_i / radius) with the integral 1,

    where r_i is the horizontal distance and V the volume of a particle, spacing^d. Fluid that is in the air counts too.
    Solids do not: above one that stands on the floor h is less than the level of the surface by its height. The column
    is to be away from side walls by its radius.
    """

    def __init__(self, position: Any, floor: float = 0.0, radius: float | None = None, up: Any = None):
        """``position`` (d,) [m], of which the component along ``up`` does not matter; ``floor``: where the fluid stands
        on, along ``up`` [m]; ``radius`` [m], two support radii of the scene's smoothing kernel, but at least five
        spacings, if left out; ``up`` (d,), +y if left out."""
        self.position, self.floor = point("position", position), float(floor)
        self.radius = None if radius is None else positive("radius", radius)
        self.up = direction("up", np.eye(len(self.position))[1] if up is None else up)

    def __repr__(self) -> str:
        return f"WaveGauge({self.position.tolist()}, {self.floor}, {self.radius}, {self.up.tolist()})"

    def columns(self, dimension: int) -> dict[str, str]:
        return {"height": "m"}

    def value(self, at: Reading) -> NDArray[Any]:
        return np.array([self.floor + self._scale(at) * self._around(at).weights.sum()])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        return {"positions": self._around(at).pulled(bar[0] * self._scale(at))}

    def _scale(self, at: Reading) -> float:
        across = at.dimension - 1
        return at.lattice.cell * ACROSS[across] / reach_of(self.radius, at) ** across

    def _around(self, at: Reading) -> Seen:
        """By the horizontal ways (n, d)."""
        return Seen.of(
            at, self.position, reach_of(self.radius, at), lambda way: way - (way @ self.up)[:, None] * self.up
        )
