"""The height of the surface at a place."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.fixed import fixed
from cortado.runs.sensors.column import Axis, Column, column_of, cut_by
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
    the rest, also on a solid with air below. What is behind the sides of a container that stand along ``up`` is none of
    the column.
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
        column, scale, around = self._seen(at)
        depth = float(scale * around.weights.sum())
        return np.array([self.floor + (depth if column is None else column.level(depth)[0])])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        column, scale, around = self._seen(at)
        if column is None:
            return {"positions": around.pulled(bar[0] * scale)}
        depth = float(scale * around.weights.sum())
        bars = column.solid_bars(depth, bar[0], at.lattice.domain)
        return bars | {"positions": around.pulled(bar[0] * column.level(depth)[2] * scale)}

    def _seen(self, at: Reading) -> tuple[Column | None, float, Seen]:
        """Its column where solids are in it, V over the cross-section that the container leaves, and the particles by
        their horizontal ways (n, d): in more parts where a column has sides."""
        reach, across = reach_of(self.radius, at), at.dimension - 1
        axis = Axis.of(at, self.position, self.floor, self.up, reach)
        column, inside = column_of(axis, at), cut_by(axis, at.container)
        scale = (
            at.lattice.cell * ACROSS[across] / reach**across / (1.0 if inside is None else axis.places()[1] @ inside)
        )
        whole = column is None and inside is None
        parts = parts_of(reach if whole else reach / FINER, at, self._across, across)
        around = Seen.of(at, self.position, reach, self._across, parts)
        return column, scale, around

    def _across(self, way: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(way - (way @ self.up)[:, None] * self.up)
