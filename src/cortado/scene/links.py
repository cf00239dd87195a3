"""Hinges and springs of free bodies: tables, parameters, degrees of freedom and limits of the time step."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, sqrt
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from cortado.arrays import unit
from cortado.discretise.shapes import Points
from cortado.discretise.solid import Mass
from cortado.errors import Words, shown
from cortado.scene.courses import WAYS, Knots, check_over_time, lists_in_file
from cortado.scene.motions import mass_of_one, weight_name
from cortado.scene.parameter_values import Arrays
from cortado.scene.parameters import Axis, Parameter, Range, Source, of_part
from cortado.scene.shape_tables import File
from cortado.scene.solids import SolidTable
from cortado.scene.tables import FieldPath, Flag, Length, Table, Text, Vector, check_name, field_error, quantity

Three = tuple[float, float, float]
COLUMNS = (("torque", "N m"), ("speed", "rad/s"))


class HingeTable(Table):
    """A hinge of a free body. One point of the body stays at a fixed point in space, or at a fixed point of a second
    solid."""

    name: Text
    """Name of the hinge."""
    solid: Text
    """Name of the free body."""
    to: Text | None = None
    """Name of a moving solid to which the hinge joins the free body; if left out, the hinge is fixed in space."""
    position: Vector[Length]
    """(d,) Position of the hinge at the start [m]."""
    axis: tuple[Annotated[float, quantity()], ...] | None = None
    """(3,) Initial direction of the hinge's axis, in 3-D only; its length has no effect. If left out, the hinge is a
    ball joint: the body can turn about every axis."""
    stiffness: Annotated[float, quantity("N m/rad", ge=0.0)] | None = None
    """Stiffness of the spring: torque per radian away from `rest_angle` [N m/rad]; in 2-D per metre of depth."""
    rest_angle: Annotated[float, quantity("rad", ge=-3.0, le=3.0)] = 0.0
    """Angle of rotation since the start at which the hinge's spring has no torque [rad]."""
    damping: Annotated[float, quantity("N m s/rad", ge=0.0)] | None = None
    """Damping coefficient [N m s/rad]: damping torque divided by (`speed` - angular velocity)."""
    torque: Annotated[float, quantity("N m")] | None = None
    """Constant torque of the hinge's motor on the body [N m]."""
    speed: Annotated[float, quantity("rad/s")] | None = None
    """Target angular velocity of the motor [rad/s]. The damping drives the body towards this angular velocity."""
    times: tuple[Annotated[float, quantity("s", ge=0.0)], ...] | None = None
    """(k,) Times of `torques` or `speeds`, increasing from 0 [s]. Torques and speeds are interpolated linearly between
    the times."""
    torques: tuple[Annotated[float, quantity("N m")], ...] | None = None
    """(k,) Torques of the motor at `times`, in place of `torque` [N m]."""
    speeds: tuple[Annotated[float, quantity("rad/s")], ...] | None = None
    """(k,) Target angular velocities of the motor at `times`, in place of `speed` [rad/s]."""
    file: File | None = None
    """CSV file in place of `times`, `torques` and `speeds`. The file has a column `time`, and at least one of the
    columns `torque` and `speed`, with units in the header. A relative path starts at the scene file's folder."""

    @property
    def turned_by(self) -> str | None:
        """Return the first given key of a spring, damper or motor, or None."""
        keys = ("stiffness", "damping", "torque", "speed", "times")
        return next((key for key in keys if getattr(self, key) is not None), None)

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        if self.file is not None:
            given = lists_in_file(self, path, COLUMNS, "the file of a motor", False)
            return self.model_copy(update=given).in_dimension(dimension, path)
        if self.axis is not None:
            if dimension == 2:
                raise field_error((*path, "axis"), self.axis, "left out in 2-D, where bodies turn about z")
            self.check_components(("axis",), dimension, path)
            if not any(self.axis):
                raise field_error((*path, "axis"), self.axis, "a vector that is not 0")
        elif dimension == 3 and self.turned_by:
            raise field_error((*path, self.turned_by), Words("given"), "left out, as the hinge has no axis")
        lists = [name for name, _ in COLUMNS if getattr(self, f"{name}s") is not None]
        for name in lists or (["torque"] if self.times is not None else []):
            check_over_time(path, self, f"{name}s", name)
        if self.damping is None and (self.speed is not None or self.speeds is not None):
            key = "speed" if self.speed is not None else "speeds"
            raise field_error((*path, key), Words("given"), "left out, as the hinge has no damping")
        return super().in_dimension(dimension, path)

    def course(self, name: str) -> Knots | None:
        values = getattr(self, f"{name}s")
        return None if values is None else Knots(np.array(self.times), np.array(values))


