"""The flow through a plane."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError
from cortado.fixed import fixed
from cortado.runs.sensors.sensor import ACROSS, Reading, Seen, direction, parts_of, point, positive, reach_of


@fixed
class FlowRate:
    """Volume of fluid that goes through a plane in a second, along its normal; the mean over a layer around it:

    Q = sum_i V (v_i . normal) w_i,   w_i = w(r_i / reach) with the integral 1,

    where r_i is a particle's distance from the plane and V its volume, spacing^d.
    """

    def __init__(self, position: Any, normal: Any, reach: float | None = None):
        """``position`` (d,) of a point of the plane [m]; ``normal`` (d,); ``reach`` of the layer on both sides [m], two
        support radii of the scene's smoothing kernel, but at least five spacings, if left out."""
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
        return np.array([self._scale(at) * ((at["velocities"] @ self.normal) * self._around(at).weights).sum()])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        around, scale = self._around(at), bar[0] * self._scale(at)
        return {
            "positions": around.pulled(scale * (at["velocities"] @ self.normal)) * self.normal,
            "velocities": (scale * around.weights)[:, None] * self.normal,
        }

    def _scale(self, at: Reading) -> float:
        return at.lattice.cell * ACROSS[1] / reach_of(self.reach, at)

    def _around(self, at: Reading) -> Seen:
        """By the distances (n, 1) from the plane along its normal."""
        reach = reach_of(self.reach, at)
        return Seen.of(at, self.position, reach, self._along, parts_of(reach, at, self._along, 1))

    def _along(self, way: NDArray[Any]) -> NDArray[Any]:
        return np.asarray((way @ self.normal)[:, None])
