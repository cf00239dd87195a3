"""Tables of drains, which remove particles from the fluid, and parameters of sinks."""

from math import inf
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field

from cortado.discretise.room import Room
from cortado.discretise.shapes import Points, grid
from cortado.errors import Words
from cortado.scene.courses import Knots, check_over_time, lists_in_file
from cortado.scene.parameters import Axis, Parameter, Range, Source, ending, of_part, spacing_of
from cortado.scene.shape_tables import File, Ordered
from cortado.scene.tables import MISSING, Direction, FieldPath, Length, Table, Text, Vector, field_error, quantity

PRESCRIBED, BLENDED = 3.0, 3.0
"""Thicknesses of two shells around a sink [spacings]. The flow is prescribed in the inner shell and changes smoothly in
the outer shell."""


class BoxDrain(Ordered):
    """A drain that removes every particle inside a box."""

    shape: Literal["box"]
    """Kind of the drain."""
    name: Text
    """Name of the drain."""
    lower: Vector[Length] | None = None
    """(d,) Lower corner of the box [m]; if left out, the box has no lower limit."""
    upper: Vector[Length] | None = None
    """(d,) Upper corner of the box [m]; if left out, the box has no upper limit."""

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        self.check_components(("lower", "upper"), dimension, path)
        return super().in_dimension(dimension, path)

    def ends(self, dimension: int) -> Points:
        """Return the lower and the upper corner (2, d) [m]. Coordinates without a limit are infinite."""
        none = np.full(dimension, np.inf)
        return np.array([-none if self.lower is None else self.lower, none if self.upper is None else self.upper])

    def middle(self, dimension: int) -> Points:
        """Return the middle (d,) [m]. Along an axis with one limit, return the coordinate of the limit."""
        ends = self.ends(dimension)
        return np.where(np.isfinite(ends), ends, np.where(np.isfinite(ends[::-1]), ends[::-1], 0.0)).mean(axis=0)


class PlaneDrain(Table):
    """A drain that removes particles at a plane. A particle is removed when it crosses the plane along `direction`."""

    shape: Literal["plane"]
    """Kind of the drain."""
    name: Text
    """Name of the drain."""
    position: Vector[Length]
    """(d,) A point of the plane [m]."""
    direction: Direction
    """(d,) Direction in which particles cross the plane; its length has no effect."""

    def middle(self, dimension: int) -> Points:
        return np.array(self.position)


flow_name = ending("flow_rate")
count_name = ending("count")
"""Name of a state field: number of particles that a drain has removed."""