@dataclass(frozen=True)
class Hold:
    """Degrees of freedom of a free body."""

    moving: Three = (1.0, 1.0, 1.0)
    """For each axis of space, 1 if the body's centre of mass may move along this axis, else 0."""
    turning: int = 3
    """Number of axes about which the body may rotate. In 2-D, the number is 3 for a body that may rotate."""
    axis: Three = (0.0, 0.0, 0.0)
    """Unit vector: the axis of rotation if `turning` is 1, or the blocked axis if `turning` is 2."""
    arm: Three = (0.0, 0.0, 0.0)
    """Vector from the centre of mass to the hinge, in the body's frame [m]; 0 without a hinge."""

    @classmethod
    def of(cls, table: SolidTable, dimension: int, hinges: Sequence[HingeTable] = ()) -> Self:
        for hinge in hinges:
            if hinge.solid == table.name and hinge.to is None:
                arm = in_frame(table, hinge.position)
                axis = np.zeros(3) if hinge.axis is None else unit(np.array(hinge.axis))
                return cls((0.0, 0.0, 0.0), 3 if hinge.axis is None else 1, _three(axis), _three(arm))
        if table.freedom is None:
            return cls()
        free = [float(way in table.freedom) for way in WAYS[dimension]]
        x, y, z, *turns = (*free[:2], 0.0, *free[2:] * 3) if dimension == 2 else free
        turning = sum(map(int, turns))
        marked = [abs(turn - float(turning == 2)) for turn in turns]
        return cls((x, y, z), turning, (marked[0], marked[1], marked[2]))


def _three(vector: Any) -> Three:
    x, y, z = (*map(float, vector), 0.0)[:3]
    return x, y, z


def inertia_about(hold: Hold, mass: Mass) -> np.ndarray:
    """Return the inertia (3, 3) in the body's frame about the hinge, or about the centre of mass without a hinge."""
    arm = np.array(hold.arm)
    return np.asarray(mass.inertia + mass.volume * (arm @ arm * np.eye(3) - np.outer(arm, arm)))


def check_free_body(path: FieldPath, name: str, tables: Sequence[SolidTable]) -> None:
    free = [table.name for table in tables if table.motion == "free"]
    check_name(path, name, free, "a free body", 'of a solid whose motion is "free"')


