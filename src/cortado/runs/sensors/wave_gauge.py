"""The height of the surface at a place."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.fixed import fixed
from cortado.runs.sensors.column import Axis, Column, column_of
from cortado.runs.sensors.sensor import ACROSS, Reading, Seen, direction, parts_of, point, positive, reach_of

FINER = 4.0
"""How many times as many parts a particle has along an axis where solids are in the column of a gauge."""


@fixed
class WaveGauge:
    """How high the surface of the fluid is at a place: its volume in a column around it fills the room of the column
    from the floor on. Without solids that is its volume over the column's cross-section,

    h = floor + sum_i V w_i,   w_i = w(r_i / radius) with the integral 1,

    where r_i is the horizontal distance and V the volume of a particle, spacing^d. Solids take their part of the room,
    where they are in each step: above one that stands on the floor, hangs in the fluid or reaches through its surface h
    is the level of the surface (`cortado.runs.sensors.column`). Fluid that is in the air counts too, as if it lay on
    the rest, also on a solid with air below. The column is to be away from side walls by its radius.
    """

    def __init__(self, position: Any, floor: float = 0.0, radius: float | None = None, up: Any = None):
        """``position`` (d,) [m], of which the component along ``up`` does not matter; ``floor``: from where on
        the column is filled, along ``up`` [m]; ``radius`` [m], two support radii of the scene's smoothing kernel, but
        at least five spacings, if left out; ``up`` (d,), +y if left out."""
        self.position, self.floor = point("position", position), float(floor)
        self.radius = None if radius is None else positive("radius", radius)
        self.up = direction("up", np.eye(len(self.position))[1] if up is None else up)

    def __repr__(self) -> str:
        return f"WaveGauge({self.position.tolist()}, {self.floor}, {self.radius}, {self.up.tolist()})"

    def columns(self, dimension: int) -> dict[str, str]:
        return {"height": "m"}

    def value(self, at: Reading) -> NDArray[Any]:
        column = self._column(at)
        depth = self._depth(at, self._around(at, column))
        return np.array([self.floor + (depth if column is None else column.level(depth)[0])])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        column = self._column(at)
        around = self._around(at, column)
        if column is None:
            return {"positions": around.pulled(bar[0] * self._scale(at))}
        depth = self._depth(at, around)
        bars = column.solid_bars(depth, bar[0], at.lattice.domain)
        return bars | {"positions": around.pulled(bar[0] * column.level(depth)[2] * self._scale(at))}

    def _depth(self, at: Reading, around: Seen) -> float:
        return float(self._scale(at) * around.weights.sum())

    def _scale(self, at: Reading) -> float:
        across = at.dimension - 1
        return at.lattice.cell * ACROSS[across] / reach_of(self.radius, at) ** across

    def _around(self, at: Reading, column: Column | None) -> Seen:
        """By the horizontal ways (n, d), more exactly where a column ends at the sides of solids."""
        reach = reach_of(self.radius, at)
        parts = parts_of(reach if column is None else reach / FINER, at, self._across, at.dimension - 1)
        return Seen.of(at, self.position, reach, self._across, parts)

    def _across(self, way: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(way - (way @ self.up)[:, None] * self.up)

    def _column(self, at: Reading) -> Column | None:
        return column_of(Axis.of(at, self.position, self.floor, self.up, reach_of(self.radius, at)), at)