class FlowTable(Table):
    """A table with a flow rate, which is a constant, a list of values over time, or a CSV file."""

    name: Text
    """Name of the emitter or sink."""
    flow_rate: Annotated[float, quantity("m3/s (m2/s in 2-D)", ge=0.0)] | None = None
    """Flow rate: volume per second [m3/s], in 2-D area per second [m2/s]."""
    times: tuple[Annotated[float, quantity("s", ge=0.0)], ...] | None = None
    """(k,) Times of `flow_rates`, increasing from 0 [s]. Flow rates are interpolated linearly between the times."""
    flow_rates: tuple[Annotated[float, quantity("m3/s (m2/s in 2-D)", ge=0.0)], ...] | None = None
    """(k,) Flow rates at `times`, in place of `flow_rate` [m3/s (m2/s in 2-D)]."""
    file: File | None = None
    """CSV file in place of `times` and `flow_rates`. The file's header names the columns `time` and `flow_rate` with
    units. A relative path starts at the scene file's folder."""

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        if self.file is not None:
            columns = (("flow_rate", "m3/s" if dimension == 3 else "m2/s"),)
            lists = lists_in_file(self, path, columns, "the file of a flow rate", True)
            if min(lists["flow_rates"]) < 0.0:
                raise field_error((*path, "file"), self.file, "a file with flow rates of at least 0")
            return self.model_copy(update=lists).in_dimension(dimension, path)
        if self.times is not None or self.flow_rates is not None:
            check_over_time(path, self, "flow_rates", "flow_rate")
        elif self.flow_rate is None:
            raise field_error((*path, "flow_rate"), MISSING, "given, or times with flow_rates, or a file")
        return super().in_dimension(dimension, path)

    @property
    def course(self) -> Knots | None:
        return None if self.times is None else Knots(np.array(self.times), np.array(self.flow_rates))

    @property
    def _flows(self) -> tuple[float, ...]:
        return self.flow_rates or (self.flow_rate or 0.0,)

    @property
    def begun(self) -> float:
        """Initial flow rate [m3/s (m2/s in 2-D)]."""
        return self._flows[0]

    @property
    def greatest(self) -> float:
        """Greatest flow rate [m3/s (m2/s in 2-D)]."""
        return max(self._flows)

    def passed(self, time: float) -> float:
        """Return the volume [m3], in 2-D the area [m2], that flows from the start until ``time`` [s]."""
        times = np.append(np.clip(self.times or 0.0, 0.0, time), time)
        return float(np.trapezoid(np.interp(times, self.times or (0.0,), self._flows), times))

    def time_for(self, volume: float) -> float:
        """Return the time [s] at which ``volume`` [m3], in 2-D [m2], has flowed; infinite if it never has."""
        last = float((self.times or (0.0,))[-1])
        times = np.union1d(self.times or 0.0, np.linspace(0.0, last, 1025))
        flows = np.interp(times, self.times or (0.0,), self._flows)
        volumes = np.concatenate([[0.0], np.cumsum(0.5 * (flows[1:] + flows[:-1]) * np.diff(times))])
        if volume > volumes[-1]:
            return last + float((volume - volumes[-1]) / flows[-1]) if flows[-1] > 0.0 else inf
        return float(np.interp(volume, volumes, times))

    def flow_parameter(self, dimension: int) -> Parameter:
        unit, more = "m³/s" if dimension == 3 else "m²/s", {"range": Range.NOT_NEGATIVE, "course": self.course}
        meaning = f"volume, in 2-D area, that flows through {self.name} in a second of each step"

        def change(source: Source, value: Points) -> Points:
            return np.full(np.shape(value), max(self.greatest, float(np.max(value))))

        return of_part(flow_name(self.name), unit, meaning, self.begun, Axis.STEP, change=change, **more)


class SinkDrain(FlowTable):
    """A sink that removes fluid with a given flow rate. Fluid flows towards the sink from all sides."""

    shape: Literal["sink"]
    """Kind of the drain."""
    name: Text
    """Name of the drain."""
    position: Vector[Length]
    """(d,) Centre of the sink [m], in the fluid or on a wall."""
    radius: Annotated[float, quantity("m", gt=0.0)] | None = None
    """Radius of the sphere in which particles are removed [m]; two and a half spacings if left out. The sink prescribes
    the flow in a shell of three spacings around the sphere. In a second shell of equal width the flow changes
    smoothly."""

    def middle(self, dimension: int) -> Points:
        return np.array(self.position)

    def inner(self, spacing: float) -> float:
        return 2.5 * spacing if self.radius is None else self.radius


AnyDrain = Annotated[BoxDrain | PlaneDrain | SinkDrain, Field(discriminator="shape")]


def check_drains(scene: Any) -> None:
    (ends, lengths), spacing = (scene.container.extent(), scene.periods[1]), scene.discretisation.spacing
    if scene.drain and (lengths > 0.0).all():
        wanted = "left out, as no axis is without a period, along which what it takes could be put aside"
        raise field_error(("drain",), Words("given"), wanted)
    for index, drain in enumerate(scene.drain):
        path = "drain", index
        if isinstance(drain, SinkDrain):
            if scene.solver.kind != "projection":
                wanted = '"box" or "plane", as the solver is not "projection"'
                raise field_error((*path, "shape"), drain.shape, wanted)
            place, room, inner = np.array(drain.position), scene.resting_room, drain.inner(spacing)
            within = scene.container.contains(place[None], 1e-6 * spacing).all()
            if not within or open_sphere(room, place, spacing) == 0.0:
                raise field_error((*path, "position"), drain.position, "in the container, where fluid can come to")
            if inner < spacing:
                raise field_error((*path, "radius"), drain.radius, f"at least one spacing, {spacing:g} m")
            if open_sphere(room, place, inner + PRESCRIBED * spacing) == 0.0:
                wanted = "so small that fluid is around it, three spacings further out"
                raise field_error((*path, "radius"), inner, wanted)
        elif ends is not None:
            _check_reached(scene, drain, np.array(ends), path)


