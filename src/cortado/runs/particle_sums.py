"""Sums over particles that sensors read: weighted sums around a place, sums over a region, and loads on solids. This
module computes them on the host in NumPy, in float64. In a run `cortado.runs.step_sums` computes them on the device.

A sensor may ride on a solid, which carries an initial point x to c + T (x - c_0). Here c_0 is the initial middle of the
solid, c the present one, and T = R R_0^T the rotation since the start. The scale of a solid does not move its sensors.
If the place is shifted by s and turned by a small vector t about c, the value changes by ``shift`` . s + ``twist`` . t.
`Carrier.bars` converts both factors to derivatives with respect to fields of the state.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import grid, in_space
from cortado.errors import InputError, shown
from cortado.runs.sensor import Cut, Reading, SensedScene, Sensor
from cortado.scene.motions import Pose, position_name
from cortado.scene.solids import SolidTable

Axes = Literal["world", "body"]


@dataclass(frozen=True)
class Ride:
    """The solid on which the place of a sum over particles rides."""

    on: str
    """Name of the solid."""
    turns: bool
    """True if the sensor's axes turn with the solid; else they are the world's axes."""

    def table(self, at: SensedScene) -> SolidTable:
        """Return the table of the solid; raise `InputError` unless the solid moves."""
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
        """Return the solid at its pose in the state ``at``."""
        return Carrier.of(self.table(at), at)


@dataclass(frozen=True, eq=False)
class Carrier:
    """A solid that carries sensors, at its pose in a state."""

    pose: Pose
    begun: NDArray[Any]
    """c_0, (d,) [m]"""
    turn: NDArray[Any]
    """T, (3, 3)"""

    @classmethod
    def of(cls, table: SolidTable, at: Reading) -> Self:
        """Read a solid's pose from a state."""
        pose = Pose.of(table.name, table.motion == "free", at)
        return cls(pose, table.middle(), pose.rotation @ square(table.turn(at.dimension)).T)

    @property
    def flat(self) -> NDArray[Any]:
        """Return T as a matrix (d, d)."""
        return self.turn[: len(self.begun), : len(self.begun)]

    def place(self, point: NDArray[Any]) -> NDArray[Any]:
        """Return the place [m] to which the solid has carried an initial point (d,)."""
        return np.asarray(self.pose.position + self.flat @ (point - self.begun))

    def arms(self, points: NDArray[Any]) -> NDArray[Any]:
        """Return vectors (..., 3) from the middle of the solid to points (..., d) [m]."""
        return in_space(points - self.pose.position)

    def bars(self, shift: NDArray[Any], twist: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return derivatives with respect to fields of the state, given those with respect to a shift (d,) and a small
        rotation (3,)."""
        return {position_name(self.pose.name): shift[None]} | self.pose.turning_bars(twist)

    def lifted(self, bar: NDArray[Any], point: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return derivatives with respect to fields of the state, given the derivative (d,) with respect to the carried
        place of ``point`` (d,)."""
        return self.bars(bar, np.cross(self.arms(self.place(point)), in_space(bar)))

    def carried(self, bars: NDArray[Any], points: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Return derivatives with respect to fields of the state of a value that depends on points (n, d) relative to
        the solid. ``bars`` (n, d) are its derivatives with respect to the points."""
        return self.bars(-bars.sum(axis=0), -np.cross(self.arms(points), in_space(bars)).sum(axis=0))


def ride_of(on: str | None, turns: bool, at: SensedScene) -> Ride | None:
    """Return the ride of a sensor on a solid, None without a solid; raise `InputError` if the solid cannot carry
    sensors."""
    if on is None:
        return None
    ride = Ride(on, turns)
    ride.table(at)
    return ride


def square(matrix: NDArray[Any]) -> NDArray[Any]:
    """Extend a rotation matrix (d, d) to three dimensions, (3, 3)."""
    found = np.eye(3)
    found[: len(matrix), : len(matrix)] = matrix
    return found


def together(*each: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Add tables of derivatives, name by name."""
    found = dict[str, NDArray[Any]]()
    for bars in each:
        for name, bar in bars.items():
            found[name] = found[name] + bar if name in found else bar
    return found


def named(on: Any) -> str | None:
    """Check the name of a solid that carries a sensor, or None; raise `InputError` for anything else."""
    if on is not None and (not isinstance(on, str) or not on):
        raise InputError(f"on is {shown(on)}, but must be the name of a solid that moves.")
    return on


def axes_of(axes: Any, is_carried: bool) -> Axes:
    """Check a sensor's axes, "world" or "body"; raise `InputError` for anything else, and for "body" without a
    solid."""
    if not isinstance(axes, str) or axes not in ("world", "body"):
        raise InputError(f'axes is {shown(axes)}, but must be "world" or "body".')
    if axes == "body" and not is_carried:
        raise InputError('axes is "body", but must be "world", as the sensor is on no solid: give it one by on.')
    return "body" if axes == "body" else "world"


ACROSS = {1: 1.5, 2: 7.0 / np.pi}
"""Normalisation of w by number of dimensions: this factor / reach^dimensions gives w the integral 1."""
LEAST_REACH = 5.0
"""Reach in spacings with which the weights of a lattice add up to 1 within 0.1 %, wherever the sensor's plane or column
lies."""
MOST_PARTS = 40
"""Greatest number of parts along an axis: enough for a reach of half a spacing; smaller reaches cause a warning."""


@dataclass(frozen=True)
class Weights:
    """Weights w(q) = (1 - q)^4 (1 + 4 q), 0 for q > 1, where q is distance / reach (Wendland 1995)."""

    values: NDArray[Any]
    """w"""
    slopes: NDArray[Any]
    """w'(q) / q"""

    @classmethod
    def of(cls, q: NDArray[Any]) -> "Weights":
        """Compute the weights at distances (n,)."""
        rest = np.clip(1.0 - q, 0.0, None)
        return cls(rest**4 * (1.0 + 4.0 * q), -20.0 * rest**3)


Across = Callable[[NDArray[Any]], NDArray[Any]]
"""A sensor's projection: a linear function from vectors (n, d) to vectors (n, k)."""


@dataclass(frozen=True, eq=False)
class Around:
    """A place, and the way a sensor measures distances of particles from it."""

    place: NDArray[Any]
    """(d,) [m]"""
    reach: float
    """Distance [m] beyond which the weight of particles is 0."""
    across: Across
    parts: NDArray[Any] | None = None
    """(m, d) positions [m] of a particle's equal parts relative to the particle; None for one point."""

    def carried(self, carrier: Carrier, turns: bool) -> "Around":
        """Return this view moved with a solid: its place, and if it ``turns``, also its axes and parts."""
        place, turn = carrier.place(self.place), carrier.flat
        if not turns:
            return replace(self, place=place)
        parts = None if self.parts is None else self.parts @ turn.T
        return replace(self, place=place, across=lambda way: self.across(way @ turn), parts=parts)

    def shifts(self) -> NDArray[Any]:
        """Return the projected vectors (m, k) from a particle to its parts."""
        return self.across(np.zeros((1, len(self.place))) if self.parts is None else self.parts)


@dataclass(frozen=True)
class Image:
    """The particles with a weight above 0, for one periodic image and one of the parts of each particle."""

    near: NDArray[np.int_]
    """(m,) indices of the particles"""
    ways: NDArray[Any]
    """(m, k) vectors from the place to the particles [m]"""
    weights: Weights
    """(m,) weights of the particles"""


@dataclass(frozen=True)
class Seen:
    """The particles around a place, including all periodic images close to it."""

    images: list[Image]
    """Periodic images near the place, of each part of a particle."""
    particles: int
    """Number n of particles."""
    parts: int
    """Number of parts into which a particle is divided."""
    reach: float
    """Distance [m] beyond which the weight of particles is 0."""

    @classmethod
    def of(cls, at: Reading, around: Around) -> "Seen":
        """Find the particles of a state around a place."""
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
                images.append(Image(numbers[close], own, Weights.of(np.linalg.norm(own, axis=1) / reach)))
        return cls(images, len(at["positions"]), len(shifts), reach)

    @property
    def weights(self) -> NDArray[Any]:
        """Return the weights (n,) of particles, the mean over their parts, summed over their images."""
        found = np.zeros(self.particles)
        for image in self.images:
            found[image.near] += image.weights.values
        return found / self.parts

    def pulled(self, factors: NDArray[Any] | float) -> NDArray[Any]:
        """Return the derivative (n, k) with respect to the vectors, given that with respect to the weights (n,)."""
        each, found = np.broadcast_to(factors, self.particles), np.zeros((self.particles, self.images[0].ways.shape[1]))
        for image in self.images:
            found[image.near] += (each[image.near] * image.weights.slopes / self.reach**2)[:, None] * image.ways
        return found / self.parts


def reach_of(given: float | None, at: Cut) -> float:
    """Return the distance [m] from a plane or an axis up to which particles count: the given one, else the larger of
    two support radii and five spacings."""
    if given is not None:
        return given
    return max(2.0 * at.lattice.support, LEAST_REACH * at.lattice.cell ** (1.0 / at.dimension))


def parts_of(reach: float, at: Cut, across: Across, axes: int) -> NDArray[Any]:
    """Return the positions (m, d) of a particle's parts relative to the particle [m]. The parts are evenly spaced in
    its cell, along the ``axes`` axes with the largest projections. `LEAST_REACH` parts per reach make the weights of a
    lattice add up to 1."""
    spacing = at.lattice.cell ** (1.0 / at.dimension)
    count = min(int(np.ceil(LEAST_REACH * spacing / reach * (1.0 - 1e-9))), MOST_PARTS)
    best = np.argsort(-np.linalg.norm(across(np.eye(at.dimension)), axis=1), kind="stable")[:axes]
    along = spacing * ((np.arange(count) + 0.5) / count - 0.5)
    return grid([along if axis in best else np.zeros(1) for axis in range(at.dimension)])


class ParticleSum(Protocol):
    """A sum over particles that a sensor reads from a state."""

    @property
    def quantity(self) -> str | None:
        """Return the name of the summed quantity or load; None if the sum uses only fields of a state."""

    def on_host(self, at: Reading) -> NDArray[Any]:
        """Compute the sum (6,) of a state; unused entries are 0."""


class Summed(Sensor):
    """A sensor whose reading is a function of one sum over particles and of the poses of solids."""

    def __repr__(self) -> str:
        given = [value for name, value in vars(self).items() if not name.startswith("_")]
        shown = (repr(value.tolist() if isinstance(value, np.ndarray) else value) for value in given)
        return f"{type(self).__name__}({', '.join(shown)})"

    def value(self, at: Reading) -> NDArray[Any]:
        return self.reading(at, self.summed(at).on_host(at))

    @abstractmethod
    def summed(self, at: SensedScene) -> ParticleSum:
        """Return the sum that the sensor reads in the scene ``at``."""

    @abstractmethod
    def reading(self, at: Reading, found: NDArray[Any]) -> NDArray[Any]:
        """Return the sensor's reading (k,), given the sum (6,). The only fields used are the poses of solids."""


class LoadSensor(Summed):
    """A sensor of a force and its torque, in 2-D of a layer 1 m thick."""

    def columns(self, dimension: int) -> dict[str, str]:
        force, torque = ("N", "N m") if dimension == 3 else ("N/m", "N")
        turning = ["torque_x", "torque_y", "torque_z"] if dimension == 3 else ["torque"]
        return dict.fromkeys(["force_x", "force_y", "force_z"][:dimension], force) | dict.fromkeys(turning, torque)

    def reading(self, at: Reading, found: NDArray[Any]) -> NDArray[Any]:
        return in_the_scene(found, at.dimension)


@dataclass(frozen=True, eq=False)
class WeightedSum:
    """The sums of w_i and of w_i q_i over the particles around a place. Here q is a quantity, or without one the
    velocity component ``along`` a direction (d,)."""

    around: Around
    quantity: str | None = None
    along: NDArray[Any] | None = None
    ride: Ride | None = None
    """Solid that carries the place; the place itself is given in the initial scene."""

    def on_host(self, at: Reading) -> NDArray[Any]:
        weights, found = self.seen(at).weights, np.zeros(6)
        found[0] = weights.sum()
        if self.quantity is not None or self.along is not None:
            found[1] = (weights * self.values(at)).sum()
        return found

    def seen(self, at: Reading) -> Seen:
        """Return the particles around the place."""
        ride, around = self.ride, self.around
        return Seen.of(at, around if ride is None else around.carried(ride.carrier(at), ride.turns))

    def values(self, at: Reading) -> NDArray[Any]:
        """Return q (n,)."""
        return at["velocities"] @ self.along if self.quantity is None else at[self.quantity]


@dataclass(frozen=True, eq=False)
class RegionSum:
    """The sums of f_i and of (x_i - about) x f_i over the particles of a region between corners (d,) [m], where f is
    the quantity "wall_force"."""

    lower: NDArray[Any]
    upper: NDArray[Any]
    about: NDArray[Any]
    quantity: str = "wall_force"
    ride: Ride | None = None
    """Solid that carries the region and the point: arms and forces then have components along the initial axes turned
    with the solid."""

    def on_host(self, at: Reading) -> NDArray[Any]:
        arms, force = map(in_space, self.chosen(at))
        return np.concatenate([force.sum(axis=0), np.cross(arms, force).sum(axis=0)])

    def chosen(self, at: Reading) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the particles' lever arms (n, d), and their forces, which are 0 outside the region."""
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
    """The sum of force and torque on a solid, read from the load with the given name."""

    quantity: str

    def on_host(self, at: Reading) -> NDArray[Any]:
        load, d = at[self.quantity], at.dimension
        return np.concatenate([in_space(load[:d]), load[d:] if d == 3 else np.pad(load[d:], (2, 0))])


@dataclass(frozen=True)
class NoSum:
    """The sum 0, for a sensor that reads only the motion of solids."""

    quantity: None = None

    def on_host(self, at: Reading) -> NDArray[Any]:
        return np.zeros(6)


def load_bars(bar: NDArray[Any], dimension: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return derivatives with respect to force and torque (6,), given those with respect to the components that the
    scene's dimension has."""
    if dimension == 3:
        return bar[:3], bar[3:]
    return in_space(bar[:2]), np.array([0.0, 0.0, bar[2]])


def turned(found: NDArray[Any], turn: NDArray[Any]) -> NDArray[Any]:
    """Return force and torque (6,) turned by a matrix (3, 3)."""
    return np.asarray((found.reshape(2, 3) @ turn.T).ravel())


def in_the_scene(found: NDArray[Any], dimension: int) -> NDArray[Any]:
    """Return the components of force and torque (..., 6) that a scene has: in 2-D two of the force and one of the
    torque."""
    return found if dimension == 3 else found[..., [0, 1, 5]]