def check_hinges(hinges: Sequence[HingeTable], solids: Sequence[SolidTable], dimension: int) -> None:
    """Check that hinges belong to free bodies and do not form closed chains."""
    joined = {solid.name: {solid.name} for solid in solids}  # the solids that hinges join to each
    for index, hinge in enumerate(hinges):
        path = ("hinge", index)
        check_free_body((*path, "solid"), hinge.solid, solids)
        if hinge.to is not None:
            others = [solid.name for solid in solids if solid.moves and solid.name != hinge.solid]
            check_name((*path, "to"), hinge.to, others, "another solid that moves", "left out, for the world")
            for number, solid in enumerate(solids):
                if solid.name in (hinge.solid, hinge.to) and solid.motion == "free" and solid.sticks:
                    wanted = f'"free", as the body is on the hinge {hinge.name!r} to another solid'
                    raise field_error(("solid", number, "slip"), solid.slip, wanted)
            if hinge.to in joined[hinge.solid]:
                raise field_error((*path, "to"), hinge.to, "a solid that other hinges do not join to this one already")
            whole = joined[hinge.solid] | joined[hinge.to]
            joined |= dict.fromkeys(whole, whole)
            continue
        if hinge.solid in [other.solid for other in hinges[:index] if other.to is None]:
            raise field_error((*path, "solid"), hinge.solid, "another one, as this one is on a hinge already")
        number, solid = next((k, solid) for k, solid in enumerate(solids) if solid.name == hinge.solid)
        for key in ("freedom", "velocity"):
            if getattr(solid, key) is not None:
                wanted = f"left out, as the solid is on the hinge {hinge.name!r}"
                raise field_error(("solid", number, key), Words("given"), wanted)
        if hinge.axis is not None and solid.angular_velocity is not None:
            across = np.cross(unit(np.array(hinge.axis)), solid.angular_velocity)
            if np.abs(across).max() > 1e-9 * np.abs(solid.angular_velocity).max():
                wanted = f"along the axis of the hinge {hinge.name!r}, {shown(hinge.axis)}"
                raise field_error(("solid", number, "angular_velocity"), solid.angular_velocity, wanted)


def number_of(
    name: str, of: str, end: str, unit: str, what: str, value: float, values: Range, change: float
) -> Parameter:
    """Create a scalar parameter. ``change`` is the parameter's typical change at 0, or everywhere if values may be
    negative."""

    def changed(source: Source, at: NDArray[Any]) -> NDArray[np.float64]:
        return np.where((np.asarray(at) == 0.0) | (values is Range.ANY), change, np.abs(at))

    return of_part(f"{name}.{end}", unit, f"{what} {of}", value, range=values, change=changed)


def in_frame(table: SolidTable, place: Any) -> Points:
    """Convert a point (d,) [m] from its initial position in space to the solid's frame."""
    return np.asarray((np.array(place) - table.middle()) @ table.turn(len(place)))


@dataclass(frozen=True)
class Begun:
    middle: Points
    """Position of the solid's middle (3,) [m]."""
    turn: Points
    """Rotation matrix from the solid's frame to space (3, 3)."""

    @classmethod
    def of(cls, table: SolidTable | None, dimension: int) -> Self:
        middle, turn = np.zeros(3), np.eye(3)
        if table is not None:
            middle[:dimension], turn[:dimension, :dimension] = table.middle(), table.turn(dimension)
        return cls(middle, turn)


@dataclass(frozen=True)
class Link:
    """A spring or hinge between a free body and a second solid or a point in space."""

    name: str
    body: int
    """Index of the free body."""
    against: int
    """Index of the second solid among all moving solids; -1 without a moving second solid."""
    other: int
    """Index of the second solid among the free bodies; -1 for any other second solid."""


@dataclass(frozen=True)
class Joint(Link):
    begun: tuple[Begun, Begun]
    axis: Points | None
    """Unit vector along the hinge's axis (3,); None for a ball joint."""
    turns: bool


def linked(link: Any, moved: Sequence[SolidTable]) -> tuple[SolidTable, SolidTable | None, tuple[str, int, int, int]]:
    """Return both solids of a spring or hinge, and the fields of its `Link`. ``moved`` are all moving solids."""
    names, bodies = [one.name for one in moved], [one.name for one in moved if one.motion == "free"]
    against = names.index(link.to) if link.to in names else -1
    other = bodies.index(link.to) if link.to in bodies else -1
    body, solid = moved[names.index(link.solid)], None if against < 0 else moved[against]
    return body, solid, (link.name, bodies.index(link.solid), against, other)


