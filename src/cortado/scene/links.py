"""How free bodies are held: which ways they may go and turn, and on which hinges."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, Self

import numpy as np

from cortado.arrays import unit
from cortado.discretise.solid import Mass
from cortado.errors import Words, shown
from cortado.scene.courses import WAYS, Knots
from cortado.scene.solids import SolidTable
from cortado.scene.tables import MISSING, FieldPath, Length, Table, Text, Vector, field_error, quantity

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
        times, torques = self.times or (), self.torques
        if self.times is None and torques is None:
            return
        if len(times) < 2 or times[0] != 0.0 or any(b <= a for a, b in pairwise(times)):
            wanted = "at least two times, from 0 on, each greater than the one before"
            raise field_error((*path, "times"), MISSING if self.times is None else times, wanted)
        if torques is None or len(torques) != len(times):
            found = MISSING if torques is None else Words(f"a list of {len(torques)}")
            raise field_error((*path, "torques"), found, f"a list of {len(times)}, as are times")
        if self.torque is not None:
            raise field_error((*path, "torque"), self.torque, "left out, as there are torques")


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