def _check_reached(scene: Any, drain: BoxDrain | PlaneDrain, ends: Points, path: FieldPath) -> None:
    wanted = "where a part of the drain is in the container"
    if isinstance(drain, PlaneDrain):
        way = np.array(drain.direction)
        if (np.where(way > 0.0, ends[1], ends[0]) - drain.position) @ way <= 0.0:
            raise field_error((*path, "position"), drain.position, wanted)
        return
    lower, upper = drain.ends(scene.dimension)
    if (lower >= ends[1]).any():
        raise field_error((*path, "lower"), drain.lower, wanted)
    if (upper <= ends[0]).any():
        raise field_error((*path, "upper"), drain.upper, wanted)
    lower, upper = np.clip([lower, upper], *ends)
    most = 512 if scene.dimension == 2 else 64
    cells = np.clip(np.ceil((upper - lower) / (0.5 * scene.discretisation.spacing)), 1, most)
    parts = [low + (high - low) * (np.arange(n) + 0.5) / n for low, high, n in zip(lower, upper, cells, strict=True)]
    if not scene.resting_room.contains(grid(parts), 0.0).any():
        raise field_error(path, Words("all of it in solids"), "where a part of it is outside of them")


def sink_limit(scene: Any, values: Any) -> float:
    """Return the longest time step [s] in which fluid near a sink moves at most 0.4 spacings."""
    longest, spacing = inf, scene.discretisation.spacing
    for drain in scene.drain:
        if isinstance(drain, SinkDrain):
            flow = float(np.max(values.get(flow_name(drain.name), drain.greatest)))
            sphere = open_sphere(scene.resting_room, np.array(drain.position), drain.inner(spacing))
            if flow > 0.0:
                area = max(sphere, 1e-3) * drain.inner(spacing) ** (scene.dimension - 1)
                longest = min(longest, 0.4 * spacing * area / flow)
    return longest


def drain_parameters(scene: Any) -> list[Parameter]:
    found = []
    for drain in scene.drain:
        if isinstance(drain, SinkDrain):
            meaning = f"middle of the drain {drain.name}"
            place = of_part(f"{drain.name}.position", "m", meaning, drain.position, change=spacing_of)
            found += [drain.flow_parameter(scene.dimension), place]
    return found


DIRECTIONS = 1024
PARTS = 16
"""Number of directions around a sink, and number of sample points along each direction."""


def open_sphere(room: Room, place: Points, radius: float) -> float:
    """Return the solid angle [sr], in 2-D the angle [rad], of the directions from ``place`` (d,) [m] without walls
    within ``radius`` [m]."""
    k = np.arange(DIRECTIONS) + 0.5
    if len(place) == 2:
        turn = 2.0 * np.pi * k / DIRECTIONS
        ways, whole = np.stack([np.cos(turn), np.sin(turn)], axis=1), 2.0 * np.pi
    else:
        z, turn = 1.0 - 2.0 * k / DIRECTIONS, np.pi * (1.0 + 5.0**0.5) * k
        across = np.sqrt(1.0 - z * z)
        ways, whole = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1), 4.0 * np.pi
    seen = [room.contains(place + part * radius * ways, 0.0) for part in np.arange(1, PARTS + 1) / PARTS]
    return whole * float(np.all(seen, axis=0).mean())
