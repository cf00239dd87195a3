"""The pressure at a point."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.fixed import fixed
from cortado.runs.sensors.sensor import Reading, Seen, point, positive


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
        weights = self._around(at).weights
        total = weights.sum()
        return np.array([(at["pressure"] * weights).sum() / total if total else 0.0])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        around, pressure = self._around(at), at["pressure"]
        weights = around.weights
        total = weights.sum()
        if not total:
            return {"positions": np.zeros_like(at["positions"]), "pressure": np.zeros_like(pressure)}
        weights_bar = bar[0] * (pressure - self.value(at)[0]) / total
        return {"positions": around.pulled(weights_bar), "pressure": bar[0] * weights / total}

    def _around(self, at: Reading) -> Seen:
        radius = at.lattice.support if self.radius is None else self.radius
        return Seen.of(at, self.position, radius, lambda way: way)
