"""Sensors that ride on a solid: what is at x as the scene begins is carried to c + T (x - c_0) with it.

c_0 is the middle of the solid in the scene and c where it is; T = R R_0^T is how far it is turned since. The scale of a
solid does not move its sensors. A value whose place is shifted by s and turned by a small vector t about c changes by
its ``shift`` times s and its ``twist`` times t. `Carrier.bars` turns these into derivatives by fields of the state.
"""

from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import in_space
from cortado.errors import InputError, shown
from cortado.runs.sensor import Reading, SensedScene
from cortado.scene.motions import Pose, position_name
from cortado.scene.solids import SolidTable

Axes = Literal["world", "body"]


@dataclass(frozen=True)
class Ride:
    """The solid that carries the place of a sum over particles."""

    on: str
    """Name of the solid."""
    turns: bool
    """True where the view of the particles turns with the solid; else it is along axes of the world."""

    def table(self, at: SensedScene) -> SolidTable:
        """Return the table of the solid; raise `InputError` unless it is one that moves."""
        moving = {table.name: table for table in at.solids if table.moves}
        if self.on not in moving:
            names = f", of {', '.join(map(shown, moving))}" if moving else "; the scene has none"
            raise InputError(f"A sensor is on {shown(self.on)}, but must be on a solid that moves{names}.")
        if self.turns and any(at.lattice.domain.lengths):
            raise InputError(
                f"A view that turns with the solid {shown(self.on)} has no images along periodic axes: give a sensor "
                'on it the axes "world", or read a solid_load.'
            )
        return moving[self.on]

    def carrier(self, at: Reading) -> "Carrier":
        """Return the solid as it is in a state."""
        return Carrier.of(self.table(at), at)


@dataclass(frozen=True, eq=False)
class Carrier:
    """A solid that carries sensors, in a state."""

    pose: Pose
    begun: NDArray[Any]
    """c_0, (d,) [m]"""
    turn: NDArray[Any]
    """T, (3, 3)"""

    @classmethod
    def of(cls, table: SolidTable, at: Reading) -> Self:
        """Find where a solid is in a state."""
        pose = Pose.of(table.name, table.motion == "free", at)
        return cls(pose, table.middle(), pose.rotation @ square(table.turn(at.dimension)).T)

    @property
    def flat(self) -> NDArray[Any]:
        """Return T as a matrix (d, d)."""
        return self.turn[: len(self.begun), : len(self.begun)]

    def place(self, point: NDArray[Any]) -> NDArray[Any]:
        """Return where a point (d,) of the scene as it begins has been carried [m]."""
        return np.asarray(self.pose.position + self.flat @ (point - self.begun))

    def arms(self, points: NDArray[Any]) -> NDArray[Any]:
        """Return ways (..., 3) from the middle of the solid to points (..., d) [m]."""
        return in_space(points - self.pose.position)

    def bars(self, shift: NDArray[Any], twist: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return derivatives by fields of the state, from those by the place (d,) and by a further turn (3,)."""
        return {position_name(self.pose.name): shift[None]} | self.pose.turning_bars(twist)

    def lifted(self, bar: NDArray[Any], point: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return derivatives by fields of the state, from that (d,) by where a point (d,) has been carried."""
        return self.bars(bar, np.cross(self.arms(self.place(point)), in_space(bar)))

    def carried(self, bars: NDArray[Any], points: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return derivatives by fields of the state of a value that depends on how points (n, d) lie beside the solid,
        from those (n, d) by the points."""
        return self.bars(-bars.sum(axis=0), -np.cross(self.arms(points), in_space(bars)).sum(axis=0))


def ride_of(on: str | None, turns: bool, at: SensedScene) -> Ride | None:
    """Return how a sensor rides on a solid; raise `InputError` where it cannot. None without a solid."""
    if on is None:
        return None
    ride = Ride(on, turns)
    ride.table(at)
    return ride


def square(matrix: NDArray[Any]) -> NDArray[Any]:
    """Return a rotation (d, d) as one of space, (3, 3)."""
    found = np.eye(3)
    found[: len(matrix), : len(matrix)] = matrix
    return found


def together(*each: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Add up derivatives by name."""
    found = dict[str, NDArray[Any]]()
    for bars in each:
        for name, bar in bars.items():
            found[name] = found[name] + bar if name in found else bar
    return found


def named(on: Any) -> str | None:
    """Check the name of a solid that carries a sensor, or None; raise `InputError`."""
    if on is not None and (not isinstance(on, str) or not on):
        raise InputError(f"on is {shown(on)}, but must be the name of a solid that moves.")
    return on


def axes_of(axes: Any, is_carried: bool) -> Axes:
    """Check which axes a sensor has; raise `InputError`, also for those of a body without one."""
    if not isinstance(axes, str) or axes not in ("world", "body"):
        raise InputError(f'axes is {shown(axes)}, but must be "world" or "body".')
    if axes == "body" and not is_carried:
        raise InputError('axes is "body", but must be "world", as the sensor is on no solid: give it one by on.')
    return "body" if axes == "body" else "world"
