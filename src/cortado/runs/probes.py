"""Sensors of pressure at a point, of a flow through a plane, of loads on walls and solids; those that a scene names."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.calls import fixed
from cortado.discretise.shapes import in_space
from cortado.errors import InputError, shown
from cortado.runs.particle_sums import (
    ACROSS,
    Around,
    LoadSensor,
    LoadSum,
    RegionSum,
    Seen,
    Summed,
    WeightedSum,
    parts_of,
    reach_of,
)
from cortado.runs.sensor import (
    Cut,
    Reading,
    SensedScene,
    Sensor,
    corner,
    direction,
    in_dimension,
    point,
    positive,
)
from cortado.runs.wave_gauge import WaveGauge
from cortado.scene.quantity_names import load_name
from cortado.scene.scene import Scene


@fixed
class PressureProbe(Summed):
    """A sensor of the mean pressure of the particles around a point, those nearby weighing most:

    p = sum_i p_i w_i / sum_i w_i,   w_i = w(r_i / radius).

    Here r_i is a particle's distance from the point. Without fluid within the radius it is 0.
    """

    def __init__(self, position: Any, radius: float | None = None):
        """Place the probe at ``position`` (d,) [m]; ``radius`` [m] is the smoothing kernel's support radius if left
        out."""
        self.position = point("position", position)
        self.radius = None if radius is None else positive("radius", radius)

    def columns(self, dimension: int) -> dict[str, str]:
        return {"pressure": "Pa"}

    def summed(self, at: SensedScene) -> WeightedSum:
        radius = at.lattice.support if self.radius is None else self.radius
        place = in_dimension("position", self.position, at.dimension)
        return WeightedSum(Around(place, radius, lambda way: way), "pressure")

    def reading(self, at: Reading, found: NDArray[Any]) -> NDArray[Any]:
        return np.array([found[1] / found[0] if found[0] else 0.0])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        around, pressure = Seen.of(at, self.summed(at).around), at["pressure"]
        weights = around.weights
        total = weights.sum()
        if not total:
            return {"positions": np.zeros_like(at["positions"]), "pressure": np.zeros_like(pressure)}
        weights_bar = bar[0] * (pressure - self.value(at)[0]) / total
        return {"positions": around.pulled(weights_bar), "pressure": bar[0] * weights / total}


@fixed
class FlowRate(Summed):
    """A sensor of the volume of fluid that goes through a plane in a second, along its normal; the mean over a layer
    around it:

    Q = sum_i V (v_i . normal) w_i,   w_i = w(r_i / reach) with the integral 1,

    where r_i is a particle's distance from the plane and V its volume, spacing^d.
    """

    def __init__(self, position: Any, normal: Any, reach: float | None = None):
        """Place the plane by a point ``position`` (d,) [m] and a ``normal`` (d,); ``reach`` of the layer on both sides
        [m] is two support radii of the scene's smoothing kernel, but at least five spacings, if left out."""
        self.position, self.normal = point("position", position), direction("normal", normal)
        if len(self.position) != len(self.normal):
            raise InputError(
                f"normal has {len(self.normal)} components, but must have {len(self.position)}, as position has."
            )
        self.reach = None if reach is None else positive("reach", reach)

    def columns(self, dimension: int) -> dict[str, str]:
        return {"flow_rate": "m3/s" if dimension == 3 else "m2/s"}

    def summed(self, at: SensedScene) -> WeightedSum:
        reach, place = reach_of(self.reach, at), in_dimension("position", self.position, at.dimension)
        around = Around(place, reach, self._along, parts_of(reach, at, self._along, 1))
        return WeightedSum(around, along=self.normal)

    def reading(self, at: Reading, found: NDArray[Any]) -> NDArray[Any]:
        return np.array([self._scale(at) * found[1]])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        around, scale = Seen.of(at, self.summed(at).around), bar[0] * self._scale(at)
        return {
            "positions": around.pulled(scale * (at["velocities"] @ self.normal)) * self.normal,
            "velocities": (scale * around.weights)[:, None] * self.normal,
        }

    def _scale(self, at: Cut) -> float:
        return at.lattice.cell * ACROSS[1] / reach_of(self.reach, at)

    def _along(self, way: NDArray[Any]) -> NDArray[Any]:
        return np.asarray((way @ self.normal)[:, None])


