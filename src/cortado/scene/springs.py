"""How free bodies are held: which ways they may go and turn, on which hinges and by which springs. These have tables
and parameters, and bound the time step.
"""

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
from cortado.scene.courses import WAYS, Knots, check_over_time
from cortado.scene.motions import mass_of_one, weight_name
from cortado.scene.parameter_values import Arrays
from cortado.scene.parameters import Axis, Parameter, Range, Source
from cortado.scene.solids import SolidTable
from cortado.scene.tables import FieldPath, Flag, Length, Table, Text, Vector, field_error, quantity

Three = tuple[float, float, float]


class HingeTable(Table):
    """A hinge, about which a free body turns: one point of the body stays where it is."""

    name: Text
    """Name of the hinge."""
    solid: Text
    """Name of the body."""
    position: Vector[Length]
    """(d,) Where the hinge is [m]."""
    axis: tuple[Annotated[float, quantity()], ...] | None = None
    """(3,) Direction of its axis in 3-D, of any length; left out, the body turns about it in every way. In 2-D there is
    none."""
    stiffness: Annotated[float, quantity("N m/rad", ge=0.0)] | None = None
    """Torque against each radian from the angle at rest [N m/rad]; in 2-D that of a metre across."""
    rest_angle: Annotated[float, quantity("rad", ge=-3.0, le=3.0)] = 0.0
    """Turn from how the scene begins at which that torque is 0 [rad]."""
    damping: Annotated[float, quantity("N m s/rad", ge=0.0)] | None = None
    """Torque against each radian a second of the turn [N m s/rad]."""
    torque: Annotated[float, quantity("N m")] | None = None
    """Torque with which a motor turns the body [N m]."""
    times: tuple[Annotated[float, quantity("s", ge=0.0)], ...] | None = None
    """(k,) Times of `torques`, from 0 on, each greater than the one before [s]; between them torques go in straight
    lines."""
    torques: tuple[Annotated[float, quantity("N m")], ...] | None = None
    """(k,) Torques of a motor at these times, in place of `torque` [N m]."""

    @property
    def turns(self) -> bool:
        """Return True where something turns the body about the hinge."""
        return any(value is not None for value in (self.stiffness, self.damping, self.torque, self.times))

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        if self.axis is not None:
            if dimension == 2:
                raise field_error((*path, "axis"), self.axis, "left out in 2-D, where bodies turn about z")
            self.check_components(("axis",), dimension, path)
            if not any(self.axis):
                raise field_error((*path, "axis"), self.axis, "a vector that is not 0")
        elif dimension == 3 and self.turns:
            key = next(key for key in ("stiffness", "damping", "torque", "times") if getattr(self, key) is not None)
            raise field_error((*path, key), Words("given"), "left out, as the hinge has no axis")
        self._check_torques(path)
        return super().in_dimension(dimension, path)

    @property
    def course(self) -> Knots | None:
        """Return the torque of the motor over time; None where it is steady."""
        return None if self.times is None else Knots(np.array(self.times), np.array(self.torques))

    def _check_torques(self, path: FieldPath) -> None:
        if self.times is not None or self.torques is not None:
            check_over_time(path, self, "torques", "torque")


@dataclass(frozen=True)
class Hold:
    """How a free body is held. See `cortado.sph.moving_solids`."""

    moving: Three = (1.0, 1.0, 1.0)
    """1 along axes of space along which its middle may go, else 0."""
    turning: int = 3
    """Number of axes of space about which it may turn; 3 also in the plane where it turns."""
    axis: Three = (0.0, 0.0, 0.0)
    """Unit vector along the one axis about which it may turn, or along that about which it may not, if they are two."""
    arm: Three = (0.0, 0.0, 0.0)
    """From its centre of mass to its hinge, in its own frame [m]; 0 without a hinge."""

    @classmethod
    def of(cls, table: SolidTable, dimension: int, hinges: Sequence[HingeTable] = ()) -> Self:
        """Return how the table of a free body, or its hinge among others, holds it."""
        for hinge in hinges:
            if hinge.solid == table.name:
                arm = (np.array(hinge.position) - table.middle()) @ table.turn(dimension)
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
    """Return a vector (d,) as three numbers."""
    x, y, z = (*map(float, vector), 0.0)[:3]
    return x, y, z


