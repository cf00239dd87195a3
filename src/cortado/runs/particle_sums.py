"""Sums over particles for sensors: weighted sums around a place, sums over a region, and loads on solids.

This module computes the sums on the host, in float64. During a run, `cortado.runs.step_sums` computes the sums on the
device.

A solid that carries a sensor moves an initial point x to c + T (x - c_0). The solid has the initial middle c_0, the
current middle c, and the rotation T since the start. Derivatives of a reading with respect to the pose of the solid are
``shift`` for the translation and ``twist`` for a small rotation about c.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import grid, in_space
from cortado.errors import InputError, shown
from cortado.runs.sensor import Cut, Reading, SensedScene, Sensor
from cortado.scene.motions import Pose, position_name
from cortado.scene.solids import SolidTable

Axes = Literal["world", "body"]
ACROSS = {1: 1.5, 2: 7.0 / np.pi}
"""Normalisation factor of the weights, by dimension."""
LEAST_REACH = 5.0
"""Smallest reach of the weights that gives an accuracy of 0.1 % [spacings]."""
Across = Callable[[NDArray[Any]], NDArray[Any]]
"""A linear function from vectors (n, d) to vectors (n, k), such as a projection onto a plane."""


@dataclass(frozen=True)
class Ride:
    on: str
    turns: bool

    def table(self, at: SensedScene) -> SolidTable:
        moving = {table.name: table for table in at.solids if table.moves}
        if self.on not in moving:
            names = f": {', '.join(map(shown, moving))}" if moving else "; the scene has none"
            raise InputError(f"A sensor is on {shown(self.on)}, but must be on a moving solid{names}.")
        if self.turns and any(at.lattice.domain.lengths):
            found = f"A sensor with axes that rotate with the solid {shown(self.on)} has no periodic images"
            raise InputError(f'{found}: take axes "world" for the sensor, or a solid_load.')
        return moving[self.on]

    def carrier(self, at: Reading) -> "Carrier":
        table = self.table(at)
        pose = Pose.of(table.name, table.motion == "free", at)
        return Carrier(pose, table.middle(), pose.rotation @ square(table.turn(at.dimension)).T)


@dataclass(frozen=True, eq=False)
class Carrier:
    pose: Pose
    begun: NDArray[Any]
    """Initial middle of the solid (d,) [m]."""
    turn: NDArray[Any]
    """Rotation of the solid since the start, (3, 3)."""

    @property
    def flat(self) -> NDArray[Any]:
        return self.turn[: len(self.begun), : len(self.begun)]

    def place(self, point: NDArray[Any]) -> NDArray[Any]:
        """Return the current position [m] of the point of the solid that was initially at ``point`` (d,) [m]."""
        return np.asarray(self.pose.position + self.flat @ (point - self.begun))

    def arms(self, points: NDArray[Any]) -> NDArray[Any]:
        """Return vectors (..., 3) from the middle of the solid to points (..., d) [m]."""
        return in_space(points - self.pose.position)

    def bars(self, shift: NDArray[Any], twist: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Convert derivatives along a translation (d,) and a small rotation (3,) to adjoints of state fields."""
        return {position_name(self.pose.name): shift[None]} | self.pose.turning_bars(twist)

    def lifted(self, bar: NDArray[Any], point: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Convert the derivative ``bar`` (d,) along the current place of ``point`` (d,) to adjoints of state fields."""
        return self.bars(bar, np.cross(self.arms(self.place(point)), in_space(bar)))

    def carried(self, bars: NDArray[Any], points: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Convert derivatives (n, d) along points (n, d) in the frame of the solid to adjoints of state fields."""
        return self.bars(-bars.sum(axis=0), -np.cross(self.arms(points), in_space(bars)).sum(axis=0))


def ride_of(on: str | None, turns: bool, at: SensedScene) -> Ride | None:
    if on is None:
        return None
    ride = Ride(on, turns)
    ride.table(at)
    return ride


def square(turn: NDArray[Any]) -> NDArray[Any]:
    """Extend a rotation (d, d) to a rotation matrix (3, 3)."""
    found = np.eye(3)
    found[: len(turn), : len(turn)] = turn
    return found


def together(*each: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    found = dict[str, NDArray[Any]]()
    for bars in each:
        for name, bar in bars.items():
            found[name] = found[name] + bar if name in found else bar
    return found


def axes_of(axes: Any, is_carried: bool) -> Axes:
    if not isinstance(axes, str) or axes not in ("world", "body"):
        raise InputError(f'axes is {shown(axes)}, but must be "world" or "body".')
    if axes == "body" and not is_carried:
        raise InputError('axes is "body", but must be "world", as no solid carries the sensor: name a solid by on.')
    return "body" if axes == "body" else "world"


def weights_of(q: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the weights w(q) = (1 - q)^4 (1 + 4 q), which are 0 for q > 1, and the derivatives w'(q) / q (Wendland
    1995). The argument q is the distance divided by the reach."""
    rest = np.clip(1.0 - q, 0.0, None)
    return rest**4 * (1.0 + 4.0 * q), -20.0 * rest**3


@dataclass(frozen=True, eq=False)
class Around:
    """The position of a sensor, and the function that measures distances from the sensor."""

    place: NDArray[Any]
    reach: float
    across: Across
    parts: NDArray[Any] | None = None
    """Positions of the parts of a particle relative to the particle (m, d) [m], or None for an undivided particle."""

    def carried(self, carrier: Carrier, turns: bool) -> "Around":
        """With ``turns``, the axes of the sensor rotate with the solid."""
        place, turn = carrier.place(self.place), carrier.flat
        if not turns:
            return replace(self, place=place)
        parts = None if self.parts is None else self.parts @ turn.T
        return replace(self, place=place, across=lambda way: self.across(way @ turn), parts=parts)

    def shifts(self) -> NDArray[Any]:
        """Return the vectors (m, k) from a particle to its parts."""
        return self.across(np.zeros((1, len(self.place))) if self.parts is None else self.parts)


@dataclass(frozen=True)
class Image:
    """Weights of the particles, or of one part of each particle, near one periodic image of a sensor."""

    near: NDArray[np.int_]
    ways: NDArray[Any]
    weights: NDArray[Any]
    slopes: NDArray[Any]
    """Derivatives of the weights, w'(q) / q in `weights_of`."""


@dataclass(frozen=True)
class Seen:
    images: list[Image]
    particles: int
    parts: int
    reach: float

    @classmethod
    def of(cls, at: Reading, around: Around) -> "Seen":
        place, reach, across, shifts = around.place, around.reach, around.across, around.shifts()
        widest = reach + float(np.linalg.norm(shifts, axis=1).max())
        positions, domain, numbers = at["positions"], at.lattice.domain, np.arange(len(at["positions"]))
        if not any(domain.lengths):  # most particles are far away
            axes = across(np.eye(at.dimension))
            axes = axes[:, axes.any(axis=0)]
            rough = positions @ axes
            rough -= place @ axes
            numbers = np.flatnonzero(np.einsum("ij,ij->i", rough, rough) < (1.0 + 1e-9) * widest**2)
        images = []
        for way in domain.ways(positions[numbers], place, widest, across):
            close = np.flatnonzero(np.linalg.norm(way, axis=1) < widest)
            for shift in shifts:
                own = way[close] + shift
                images.append(Image(numbers[close], own, *weights_of(np.linalg.norm(own, axis=1) / reach)))
        return cls(images, len(at["positions"]), len(shifts), reach)

    @property
    def weights(self) -> NDArray[Any]:
        """Weights of particles (n,), averaged over the parts of a particle and summed over periodic images."""
        found = np.zeros(self.particles)
        for image in self.images:
            found[image.near] += image.weights
        return found / self.parts

    def pulled(self, factors: NDArray[Any] | float) -> NDArray[Any]:
        """Convert derivatives by weights (n,) to derivatives by the vectors (n, k) from the place to the particles."""
        each, found = np.broadcast_to(factors, self.particles), np.zeros((self.particles, self.images[0].ways.shape[1]))
        for image in self.images:
            found[image.near] += (each[image.near] * image.slopes / self.reach**2)[:, None] * image.ways
        return found / self.parts


def reach_of(given: float | None, at: Cut) -> float:
    if given is not None:
        return given
    return max(2.0 * at.lattice.support, LEAST_REACH * at.lattice.cell ** (1.0 / at.dimension))


def parts_of(reach: float, at: Cut, across: Across, axes: int) -> NDArray[Any]:
    """Return the positions (m, d) [m] of a particle's parts relative to the particle, divided along ``axes`` axes."""
    spacing = at.lattice.cell ** (1.0 / at.dimension)
    count = min(int(np.ceil(LEAST_REACH * spacing / reach * (1.0 - 1e-9))), 40)  # parts at most
    best = np.argsort(-np.linalg.norm(across(np.eye(at.dimension)), axis=1), kind="stable")[:axes]
    along = spacing * ((np.arange(count) + 0.5) / count - 0.5)
    return grid([along if axis in best else np.zeros(1) for axis in range(at.dimension)])


class Summed(Sensor):
    """Base class of sensors whose readings are computed from one sum over particles and from the poses of solids."""

    def __repr__(self) -> str:
        given = [value for name, value in vars(self).items() if not name.startswith("_")]
        shown = (repr(value.tolist() if isinstance(value, np.ndarray) else value) for value in given)
        return f"{type(self).__name__}({', '.join(shown)})"

    def value(self, at: Reading) -> NDArray[Any]:
        return self.reading(at, self.summed(at).on_host(at))

    @abstractmethod
    def summed(self, at: SensedScene) -> "ParticleSum": ...

    @abstractmethod
    def reading(self, at: Reading, found: NDArray[Any]) -> NDArray[Any]:
        """Return the reading (k,), given the sum (6,). The reading uses only the poses of solids in the state."""


class LoadSensor(Summed):
    """Base class of sensors of a force and its torque. In 2-D, force and torque are per metre of thickness."""

    def columns(self, dimension: int) -> dict[str, str]:
        force, torque = ("N", "N m") if dimension == 3 else ("N/m", "N")
        turning = ["torque_x", "torque_y", "torque_z"] if dimension == 3 else ["torque"]
        return dict.fromkeys(["force_x", "force_y", "force_z"][:dimension], force) | dict.fromkeys(turning, torque)

    def reading(self, at: Reading, found: NDArray[Any]) -> NDArray[Any]:
        return in_the_scene(found, at.dimension)


@dataclass(frozen=True, eq=False)
class WeightedSum:
    """Sums around a place: the sum of weights, and the sum of weights times a quantity or a velocity component."""

    around: Around
    quantity: str | None = None
    along: NDArray[Any] | None = None
    ride: Ride | None = None

    def on_host(self, at: Reading) -> NDArray[Any]:
        weights, found = self.seen(at).weights, np.zeros(6)
        found[0] = weights.sum()
        if self.quantity is not None:
            found[1] = (weights * at[self.quantity]).sum()
        elif self.along is not None:
            found[1] = (weights * (at["velocities"] @ self.along)).sum()
        return found

    def seen(self, at: Reading) -> Seen:
        ride, around = self.ride, self.around
        return Seen.of(at, around if ride is None else around.carried(ride.carrier(at), ride.turns))


@dataclass(frozen=True, eq=False)
class RegionSum:
    """Force and torque of the quantity "wall_force", summed over the particles in a box."""

    lower: NDArray[Any]
    upper: NDArray[Any]
    about: NDArray[Any]
    quantity: str = "wall_force"
    ride: Ride | None = None

    def on_host(self, at: Reading) -> NDArray[Any]:
        arms, force = map(in_space, self.chosen(at))
        return np.concatenate([force.sum(axis=0), np.cross(arms, force).sum(axis=0)])

    def chosen(self, at: Reading) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return vectors (n, d) from ``about`` to the particles, and forces (n, d), which are 0 outside the box."""
        if self.ride is not None:
            carrier, force = self.ride.carrier(at), at["wall_force"]
            arms = (at["positions"] - carrier.place(self.about)) @ carrier.flat
            places = self.about + arms
            inside = np.all((places >= self.lower) & (places < self.upper), axis=1)
            return arms, np.where(inside[:, None], force @ carrier.flat, 0.0)
        places, inside = at.lattice.domain.within(at["positions"], self.lower, self.upper)
        return places - self.about, np.where(inside[:, None], at["wall_force"], 0.0)


@dataclass(frozen=True)
class LoadSum:
    """The load on a solid, or 0 for a sensor that only measures the motion of solids."""

    quantity: str | None = None

    def on_host(self, at: Reading) -> NDArray[Any]:
        if self.quantity is None:
            return np.zeros(6)
        load, d = at[self.quantity], at.dimension
        return np.concatenate([in_space(load[:d]), load[d:] if d == 3 else np.pad(load[d:], (2, 0))])


ParticleSum = WeightedSum | RegionSum | LoadSum


def load_bars(bar: NDArray[Any], dimension: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Split the adjoint of a load into the adjoints of force (3,) and torque (3,)."""
    if dimension == 3:
        return bar[:3], bar[3:]
    return in_space(bar[:2]), np.array([0.0, 0.0, bar[2]])


def turned(found: NDArray[Any], turn: NDArray[Any]) -> NDArray[Any]:
    """Rotate force and torque (6,) by a matrix (3, 3)."""
    return np.asarray((found.reshape(2, 3) @ turn.T).ravel())


def in_the_scene(found: NDArray[Any], dimension: int) -> NDArray[Any]:
    """Return the components of force and torque (..., 6) in 3-D, or (..., 3) in 2-D."""
    return found if dimension == 3 else found[..., [0, 1, 5]]