@fixed
class WallForce(LoadSensor):
    """A sensor of the force with which the fluid pushes the walls, and of its torque:

    F = sum_i f_i,   T = sum_i (x_i - about) x f_i,

    over the particles of a region, where f_i is the quantity "wall_force". Walls push the fluid with -F. The border of
    a region is a jump: let it run where particles do not push in the direction that is looked at, as half-way between
    two walls.
    """

    def __init__(self, lower: Any = None, upper: Any = None, about: Any = None):
        """Take corners ``lower``, ``upper`` (d,) of the region [m], which has no end there if left out, and the point
        ``about`` (d,) of the torque [m], the origin if left out."""
        self.lower, self.upper, self.about = (
            None if values is None else read(what, values)
            for what, values, read in (("lower", lower, corner), ("upper", upper, corner), ("about", about, point))
        )
        given = [values for values in (self.lower, self.upper, self.about) if values is not None]
        if len({len(values) for values in given}) > 1:
            raise InputError("lower, upper and about must have as many components as one another.")
        if self.lower is not None and self.upper is not None and not (self.lower < self.upper).all():
            raise InputError(f"upper is {self.upper.tolist()}, but must be greater than lower, {self.lower.tolist()}.")

    def summed(self, at: SensedScene) -> RegionSum:
        def place(what: str, values: NDArray[Any] | None, end: float) -> NDArray[Any]:
            d = at.dimension
            return np.full(d, end) if values is None else in_dimension(what, values, d)

        lower, upper = place("lower", self.lower, -np.inf), place("upper", self.upper, np.inf)
        return RegionSum(lower, upper, place("about", self.about, 0.0))

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        summed, d = self.summed(at), at.dimension
        (arms, force), torque_bar = summed.chosen(at), bar[d:] if d == 3 else np.array([0.0, 0.0, bar[d]])
        inside = at.lattice.domain.within(at["positions"], summed.lower, summed.upper)[1]
        return {
            "positions": np.cross(in_space(force), torque_bar)[:, :d],
            "wall_force": np.where(inside[:, None], bar[:d] + np.cross(torque_bar, in_space(arms))[:, :d], 0.0),
        }


@fixed
class SolidLoad(LoadSensor):
    """A sensor of the force of the fluid on a solid, and of its torque about the solid's middle c,

    F = sum_i f_i,   T = sum_i (x_i - c) x f_i,

    over all particles. Here -f_i is the mass of particle i times the acceleration that the walls of the solid give it
    in the step that begins at the state, by pressure and, without slip, by viscosity. c is where the middle of the
    solid is at the end of that step, as its walls are. So the solid gets what momentum the fluid loses to it. Contact,
    gravity and buoyancy in air are not in it, nor forces of one's own between fluid and walls.
    """

    def __init__(self, solid: str):
        """Take the name of a ``solid`` in the scene."""
        if not isinstance(solid, str) or not solid:
            raise InputError(f"solid is {shown(solid)}, but must be the name of a solid.")
        self.solid = solid

    def summed(self, at: SensedScene) -> LoadSum:
        return LoadSum(load_name(self.solid))

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        return {load_name(self.solid): bar}


SENSORS: dict[str, Callable[..., Sensor]] = {
    "pressure_probe": PressureProbe,
    "wave_gauge": WaveGauge,
    "flow_rate": FlowRate,
    "wall_force": WallForce,
    "solid_load": SolidLoad,
}
"""Classes of sensors by their kinds."""


def sensors_of(scene: Scene) -> dict[str, Sensor]:
    """Make the sensors of a scene, by their names. Up is against gravity."""
    gravity = np.asarray(scene.forces.gravity, dtype=np.float64)
    upwards: dict[str, Any] = {"wave_gauge": {"up": -gravity}} if gravity.any() else {}
    return {
        table.name: SENSORS[table.kind](**table.model_dump(exclude={"name", "kind"}), **upwards.get(table.kind, {}))
        for table in scene.sensor
    }