def inertia_about(hold: Hold, mass: Mass) -> np.ndarray:
    """Return the inertia (3, 3) of a mass about the hinge, or about its centre without one, in the body's frame."""
    arm = np.array(hold.arm)
    return np.asarray(mass.inertia + mass.volume * (arm @ arm * np.eye(3) - np.outer(arm, arm)))


def check_hinges(hinges: Sequence[HingeTable], solids: Sequence[SolidTable], dimension: int) -> None:
    """Check that hinges are of free bodies, one of each, which nothing else holds and which begin to turn about it."""
    free = [solid.name for solid in solids if solid.motion == "free"]
    for index, hinge in enumerate(hinges):
        path = ("hinge", index)
        if hinge.solid not in free:
            wanted = f"the name of a free body, of {shown(free)}" if free else 'of a solid whose motion is "free"'
            raise field_error((*path, "solid"), hinge.solid, wanted)
        if hinge.solid in [other.solid for other in hinges[:index]]:
            raise field_error((*path, "solid"), hinge.solid, "another one, as this one is on a hinge already")
        number = next(k for k, solid in enumerate(solids) if solid.name == hinge.solid)
        solid = solids[number]
        for key in ("freedom", "velocity"):
            if getattr(solid, key) is not None:
                wanted = f"left out, as the solid is on the hinge {hinge.name!r}"
                raise field_error(("solid", number, key), Words("given"), wanted)
        if hinge.axis is not None and solid.angular_velocity is not None:
            across = np.cross(unit(np.array(hinge.axis)), solid.angular_velocity)
            if np.abs(across).max() > 1e-9 * np.abs(solid.angular_velocity).max():
                wanted = f"along the axis of the hinge {hinge.name!r}, {shown(hinge.axis)}"
                raise field_error(("solid", number, "angular_velocity"), solid.angular_velocity, wanted)


class SpringTable(Table):
    """A spring with a damper, from a point of a free body to a point of another solid or to a place of the world."""

    name: Text
    """Name of the spring, with which those of its parameters begin."""
    solid: Text
    """Name of the free body that it pulls."""
    point: Vector[Length]
    """(d,) Where it holds the body at the start, in the scene [m]."""
    to: Text | None = None
    """Name of the solid at its other end; if left out that is a place of the world."""
    anchor: Vector[Length]
    """(d,) Where its other end is at the start, in the scene [m]."""
    stiffness: Annotated[float, quantity("N/m", gt=0.0)]
    """Force for each metre by which it is longer than at rest [N/m]; in 2-D that of a metre across."""
    rest_length: Annotated[float, quantity("m", ge=0.0)] | None = None
    """Length at which it pulls with no force [m]; as long as at the start if left out."""
    preload: Annotated[float, quantity("N")] | None = None
    """Force with which it pulls at the start [N], in place of a length at rest."""
    damping: Annotated[float, quantity("N s/m", ge=0.0)] = 0.0
    """Force for each metre a second by which it gets longer [N s/m]."""
    slack: Flag = False
    """Whether it only pulls, and is slack where it is shorter than at rest, as a mooring line is."""

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
        """Return its length at the start [m]."""
        return (
            float(np.linalg.norm(np.subtract(self.anchor, self.point))) if len(self.anchor) == len(self.point) else 0.0
        )

    @property
    def length_at_rest(self) -> float:
        """Return its length at rest [m]."""
        if self.rest_length is not None:
            return self.rest_length
        return self.length - (self.preload or 0.0) / self.stiffness


