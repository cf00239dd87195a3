"""Sensors of pressure, flow rate and loads, the sensors of a scene, and warnings about sensors that reach no fluid."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cortado.calls import fixed, point_in_words
from cortado.discretise.shapes import Points, corners, grid, in_space
from cortado.errors import InputError, warn
from cortado.runs.body_sensors import BodyMotion, SpringForce
from cortado.runs.particle_sums import (
    ACROSS,
    Around,
    Axes,
    LoadSensor,
    LoadSum,
    RegionSum,
    Ride,
    Seen,
    Summed,
    WeightedSum,
    axes_of,
    in_the_scene,
    load_bars,
    parts_of,
    reach_of,
    ride_of,
    together,
    turned,
)
from cortado.runs.sensor import (
    Cut,
    Reading,
    SensedScene,
    Sensor,
    corner,
    direction,
    in_dimension,
    named,
    point,
    positive,
)
from cortado.runs.wave_gauge import WaveGauge
from cortado.scene.parameters import load_name
from cortado.scene.scene import Scene

MOST = 16


@fixed
class PressureProbe(Summed):
    """A sensor of the mean pressure of the particles around a point, with weights that decrease with distance:

    p = sum_i p_i w_i / sum_i w_i,   w_i = w(r_i / radius).

    Here p_i is the pressure of particle i, r_i its distance from the point, and w a smooth function. The reading is 0
    without fluid within the radius.

    Example: ``run = simulation.run(100, sensors={"wall": cortado.sensors.PressureProbe([0.79, 0.05])})``
    """

    def __init__(self, position: Any, radius: float | None = None, on: str | None = None):
        """Place the probe at ``position`` (d,) [m]. The default of ``radius`` [m] is the support radius of the
        smoothing kernel. ``on`` names a solid that carries the probe; the position is then the initial position."""
        self.position = point("position", position)
        self.radius = None if radius is None else positive("radius", radius)
        self.on = None if on is None else named("on", on, "solid that moves")

    def columns(self, dimension: int) -> dict[str, str]:
        return {"pressure": "Pa"}

    def summed(self, at: SensedScene) -> WeightedSum:
        radius = at.lattice.support if self.radius is None else self.radius
        place = in_dimension("position", self.position, at.dimension)
        return WeightedSum(Around(place, radius, lambda way: way), "pressure", ride=ride_of(self.on, False, at))

    def reading(self, at: Reading, found: NDArray[Any]) -> NDArray[Any]:
        return np.array([found[1] / found[0] if found[0] else 0.0])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        summed, pressure = self.summed(at), at["pressure"]
        around = summed.seen(at)
        weights = around.weights
        total = weights.sum()
        if not total:
            return {"positions": np.zeros_like(at["positions"]), "pressure": np.zeros_like(pressure)}
        weights_bar = bar[0] * (pressure - self.value(at)[0]) / total
        pulled, bars = around.pulled(weights_bar), {"pressure": bar[0] * weights / total}
        if summed.ride is not None:
            bars |= summed.ride.carrier(at).lifted(-pulled.sum(axis=0), self.position)
        return bars | {"positions": pulled}


@fixed
class FlowRate(Summed):
    """A sensor of the volume flow rate through a plane along its normal, averaged over a layer around the plane:

    Q = sum_i V (v_i . normal) w_i,   w_i = w(r_i / reach) with the integral 1.

    Here v_i is the velocity of particle i, r_i its distance from the plane, V = spacing^d its volume, and w a smooth
    function.

    Example: ``gate = cortado.sensors.FlowRate([0.5, 0.2], normal=[1.0, 0.0])``
    """

    def __init__(self, position: Any, normal: Any, reach: float | None = None):
        """Place the plane by a point ``position`` (d,) [m] and a ``normal`` (d,).

        ``reach`` [m] is half the thickness of the layer. By default it is two support radii of the smoothing kernel or
        five spacings, whichever is larger.
        """
        self.position, self.normal = point("position", position), direction("normal", normal)
        if len(self.position) != len(self.normal):
            wanted = f"must have {len(self.position)}, like position"
            raise InputError(f"normal has {len(self.normal)} components, but {wanted}.")
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
    """A sensor of the force F of the fluid on the walls, and of its torque T:

    F = sum_i f_i,   T = sum_i (x_i - about) x f_i.

    The sums are over the particles i at x_i in a region, and f_i is the quantity "wall_force". The walls push the fluid
    with -F. The reading jumps when a particle crosses the border of the region. Place the border where particles exert
    no force in the direction of interest.

    Example: ``run = simulation.run(100, sensors={"force": cortado.sensors.WallForce()})``
    """

    def __init__(
        self, lower: Any = None, upper: Any = None, about: Any = None, on: str | None = None, axes: Axes = "world"
    ):
        """Take the corners ``lower`` and ``upper`` (d,) of the region [m], which is unbounded by default. The torque is
        about the point ``about`` (d,) [m], by default the origin.

        ``on`` names a solid that carries and rotates the region and the point. With ``axes`` "world", force and torque
        are along the axes of the scene. With "body", force and torque are along axes that rotate with the solid.
        """
        self.lower = None if lower is None else corner("lower", lower)
        self.upper = None if upper is None else corner("upper", upper)
        self.about = None if about is None else point("about", about)
        given = [values for values in (self.lower, self.upper, self.about) if values is not None]
        if len({len(values) for values in given}) > 1:
            raise InputError("lower, upper and about must have the same number of components.")
        if self.lower is not None and self.upper is not None and not (self.lower < self.upper).all():
            raise InputError(f"upper is {self.upper.tolist()}, but must be greater than lower, {self.lower.tolist()}.")
        self.on = None if on is None else named("on", on, "solid that moves")
        self.axes = axes_of(axes, on is not None)

    def summed(self, at: SensedScene) -> RegionSum:
        def place(what: str, values: NDArray[Any] | None, end: float) -> NDArray[Any]:
            d = at.dimension
            return np.full(d, end) if values is None else in_dimension(what, values, d)

        lower, upper = place("lower", self.lower, -np.inf), place("upper", self.upper, np.inf)
        return RegionSum(lower, upper, place("about", self.about, 0.0), ride=ride_of(self.on, True, at))

    def reading(self, at: Reading, found: NDArray[Any]) -> NDArray[Any]:
        ride = ride_of(self.on, True, at)
        if ride is not None and self.axes == "world":
            found = turned(found, ride.carrier(at).turn)
        return super().reading(at, found)

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        summed, d = self.summed(at), at.dimension
        (arms, force), (force_bar, torque_bar) = summed.chosen(at), load_bars(bar, d)
        if summed.ride is None:
            inside = at.lattice.domain.within(at["positions"], summed.lower, summed.upper)[1]
            return {
                "positions": np.cross(in_space(force), torque_bar)[:, :d],
                "wall_force": np.where(inside[:, None], bar[:d] + np.cross(torque_bar, in_space(arms))[:, :d], 0.0),
            }
        carrier = summed.ride.carrier(at)
        if self.axes == "world":
            force_bar, torque_bar = force_bar @ carrier.turn, torque_bar @ carrier.turn
        inside = np.all((summed.about + arms >= summed.lower) & (summed.about + arms < summed.upper), axis=1)
        pulled = np.cross(in_space(force), torque_bar)[:, :d] @ carrier.flat.T
        pushed = (force_bar + np.cross(torque_bar, in_space(arms)))[:, :d] @ carrier.flat.T
        pushed = np.where(inside[:, None], pushed, 0.0)
        twist = -np.cross(in_space(at["wall_force"]), in_space(pushed)).sum(axis=0)
        if self.axes == "world":
            force, torque = in_space(force).sum(axis=0), np.cross(in_space(arms), in_space(force)).sum(axis=0)
            twist = twist + carrier.turn @ (np.cross(force, force_bar) + np.cross(torque, torque_bar))
        moved = together(carrier.carried(pulled, at["positions"]), carrier.bars(np.zeros(d), twist))
        return {"positions": pulled, "wall_force": pushed} | moved


@fixed
class SolidLoad(LoadSensor):
    """A sensor of the force F of the fluid on a solid, and of its torque T about the solid's middle c:

    F = sum_i f_i,   T = sum_i (x_i - c) x f_i.

    The sums are over all particles i at x_i. The force f_i is minus the force of the solid's walls on particle i.
    No-slip walls act through pressure and viscosity, and other walls act through pressure only. The forces act in the
    step after the state, and c is the middle of the solid at the end of that step. The solid gains exactly the momentum
    that the fluid loses. The load excludes contact, gravity, buoyancy in air, and user-defined forces between fluid and
    walls.

    Example: ``run = simulation.run(100, sensors={"load": cortado.sensors.SolidLoad("pillar")})``
    """

    def __init__(self, solid: str, axes: Axes = "world"):
        """Measure the solid with the name ``solid``. With ``axes`` "world", force and torque are along the axes of the
        scene. With "body", force and torque are along axes that rotate with the solid."""
        self.solid, self.axes = named("solid", solid, "solid"), axes_of(axes, True)

    def summed(self, at: SensedScene) -> LoadSum:
        return LoadSum(load_name(self.solid))

    def reading(self, at: Reading, found: NDArray[Any]) -> NDArray[Any]:
        if self.axes == "body":
            found = turned(found, Ride(self.solid, False).carrier(at).turn.T)
        return super().reading(at, found)

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        name, d = load_name(self.solid), at.dimension
        if self.axes == "world":
            return {name: bar}
        carrier, found = Ride(self.solid, False).carrier(at), self.summed(at).on_host(at)
        world = turned(np.concatenate(load_bars(bar, d)), carrier.turn)
        twist = -np.cross(found.reshape(2, 3), world.reshape(2, 3)).sum(axis=0)
        return carrier.bars(np.zeros(d), twist) | {name: in_the_scene(world, d)}


SENSORS: dict[str, Callable[..., Sensor]] = {
    "pressure_probe": PressureProbe,
    "wave_gauge": WaveGauge,
    "flow_rate": FlowRate,
    "wall_force": WallForce,
    "solid_load": SolidLoad,
    "spring_force": SpringForce,
    "body_motion": BodyMotion,
}


def sensors_of(scene: Scene) -> dict[str, Sensor]:
    gravity = np.asarray(scene.forces.gravity, dtype=np.float64)
    upwards: dict[str, Any] = {"wave_gauge": {"up": -gravity}} if gravity.any() else {}
    given = {table.name: (table.kind, table.model_dump(exclude={"name", "kind"})) for table in scene.sensor}
    return {name: SENSORS[kind](**values, **upwards.get(kind, {})) for name, (kind, values) in given.items()}


def is_shut_off(scene: Scene, fluid: Points, points: Points) -> NDArray[np.bool_]:
    """Test for each of ``points`` (n, d) [m] if solids at rest separate the point from all ``fluid`` particles (m, d)
    [m]. The result is False for scenes with periodic axes, with emitters or without a container."""
    from scipy.ndimage import label

    nowhere, ends = np.zeros(len(points), dtype=bool), scene.container.extent()
    solids = [table.solid() for table in scene.solid if not table.moves]
    if ends is None or not solids or scene.emitter or any(scene.periods[1]):
        return nowhere
    lower, upper = np.array(ends, dtype=np.float64)
    counts = np.maximum(np.ceil((upper - lower) / (0.5 * scene.discretisation.spacing)), 1.0)
    if np.prod(counts) > 200_000:  # larger containers are not searched
        return nowhere
    shape, cells = tuple(counts.astype(int)), (upper - lower) / counts
    middles = lower + (np.indices(shape).reshape(len(shape), -1).T + 0.5) * cells
    taken = np.any([one.distance_up_to(middles, float(cells.max())) <= 0.0 for one in solids], axis=0)
    names, _ = label(~taken.reshape(shape), np.ones((3,) * len(shape)))

    def named(places: Points) -> NDArray[np.int_]:
        return np.asarray(names[tuple(np.clip((places - lower) // cells, 0, counts - 1).astype(int).T)])

    found = named(points)
    return (found > 0) & ~np.isin(found, named(fluid))


class Prepared(Cut, Protocol):
    scene: Scene
    positions: Points
    walls: Points


def warn_of_places(simulation: Prepared, sensors: Mapping[str, Any]) -> None:
    for name, sensor in sensors.items():
        if (found := _doubt(simulation, sensor)) is not None:
            warn(f"the sensor {name!r} {found}.")


def _doubt(simulation: Prepared, sensor: Any) -> str | None:
    scene, spacing = simulation.scene, simulation.scene.discretisation.spacing
    if isinstance(sensor, WallForce):
        return _without_walls(simulation, sensor)
    if not isinstance(sensor, PressureProbe | WaveGauge | FlowRate):
        return None
    place = sensor.position
    if len(place) != scene.dimension:
        return None  # refused where it is read
    ends = scene.container.extent()
    there = _what_is_at(simulation, _looked_at(ends or _of_things(simulation), sensor))
    key = "reach" if isinstance(sensor, FlowRate) else "radius"
    if all(there):
        what = {PressureProbe: "is at", WaveGauge: "has its column at", FlowRate: "has its plane through"}[type(sensor)]
        reads = f"its floor, {sensor.floor:g} m" if isinstance(sensor, WaveGauge) else "0"
        is_far = ends is not None and np.abs(place).max() > 10.0 * np.abs(ends).max()
        reads += f", or what is within its {key}{' (positions are in metres)' if is_far else ''}"
        where = " and ".join(dict.fromkeys(filter(None, there)))
        return f"{what} {point_in_words(place)} m, {where}: the reading is {reads}"
    wide = getattr(sensor, key)
    if wide is not None and wide < 0.5 * spacing:
        return (
            f"has a {key} of {wide:g} m, less than half a spacing of {spacing:g} m: the sensor sees almost no particles"
        )
    if ends is None:
        return _far_away(simulation, sensor, reach_of(wide, simulation))
    if isinstance(sensor, WaveGauge) and (said := _of_column(scene, ends, sensor)):
        return said
    size = float(np.linalg.norm(np.subtract(*ends)))
    if wide is None or wide <= size or any(scene.periods[1]):
        return None
    return f"has a {key} of {wide:g} m, more than the size {size:g} m of the container: the reading belongs to no place"


def _far_away(simulation: Prepared, sensor: Any, reach: float) -> str | None:
    ends = _of_things(simulation)
    points = _looked_at(ends, sensor)
    gap = float(np.linalg.norm(points - np.clip(points, *ends), axis=1).min())
    if isinstance(sensor, FlowRate):
        off = (corners(*ends) - sensor.position) @ sensor.normal
        gap = max(float(off.min()), float(-off.max()), 0.0)
    size = float(np.linalg.norm(ends[1] - ends[0]))
    if gap <= reach + size:
        return None
    begins = f"the fluid and the solids, which begin from {point_in_words(ends[0])} to {point_in_words(ends[1])} m"
    return f"is {gap:.4g} m from {begins}: the reading is 0 unless fluid comes so far (positions are in metres)"


def _of_things(simulation: Prepared) -> tuple[Points, Points]:
    points = np.concatenate([simulation.positions, simulation.walls])
    return points.min(axis=0), points.max(axis=0)


def _of_column(scene: Scene, ends: tuple[Points, Points], gauge: WaveGauge) -> str | None:
    heights = corners(*ends) @ gauge.up
    bottom, top = float(heights.min()), float(heights.max())
    if gauge.floor > top:
        return f"has its floor at {gauge.floor:g} m, above the container, which ends at {top:g} m"
    foot = gauge.position + (gauge.floor - gauge.position @ gauge.up) * gauge.up
    near = 0.5 * scene.discretisation.spacing
    stands = any(table.solid().distance_up_to(foot[None], near)[0] < near for table in scene.solid)
    if abs(gauge.floor - bottom) > near and not stands:
        reads = f"{abs(gauge.floor - bottom):g} m {'more' if gauge.floor > bottom else 'less'} than the level"
        return f"has its floor at {gauge.floor:g} m, but the container begins at {bottom:g} m: the reading is {reads}"
    return None


def _looked_at(ends: tuple[Points, Points], sensor: Any) -> Points:
    """Return points (n, d) [m] in the region of a sensor. The sensor works if fluid can reach one of the points."""
    place = sensor.position
    if isinstance(sensor, PressureProbe):
        return np.array([place])
    around = corners(*ends)
    if isinstance(sensor, WaveGauge):
        heights = (around - place) @ sensor.up
        return np.asarray(place + np.linspace(heights.min(), heights.max(), 4 * MOST)[1:-1, None] * sensor.up)
    off = (around - place) @ sensor.normal
    if off.min() > 0.0 or off.max() < 0.0:
        return np.array([place])
    points = grid([np.linspace(a, b, MOST)[1:-1] for a, b in zip(*ends, strict=True)])
    return np.asarray(points - ((points - place) @ sensor.normal)[:, None] * sensor.normal)


def _what_is_at(simulation: Prepared, points: Points) -> list[str | None]:
    scene = simulation.scene
    d, deep = scene.dimension, 0.01 * scene.discretisation.spacing  # less deep is on the surface
    region, ends = scene.container.region(d).opened(scene.container.periods(d)[1]), scene.container.extent()
    found: list[str | None] = [None] * len(points)
    if ends is not None:
        where = f"outside of the container, which is from {point_in_words(ends[0])} to {point_in_words(ends[1])} m"
        found = [None if inside else where for inside in region.contains(points, deep)]
    domain = scene.container.domain(d)
    for table in scene.solid:
        solid, middle = table.solid(), table.middle()
        near = middle + domain.shortest(points - middle)
        called = f"in the solid {table.name!r}{', where it begins' if table.moves else ''}"
        for k in np.flatnonzero(solid.distance(near) < -deep):
            found[k] = found[k] or called
    free = np.array([k for k, what in enumerate(found) if what is None], dtype=int)
    for k in free[is_shut_off(scene, simulation.positions, points[free])]:
        found[k] = "shut off from all fluid by solids"
    return found


def _without_walls(simulation: Prepared, sensor: WallForce) -> str | None:
    walls, d = simulation.walls, simulation.scene.dimension
    lower = np.full(d, -np.inf) if sensor.lower is None else sensor.lower
    upper = np.full(d, np.inf) if sensor.upper is None else sensor.upper
    if len(lower) != d or len(upper) != d:
        return None  # refused where it is read
    if not len(walls):
        return "reads forces on walls, but the scene has no walls: the reading is 0"
    reach = simulation.lattice.support + 0.5 * simulation.scene.discretisation.spacing
    if simulation.lattice.domain.within(walls, lower - reach, upper + reach)[1].any():
        return None
    ends = " to ".join(point_in_words(end) for end in (walls.min(axis=0), walls.max(axis=0)))
    region = f"from {point_in_words(lower)} to {point_in_words(upper)} m"
    return f"reads a region {region} without walls: all walls are within {ends} m, and the reading is 0"
