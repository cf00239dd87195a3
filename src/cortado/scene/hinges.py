"""How free bodies are held: which ways they may go and turn, and on which hinges, to the world or to each other. These
have tables and parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import unit
from cortado.discretise.shapes import Points
from cortado.discretise.solid import Mass
from cortado.errors import InputError, Words, shown
from cortado.scene.courses import WAYS, Knots, check_over_time, values_in_file
from cortado.scene.parameters import Axis, Parameter, Range, Source
from cortado.scene.shape_tables import File
from cortado.scene.solids import SolidTable
from cortado.scene.tables import FieldPath, Length, Table, Text, Vector, field_error, quantity

Three = tuple[float, float, float]
COLUMNS = (("torque", "N m"), ("speed", "rad/s"))
"""Columns of a motor's file."""


class HingeTable(Table):
    """A hinge, about which a free body turns: one point of the body stays where it is, or stays with another solid."""

    name: Text
    """Name of the hinge."""
    solid: Text
    """Name of the body."""
    to: Text | None = None
    """Name of another solid that moves, to a point of which the body is hinged; if left out, to the world."""
    position: Vector[Length]
    """(d,) Where the hinge is at the start [m]."""
    axis: tuple[Annotated[float, quantity()], ...] | None = None
    """(3,) Direction of its axis at the start in 3-D, of any length; left out, the body turns about it in every way. In
    2-D there is none."""
    stiffness: Annotated[float, quantity("N m/rad", ge=0.0)] | None = None
    """Torque against each radian from the angle at rest [N m/rad]; in 2-D that of a metre across."""
    rest_angle: Annotated[float, quantity("rad", ge=-3.0, le=3.0)] = 0.0
    """Turn from how the scene begins at which that torque is 0 [rad]."""
    damping: Annotated[float, quantity("N m s/rad", ge=0.0)] | None = None
    """Torque against each radian a second of the turn, or of its difference from the motor's speed [N m s/rad]."""
    torque: Annotated[float, quantity("N m")] | None = None
    """Torque with which a motor turns the body [N m]."""
    speed: Annotated[float, quantity("rad/s")] | None = None
    """Angular velocity to which the damping brings the body, as a motor does [rad/s]."""
    times: tuple[Annotated[float, quantity("s", ge=0.0)], ...] | None = None
    """(k,) Times of `torques` or `speeds`, from 0 on, each greater than the one before [s]; between them values go in
    straight lines."""
    torques: tuple[Annotated[float, quantity("N m")], ...] | None = None
    """(k,) Torques of a motor at these times, in place of `torque` [N m]."""
    speeds: tuple[Annotated[float, quantity("rad/s")], ...] | None = None
    """(k,) Speeds of a motor at these times, in place of `speed` [rad/s]."""
    file: File | None = None
    """CSV file in place of `times`, `torques` and `speeds`, with the column `time` and one or both of `torque` and
    `speed`, and units in its head. A relative name begins at the scene file."""

    @property
    def turns(self) -> bool:
        """Return True where something turns the body about the hinge."""
        return any(getattr(self, key) is not None for key in ("stiffness", "damping", "torque", "speed", "times"))

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        if self.file is not None:
            return self._read(path).in_dimension(dimension, path)
        if self.axis is not None:
            if dimension == 2:
                raise field_error((*path, "axis"), self.axis, "left out in 2-D, where bodies turn about z")
            self.check_components(("axis",), dimension, path)
            if not any(self.axis):
                raise field_error((*path, "axis"), self.axis, "a vector that is not 0")
        elif dimension == 3 and self.turns:
            keys = ("stiffness", "damping", "torque", "speed", "times")
            key = next(key for key in keys if getattr(self, key) is not None)
            raise field_error((*path, key), Words("given"), "left out, as the hinge has no axis")
        lists = [name for name, _ in COLUMNS if getattr(self, f"{name}s") is not None]
        for name in lists or (["torque"] if self.times is not None else []):
            check_over_time(path, self, f"{name}s", name)
        if self.damping is None and (self.speed is not None or self.speeds is not None):
            key = "speed" if self.speed is not None else "speeds"
            raise field_error((*path, key), Words("given"), "left out, as the hinge has no damping")
        return super().in_dimension(dimension, path)

    def _read(self, path: FieldPath) -> Self:
        """Return this table with the times and values of its file, which is read once and stays as it was."""
        for key in ("torque", "speed", "times", "torques", "speeds"):
            if (found := getattr(self, key)) is not None:
                raise field_error((*path, key), found, "left out, as there is a file")
        assert self.file is not None
        try:
            times, columns = values_in_file(self.file, COLUMNS, False)
        except InputError as error:
            wanted = "the file of a motor"
            raise field_error((*path, "file"), self.file, wanted, f"cannot be used: {error}") from None
        if times[0] != 0.0:
            raise field_error((*path, "file"), self.file, "a file with times from 0 on")
        lists = {f"{name}s": tuple(values.tolist()) for name, values in columns.items()}
        return self.model_copy(update={"file": None, "times": tuple(times.tolist()), **lists})

    def course(self, name: str) -> Knots | None:
        """Return the motor's torque or speed over time; None where it is steady."""
        values = getattr(self, f"{name}s")
        return None if values is None else Knots(np.array(self.times), np.array(values))


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
        """Return how the table of a free body, or its hinge to the world among others, holds it."""
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
    """Return a vector (d,) as three numbers."""
    x, y, z = (*map(float, vector), 0.0)[:3]
    return x, y, z