def check_springs(springs: Sequence[SpringTable], hinges: Sequence[HingeTable], solids: Sequence[SolidTable]) -> None:
    """Check that springs are between a free body and another solid, or the world, and have names of their own, as
    hinges have."""
    names = [solid.name for solid in solids]
    for index, hinge in enumerate(hinges):
        if hinge.name in names:
            raise field_error(("hinge", index, "name"), hinge.name, "another name than those of the solids")
    free = [solid.name for solid in solids if solid.motion == "free"]
    for index, spring in enumerate(springs):
        path = ("spring", index)
        if spring.name in [*names, *(hinge.name for hinge in hinges)]:
            raise field_error((*path, "name"), spring.name, "another name than those of the solids and hinges")
        if spring.solid not in free:
            wanted = f"the name of a free body, of {shown(free)}" if free else 'of a solid whose motion is "free"'
            raise field_error((*path, "solid"), spring.solid, wanted)
        if spring.to == spring.solid:
            raise field_error((*path, "to"), spring.to, "another solid than that of the other end")
        if spring.to is not None and spring.to not in names:
            raise field_error((*path, "to"), spring.to, f"the name of a solid, of {shown(names)}")


def spring_parameters(scene: Any) -> list[Parameter]:
    """Return the parameters of a scene's springs, and of hinges that turn what is on them."""
    pull, turn = ("N/m", "N m") if scene.dimension == 3 else ("N/m²", "N")
    positive, not_negative, found = Range.POSITIVE, Range.NOT_NEGATIVE, []
    for spring in scene.spring:
        of, k = (spring.name, f"of the spring {spring.name}"), spring.stiffness
        found += [
            _number(*of, "stiffness", pull, "the stiffness", k, positive, 0.1 * k),
            _number(*of, "rest_length", "m", "the length at rest", spring.length_at_rest, not_negative, 0.1),
            _number(*of, "damping", f"{pull} s", "the damping", spring.damping, not_negative, 0.1 * k),
        ]
    for hinge in scene.hinge:
        if hinge.turns:
            of, course = (hinge.name, f"of the hinge {hinge.name}"), hinge.course
            values = hinge.torque or 0.0 if course is None else course.values
            size, begun = float(np.abs(values).max()) or 1.0, float(np.ravel(values)[0])
            torque = _number(*of, "torque", turn, "the torque in each step", begun, Range.ANY, size)
            found += [
                _number(*of, "stiffness", f"{turn}/rad", "the stiffness", hinge.stiffness or 0.0, not_negative, 1.0),
                _number(*of, "rest_angle", "rad", "the angle at rest", hinge.rest_angle, Range.ANY, 1.0),
                _number(*of, "damping", f"{turn} s/rad", "the damping", hinge.damping or 0.0, not_negative, 1.0),
                replace(torque, axis=Axis.STEP, course=course),
            ]
    return found


def _number(
    name: str, of: str, end: str, unit: str, what: str, value: float, values: Range, change: float
) -> Parameter:
    """Return the parameter of one number of a spring or a hinge; where it is 0, or may be less, ``change`` is large."""
    own = np.asarray(value, dtype=np.float64)

    def changed(source: Source, at: NDArray[Any]) -> NDArray[np.float64]:
        return np.where((np.asarray(at) == 0.0) | (values is Range.ANY), change, np.abs(at))

    return Parameter(
        f"{name}.{end}", unit, f"{what} {of}", Axis.SCALAR, lambda source: own, range=values, change=changed
    )


@dataclass(frozen=True)
class _Yielding:
    """A free body as springs find it."""

    table: SolidTable
    mass: float
    """[kg]"""
    lightest: float
    """The greatest eigenvalue of the inverse of its inertia [1/(kg m2)]."""

    def at(self, point: Any) -> float:
        """Return the greatest inverse of the mass that a force at a point (d,) of it at the start sees [1/kg]."""
        arm = np.subtract(point, self.table.middle())
        return float(1.0 / self.mass + self.lightest * (arm @ arm))


NUMBERS = ("stiffness", "damping")
"""Keys of springs and hinges that bound the steps."""


