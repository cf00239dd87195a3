"""Sensors of the pressure at a point, of a flow through a plane, and of the load on walls and on a solid."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.calls import fixed
from cortado.errors import InputError, shown
from cortado.runs.sensors.sensor import (
    ACROSS,
    Reading,
    Seen,
    corner,
    direction,
    in_dimension,
    load_columns,
    parts_of,
    point,
    positive,
    reach_of,
)
from cortado.scene.quantity_names import load_name


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


@fixed
class WallForce:
    """The force with which the fluid pushes the walls, and its torque:

    F = sum_i f_i,   T = sum_i (x_i - about) x f_i,

    over the particles of a region, where f_i is the quantity "wall_force". Walls push the fluid with -F. The border of
    a region is a jump: let it run where particles do not push in the direction that is looked at, as half-way between
    two walls.
    """

    def __init__(self, lower: Any = None, upper: Any = None, about: Any = None):
        """``lower``, ``upper`` (d,) corners of the region [m], which has no end there if left out; ``about`` (d,) the
        point of the torque [m], the origin if left out."""
        self.lower, self.upper, self.about = (
            None if values is None else read(what, values)
            for what, values, read in (("lower", lower, corner), ("upper", upper, corner), ("about", about, point))
        )
        given = [values for values in (self.lower, self.upper, self.about) if values is not None]
        if len({len(values) for values in given}) > 1:
            raise InputError("lower, upper and about must have as many components as one another.")
        if self.lower is not None and self.upper is not None and not (self.lower < self.upper).all():
            raise InputError(f"upper is {self.upper.tolist()}, but must be greater than lower, {self.lower.tolist()}.")

    def __repr__(self) -> str:
        shown = (None if values is None else values.tolist() for values in (self.lower, self.upper, self.about))
        return f"WallForce({', '.join(map(str, shown))})"

    def columns(self, dimension: int) -> dict[str, str]:
        return load_columns(dimension)

    def value(self, at: Reading) -> NDArray[Any]:
        arms, force = self._chosen(at)
        torque = np.cross(_in_space(arms), _in_space(force)).sum(axis=0)
        return np.concatenate([force.sum(axis=0), torque if at.dimension == 3 else torque[2:]])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        (arms, force), d = self._chosen(at), at.dimension
        torque_bar = bar[d:] if d == 3 else np.array([0.0, 0.0, bar[d]])
        _, inside = self._placed(at)
        return {
            "positions": np.cross(_in_space(force), torque_bar)[:, :d],
            "wall_force": np.where(inside[:, None], bar[:d] + np.cross(torque_bar, _in_space(arms))[:, :d], 0.0),
        }

    def _chosen(self, at: Reading) -> tuple[NDArray[Any], NDArray[Any]]:
        """(n, d) the arms of the particles, and their forces, 0 outside of the region."""
        about = np.zeros(at.dimension) if self.about is None else in_dimension("about", self.about, at.dimension)
        places, inside = self._placed(at)
        return places - about, np.where(inside[:, None], at["wall_force"], 0.0)

    def _placed(self, at: Reading) -> tuple[NDArray[Any], NDArray[Any]]:
        """(n, d) the images of the particles that may be in the region [m], and whether they are (n,)."""
        lower, upper = (
            np.full(at.dimension, end) if values is None else in_dimension(what, values, at.dimension)
            for what, values, end in (("lower", self.lower, -np.inf), ("upper", self.upper, np.inf))
        )
        return at.lattice.domain.within(at["positions"], lower, upper)


def _in_space(vectors: NDArray[Any]) -> NDArray[Any]:
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))


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