def inertia_about(hold: Hold, mass: Mass) -> np.ndarray:
    """Return the inertia (3, 3) of a mass about the hinge, or about its centre without one, in the body's frame."""
    arm = np.array(hold.arm)
    return np.asarray(mass.inertia + mass.volume * (arm @ arm * np.eye(3) - np.outer(arm, arm)))


def check_hinges(hinges: Sequence[HingeTable], solids: Sequence[SolidTable], dimension: int) -> None:
    """Check that hinges are of free bodies, one to the world of each, which nothing else holds and which begin to turn
    about it, and that those between bodies make no ring."""
    free = [solid.name for solid in solids if solid.motion == "free"]
    joined = {solid.name: {solid.name} for solid in solids}
    for index, hinge in enumerate(hinges):
        path = ("hinge", index)
        if hinge.solid not in free:
            wanted = f"the name of a free body, of {shown(free)}" if free else 'of a solid whose motion is "free"'
            raise field_error((*path, "solid"), hinge.solid, wanted)
        number = next(k for k, solid in enumerate(solids) if solid.name == hinge.solid)
        if hinge.to is not None:
            _check_joint(hinge, solids, joined, path)
            continue
        if hinge.solid in [other.solid for other in hinges[:index] if other.to is None]:
            raise field_error((*path, "solid"), hinge.solid, "another one, as this one is on a hinge already")
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


def _check_joint(hinge: HingeTable, solids: Sequence[SolidTable], joined: dict[str, set[str]], path: FieldPath) -> None:
    """Check a hinge between two solids, given by name which ones those before it have joined, and add to these."""
    ends = [hinge.solid, hinge.to]
    others = [solid.name for solid in solids if solid.moves and solid.name != hinge.solid]
    if hinge.to not in others:
        wanted = f"the name of another solid that moves, of {shown(others)}" if others else "left out, for the world"
        raise field_error((*path, "to"), hinge.to, wanted)
    for number, solid in enumerate(solids):
        if solid.name in ends and solid.motion == "free" and solid.sticks:
            wanted = f'"free", as the body is on the hinge {hinge.name!r} to another solid'
            raise field_error(("solid", number, "slip"), solid.slip, wanted)
    if hinge.to in joined[hinge.solid]:
        raise field_error((*path, "to"), hinge.to, "a solid that other hinges do not join to this one already")
    whole = joined[hinge.solid] | joined[hinge.to]
    joined |= dict.fromkeys(whole, whole)


