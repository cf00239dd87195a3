"""The flow through a plane."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError
from cortado.fixed import fixed
from cortado.runs.sensors.sensor import ACROSS, Reading, Weights, direction, in_dimension, point, positive


@fixed
class FlowRate:
    """Volume of fluid that goes through a plane in a second, along its normal; the mean over a layer around it:

    Q = sum_i V (v_i . normal) w_i,   w_i = w(r_i / reach) with the integral 1,

    where r_i is a particle's distance from the plane and V its volume at rest.
    """

    def __init__(self, position: Any, normal: Any, reach: float | None = None):
        """``position`` (d,) of a point of the plane [m]; ``normal`` (d,); ``reach`` of the layer on both sides [m], two
        support radii of the scene's smoothing kernel if left out."""
        self.position, self.normal = point("position", position), direction("normal", normal)
        if len(self.position) != len(self.normal):
            raise InputError(
                f"normal has {len(self.normal)} components, but must have {len(self.position)}, as position has."
            )
        self.reach = None if reach is None else positive("reach", reach)

    def __repr__(self) -> str:
        return f"FlowRate({self.position.tolist()}, {self.normal.tolist()}, {self.reach})"

    def columns(self, dimension: int) -> dict[str, str]:
        return {"flow_rate": "m3/s" if dimension == 3 else "m2/s"}

    def value(self, at: Reading) -> NDArray[Any]:
        _, scale, weights = self._around(at)
        return np.array([scale * ((at["velocities"] @ self.normal) * weights.values).sum()])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        off, scale, weights = self._around(at)
        slopes = weights.slopes * off / self._reach(at) ** 2
        through = at["velocities"] @ self.normal
        return {
            "positions": (bar[0] * scale * through * slopes)[:, None] * self.normal,
            "velocities": (bar[0] * scale * weights.values)[:, None] * self.normal,
        }

    def _reach(self, at: Reading) -> float:
        return 2.0 * at.lattice.support if self.reach is None else self.reach

    def _around(self, at: Reading) -> tuple[NDArray[Any], float, Weights]:
        """(n,) distances from the plane along its normal, what the weights are multiplied with, and these."""
        reach = self._reach(at)
        off = (at["positions"] - in_dimension("position", self.position, at.dimension)) @ self.normal
        return off, at.lattice.volume * ACROSS[1] / reach, Weights.of(np.abs(off) / reach)