def joints_of(hinges: Sequence[HingeTable], moved: Sequence[SolidTable]) -> list[Joint]:
    found = []
    for hinge in hinges:
        d, (body, solid, fields) = len(hinge.position), linked(hinge, moved)
        axis = unit(np.array(hinge.axis)) if hinge.axis is not None else np.array([0.0, 0.0, 1.0]) if d == 2 else None
        found.append(Joint(*fields, (Begun.of(body, d), Begun.of(solid, d)), axis, bool(hinge.turned_by)))
    return found


class SpringTable(Table):
    """A spring with a damper between a free body and a second solid or a point in space."""

    name: Text
    """Name of the spring. Names of the spring's parameters begin with the spring's name."""
    solid: Text
    """Name of the free body."""
    point: Vector[Length]
    """(d,) Initial position of the spring's first end, on the free body [m]."""
    to: Text | None = None
    """Name of the second solid; if left out, the spring's second end is fixed in space."""
    anchor: Vector[Length]
    """(d,) Initial position of the spring's second end [m]."""
    stiffness: Annotated[float, quantity("N/m", gt=0.0)]
    """Stiffness: force per metre of extension [N/m]; in 2-D per metre of depth."""
    rest_length: Annotated[float, quantity("m", ge=0.0)] | None = None
    """Length at which the spring has no force [m]; the initial length if left out."""
    preload: Annotated[float, quantity("N")] | None = None
    """Initial tension of the spring [N], in place of `rest_length`."""
    damping: Annotated[float, quantity("N s/m", ge=0.0)] = 0.0
    """Damping coefficient: force per rate of extension [N s/m]."""
    slack: Flag = False
    """If true, the spring pulls but never pushes, like a mooring line."""

    @model_validator(mode="after")
    def _check_length(self) -> Self:
        if self.preload is not None and self.rest_length is not None:
            raise field_error(("preload",), self.preload, "left out, as there is a rest_length")
        if self.length_at_rest < 0.0:
            wanted = f"at most {self.stiffness * self.length:g}, with which it would have no length at rest"
            raise field_error(("preload",), self.preload, wanted)
        if self.slack and self.length_at_rest == 0.0:
            raise field_error(("slack",), True, "false, as the spring has no length at rest")
        return self

    @property
    def length(self) -> float:
        """Return the initial length of the spring [m]; 0 if `point` and `anchor` have different dimensions."""
        fits = len(self.anchor) == len(self.point)
        return float(np.linalg.norm(np.subtract(self.anchor, self.point))) if fits else 0.0

    @property
    def length_at_rest(self) -> float:
        if self.rest_length is not None:
            return self.rest_length
        return self.length - (self.preload or 0.0) / self.stiffness


def check_springs(springs: Sequence[SpringTable], hinges: Sequence[HingeTable], solids: Sequence[SolidTable]) -> None:
    names = [solid.name for solid in solids]
    for index, hinge in enumerate(hinges):
        if hinge.name in names:
            raise field_error(("hinge", index, "name"), hinge.name, "another name than those of the solids")
    for index, spring in enumerate(springs):
        path = ("spring", index)
        if spring.name in [*names, *(hinge.name for hinge in hinges)]:
            raise field_error((*path, "name"), spring.name, "another name than those of the solids and hinges")
        check_free_body((*path, "solid"), spring.solid, solids)
        if spring.to == spring.solid:
            raise field_error((*path, "to"), spring.to, "another solid than that of the other end")
        if spring.to is not None:
            check_name((*path, "to"), spring.to, names, "a solid")