def hinge_parameters(hinge: HingeTable, dimension: int) -> list[Parameter]:
    """Return the parameters of a hinge: what turns the body, and where one to another solid is."""
    turn, of, found = "N m" if dimension == 3 else "N", (hinge.name, f"of the hinge {hinge.name}"), list[Parameter]()
    if hinge.to is not None:
        place = np.array(hinge.position)
        where, size = f"where in its solids the hinge {hinge.name} is, as they are in the scene", 0.1
        found.append(
            Parameter(
                f"{hinge.name}.position",
                "m",
                where,
                Axis.SCALAR,
                lambda source: place,
                components=lambda dimension, phases: dimension,
                change=lambda source, value: np.full(np.shape(value), size),
            )
        )
    if hinge.turns:
        not_negative = Range.NOT_NEGATIVE
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


def number_of(
    name: str, of: str, end: str, unit: str, what: str, value: float, values: Range, change: float
) -> Parameter:
    """Return the parameter of one number of a spring or a hinge; where it is 0, or may be less, ``change`` is large."""
    own = np.asarray(value, dtype=np.float64)

    def changed(source: Source, at: NDArray[Any]) -> NDArray[np.float64]:
        return np.where((np.asarray(at) == 0.0) | (values is Range.ANY), change, np.abs(at))

    return Parameter(
        f"{name}.{end}", unit, f"{what} {of}", Axis.SCALAR, lambda source: own, range=values, change=changed
    )


def in_frame(table: SolidTable, place: Any) -> Points:
    """Return a place (d,) of a solid at the start in its own frame [m]."""
    return np.asarray((np.array(place) - table.middle()) @ table.turn(len(place)))


@dataclass(frozen=True)
class Begun:
    """Where a solid is when the scene begins; the world is at the origin."""

    middle: Points
    """(3,) [m]"""
    turn: Points
    """(3, 3) the rotation from its own frame."""

    @classmethod
    def of(cls, table: SolidTable | None, dimension: int) -> Self:
        """Return where the solid of a table begins; None stands for the world."""
        middle, turn = np.zeros(3), np.eye(3)
        if table is not None:
            middle[:dimension], turn[:dimension, :dimension] = table.middle(), table.turn(dimension)
        return cls(middle, turn)


@dataclass(frozen=True)
class Joint:
    """A hinge between a free body and another solid, or the world, by their numbers."""

    name: str
    body: int
    """Number of its body among the free bodies."""
    against: int
    """Number of the other solid among the solids that move; -1 for the world."""
    other: int
    """Number of the other solid among the free bodies; -1 for one that is not free."""
    begun: tuple[Begun, Begun]
    """Where both begin."""
    axis: Points | None
    """(3,) unit vector; None for one that turns in every way."""
    turns: bool
    """True where a spring, a damper or a motor turns the body."""


def joints_of(hinges: Sequence[HingeTable], moved: Sequence[SolidTable]) -> list[Joint]:
    """Return the hinges of solids that move, which are all ``moved``."""
    numbers = {table.name: number for number, table in enumerate(moved)}
    bodies, found = [table.name for table in moved if table.motion == "free"], []
    for hinge in hinges:
        d, against = len(hinge.position), numbers.get(hinge.to or "", -1)
        axis = unit(np.array(hinge.axis)) if hinge.axis is not None else np.array([0.0, 0.0, 1.0]) if d == 2 else None
        other = bodies.index(hinge.to) if hinge.to in bodies else -1
        begun = Begun.of(moved[numbers[hinge.solid]], d), Begun.of(None if against < 0 else moved[against], d)
        found.append(Joint(hinge.name, bodies.index(hinge.solid), against, other, begun, axis, hinge.turns))
    return found