def spring_limit(scene: Any, values: Arrays) -> float:
    """Return the longest step [s] that is stable with the scene's springs, 4 / (c + sqrt(c^2 + 4 w^2)). Their greatest
    frequency w and rate of damping c are both bounds, without the water that goes along with bodies."""
    bodies = {}
    for table in scene.solid:
        if table.motion == "free":
            one, weight = mass_of_one(table), float(values.get(weight_name(table), table.mass or table.density))
            inertia = inertia_about(Hold.of(table, scene.dimension, scene.hinge), one)
            lightest = np.linalg.eigvalsh(np.linalg.pinv(weight * inertia)).max()
            bodies[table.name] = _Yielding(table, weight * one.volume, float(lightest))
    ends: list[tuple[str, list[tuple[str, float]]]] = []
    for spring in scene.spring:
        both = ((spring.solid, spring.point), (spring.to, spring.anchor))
        ends.append((spring.name, [(name, bodies[name].at(place)) for name, place in both if name in bodies]))
    ends += [(hinge.name, [(hinge.solid, bodies[hinge.solid].lightest)]) for hinge in scene.hinge if hinge.turns]
    known = dict(values)
    for one in (*scene.spring, *scene.hinge):
        for end in NUMBERS:
            known.setdefault(f"{one.name}.{end}", np.array(getattr(one, end) or 0.0))
    square, rate = (_greatest(ends, known, end) for end in NUMBERS)
    fastest = rate + sqrt(rate * rate + 4.0 * square)
    return 4.0 / fastest if fastest > 0.0 else inf


def _greatest(ends: Sequence[tuple[str, list[tuple[str, float]]]], values: Arrays, key: str) -> float:
    """Return a bound of the greatest eigenvalue of J^T M^-1 J K: the sum over both bodies of a spring of the traces of
    all springs at them."""
    traces: dict[str, float] = {}
    for name, bodies in ends:
        for body, inverse in bodies:
            traces[body] = traces.get(body, 0.0) + float(values[f"{name}.{key}"]) * inverse
    return max((sum(traces[body] for body, _ in bodies) for _, bodies in ends), default=0.0)


@dataclass(frozen=True)
class Turned:
    """What turns a body about the axis of its hinge."""

    name: str
    body: int
    """Number of the body among the free bodies."""
    axis: Points
    """(3,) unit vector."""
    begun: Points
    """(3, 3) the rotation with which the scene begins."""


@dataclass(frozen=True)
class Ends:
    """A spring between solids by their numbers."""

    name: str
    body: int
    """Number of its body among the free bodies."""
    against: int
    """Number of the other solid among the solids that move; -1 for one at rest and for the world."""
    other: int
    """Number of the other solid among the free bodies; -1 for one that is not free."""
    point: Points
    """(d,) of its body, in the body's frame [m]."""
    anchor: Points
    """(d,) of the other solid, in its frame [m]; of the world if that does not move."""
    slack: bool


def ends_of(springs: Sequence[SpringTable], moved: Sequence[SolidTable]) -> list[Ends]:
    """Return the ends of springs between solids that move, which are all ``moved``, and the world."""
    numbers = {table.name: number for number, table in enumerate(moved)}
    bodies = [table.name for table in moved if table.motion == "free"]
    found = []
    for spring in springs:
        own, against = moved[numbers[spring.solid]], numbers.get(spring.to or "", -1)
        other = bodies.index(spring.to) if spring.to in bodies else -1
        anchor = np.array(spring.anchor) if against < 0 else _in_frame(moved[against], spring.anchor)
        point = _in_frame(own, spring.point)
        found.append(Ends(spring.name, bodies.index(own.name), against, other, point, anchor, spring.slack))
    return found


def _in_frame(table: SolidTable, place: Any) -> Points:
    """Return a place (d,) of a solid at the start in its own frame [m]."""
    return np.asarray((np.array(place) - table.middle()) @ table.turn(len(place)))


def turned_by(hinges: Sequence[HingeTable], moved: Sequence[SolidTable]) -> list[Turned]:
    """Return what turns bodies about hinges, where something does; ``moved`` are all solids that move."""
    bodies, found = [table for table in moved if table.motion == "free"], []
    for hinge in hinges:
        if hinge.turns:
            number = next(k for k, table in enumerate(bodies) if table.name == hinge.solid)
            axis, begun = np.array([0.0, 0.0, 1.0]) if hinge.axis is None else unit(np.array(hinge.axis)), np.eye(3)
            d = len(hinge.position)
            begun[:d, :d] = bodies[number].turn(d)
            found.append(Turned(hinge.name, number, axis, begun))
    return found