def spring_parameters(scene: Any) -> list[Parameter]:
    pull, turn = ("N/m", "N m") if scene.dimension == 3 else ("N/m²", "N")
    positive, not_negative, found = Range.POSITIVE, Range.NOT_NEGATIVE, list[Parameter]()
    for spring in scene.spring:
        of, k = (spring.name, f"of the spring {spring.name}"), spring.stiffness
        found += [
            number_of(*of, "stiffness", pull, "the stiffness", k, positive, 0.1 * k),
            number_of(*of, "rest_length", "m", "the length at rest", spring.length_at_rest, not_negative, 0.1),
            number_of(*of, "damping", f"{pull} s", "the damping", spring.damping, not_negative, 0.1 * k),
        ]
    for hinge in scene.hinge:
        of = (hinge.name, f"of the hinge {hinge.name}")
        if hinge.to is not None:
            where = f"where in its solids the hinge {hinge.name} is, as they are in the scene"
            tenth: Any = {"change": lambda source, value: np.full(np.shape(value), 0.1)}
            found.append(of_part(f"{hinge.name}.position", "m", where, hinge.position, **tenth))
        if not hinge.turned_by:
            continue
        found += [
            number_of(*of, "stiffness", f"{turn}/rad", "the stiffness", hinge.stiffness or 0.0, not_negative, 1.0),
            number_of(*of, "rest_angle", "rad", "the angle at rest", hinge.rest_angle, Range.ANY, 1.0),
            number_of(*of, "damping", f"{turn} s/rad", "the damping", hinge.damping or 0.0, not_negative, 1.0),
        ]
        for name, units in (("torque", turn), ("speed", "rad/s")):
            course, steady = hinge.course(name), getattr(hinge, name) or 0.0
            values = np.ravel(steady if course is None else course.values)
            size, what = float(np.abs(values).max()) or 1.0, f"the motor's {name} in each step"
            number = number_of(*of, name, units, what, float(values[0]), Range.ANY, size)
            found.append(replace(number, axis=Axis.STEP, course=course))
    return found


def spring_limit(scene: Any, values: Arrays) -> float:
    """Return the longest stable time step [s] with the scene's springs."""
    bodies = {}
    for table in scene.solid:
        if table.motion == "free":
            one, weight = mass_of_one(table), float(values.get(weight_name(table), table.mass or table.density))
            inertia = inertia_about(Hold.of(table, scene.dimension, scene.hinge), one)
            lightest = float(np.linalg.eigvalsh(np.linalg.pinv(weight * inertia)).max())
            bodies[table.name] = table.middle(), 1.0 / (weight * one.volume), lightest
    links: list[tuple[Any, list[tuple[str, float]]]] = []  # with 1 / mass or 1 / inertia of the body at each end
    for spring in scene.spring:
        ends = []
        for name, point in ((spring.solid, spring.point), (spring.to, spring.anchor)):
            if name in bodies:
                middle, inverse, lightest = bodies[name]
                arm = np.subtract(point, middle)
                ends.append((name, float(inverse + lightest * (arm @ arm))))
        links.append((spring, ends))
    for hinge in [hinge for hinge in scene.hinge if hinge.turned_by]:
        links += [(hinge, [(name, bodies[name][2]) for name in (hinge.solid, hinge.to) if name in bodies])]
    greatest = []  # bounds on the eigenvalues of stiffness and damping, divided by mass
    for key in ("stiffness", "damping"):
        traces = dict.fromkeys(bodies, 0.0)
        for link, ends in links:
            for name, inverse in ends:
                traces[name] += float(values.get(f"{link.name}.{key}", getattr(link, key) or 0.0)) * inverse
        greatest.append(max((sum(traces[name] for name, _ in ends) for _, ends in links), default=0.0))
    square, rate = greatest
    fastest = rate + sqrt(rate * rate + 4.0 * square)
    return 4.0 / fastest if fastest > 0.0 else inf


@dataclass(frozen=True)
class Ends(Link):
    point: Points
    """Position of the spring's first end (d,) [m], in the frame of the free body."""
    anchor: Points
    """Position of the spring's second end (d,) [m], in the frame of a moving second solid, else in space."""
    slack: bool


def ends_of(springs: Sequence[SpringTable], moved: Sequence[SolidTable]) -> list[Ends]:
    found = []
    for spring in springs:
        body, solid, fields = linked(spring, moved)
        anchor = np.array(spring.anchor) if solid is None else in_frame(solid, spring.anchor)
        found.append(Ends(*fields, in_frame(body, spring.point), anchor, spring.slack))
    return found
