"""The pressure at a point."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.fixed import fixed
from cortado.runs.sensors.sensor import Reading, Weights, in_dimension, point, positive


@fixed
class PressureProbe:
    """The mean pressure of the particles around a point, those nearby weighing most:

    p = sum_i p_i w_i / sum_i w_i,   w_i = w(r_i / radius),

    where r_i is a particle's distance from the point. Without fluid within the radius it is 0.
    """

    def __init__(self, position: Any, radius: float | None = None):
        """``position`` (d,) [m]; ``radius`` [m], the support radius of the scene's smoothing kernel if left out."""
        self.position = point("position", position)
        self.radius = None if radius is None else positive("radius", radius)

    def __repr__(self) -> str:
        return f"PressureProbe({self.position.tolist()}, {self.radius})"

    def columns(self, dimension: int) -> dict[str, str]:
        return {"pressure": "Pa"}

    def value(self, at: Reading) -> NDArray[Any]:
        _, _, weights = self._around(at)
        total = weights.values.sum()
        return np.array([(at["pressure"] * weights.values).sum() / total if total else 0.0])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        apart, radius, weights = self._around(at)
        total, pressure = weights.values.sum(), at["pressure"]
        if not total:
            return {"positions": np.zeros_like(apart), "pressure": np.zeros_like(pressure)}
        weights_bar = bar[0] * (pressure - self.value(at)[0]) / total
        positions_bar = (weights_bar * weights.slopes / radius**2)[:, None] * apart
        return {"positions": positions_bar, "pressure": bar[0] * weights.values / total}

    def _around(self, at: Reading) -> tuple[NDArray[Any], float, Weights]:
        """(n, d) from the point to the particles, and their weights."""
        radius = at.lattice.support if self.radius is None else self.radius
        apart = at["positions"] - in_dimension("position", self.position, at.dimension)
        return apart, radius, Weights.of(np.linalg.norm(apart, axis=1) / radius)
