"""What a sensor is, and the smooth weights with which sensors look at particles."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import as_numbers, as_one_number, read_only, require_methods, unit
from cortado.discretise.shapes import grid
from cortado.errors import InputError
from cortado.scene.containers import Container
from cortado.scene.discrete_scene import Lattice
from cortado.scene.solids import SolidTable


class Cut(Protocol):
    """A scene that is cut into particles."""

    @property
    def dimension(self) -> int:
        """2 or 3."""

    @property
    def lattice(self) -> Lattice:
        """Constants of the particles at rest, such as their volume, and along which axes they repeat."""


class Reading(Cut, Protocol):
    """A state as sensors see it: a `cortado.losses.Snapshot`."""

    @property
    def solids(self) -> tuple[SolidTable, ...]:
        """Those of the scene, as they begin."""

    @property
    def container(self) -> Container:
        """That of the scene."""

    def __getitem__(self, name: str) -> NDArray[Any]:
        """A field of the state or a quantity of its particles, float64."""


class Sensor(Protocol):
    """Something that reads a few numbers of a state, and their derivatives."""

    def columns(self, dimension: int) -> dict[str, str]:
        """The names of its numbers, with their units."""

    def value(self, at: Reading) -> NDArray[Any]:
        """(k,) what it reads, one number for each column."""

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """From the adjoint of what it reads, (k,), to those of fields and quantities, by name."""


@dataclass(frozen=True)
class Weights:
    """w(q) = (1 - q)^4 (1 + 4 q) of a distance q in units of a reach (Wendland 1995), 0 beyond."""

    values: NDArray[Any]
    """w"""
    slopes: NDArray[Any]
    """w'(q) / q"""

    @classmethod
    def of(cls, q: NDArray[Any]) -> "Weights":
        """At distances (n,)."""
        rest = np.clip(1.0 - q, 0.0, None)
        return cls(rest**4 * (1.0 + 4.0 * q), -20.0 * rest**3)


Across = Callable[[NDArray[Any]], NDArray[Any]]
"""How a sensor sees ways (n, d): a linear function to ways (n, k)."""


@dataclass(frozen=True)
class Image:
    """Those of all particles, or of all their parts in one place of their cells, that weigh something."""

    near: NDArray[np.int_]
    """(m,) their numbers"""
    ways: NDArray[Any]
    """(m, k) from the place to them [m]"""
    weights: Weights
    """(m,) each"""


@dataclass(frozen=True)
class Seen:
    """Particles around a place, along periodic axes with all of their images that are near."""

    images: list[Image]
    """Of each of the parts that a particle is divided into, and each of its images."""
    particles: int
    """n"""
    parts: int
    """How many parts a particle is divided into."""
    reach: float
    """From where on they weigh nothing [m]."""

    @classmethod
    def of(
        cls, at: Reading, place: NDArray[Any], reach: float, across: Across, parts: NDArray[Any] | None = None
    ) -> "Seen":
        """From a place (d,) as ``across`` shows it. ``parts`` (m, d) are where the parts of a particle lie from it [m],
        which weigh the same; a particle is one point if they are left out."""
        shifts = np.zeros((1, at.dimension)) if parts is None else parts
        seen, widest = across(shifts), reach + float(np.linalg.norm(across(shifts), axis=1).max())
        ways = at.lattice.domain.ways(at["positions"], in_dimension("position", place, at.dimension), widest, across)
        images = []
        for way in ways:
            close = np.flatnonzero(np.linalg.norm(way, axis=1) < widest)
            for shift in seen:
                own = way[close] + shift
                images.append(Image(close, own, Weights.of(np.linalg.norm(own, axis=1) / reach)))
        return cls(images, len(at["positions"]), len(shifts), reach)

    @property
    def weights(self) -> NDArray[Any]:
        """(n,) of particles, the mean of their parts, those of their images added up."""
        found = np.zeros(self.particles)
        for image in self.images:
            found[image.near] += image.weights.values
        return found / self.parts

    def pulled(self, factors: NDArray[Any] | float) -> NDArray[Any]:
        """(n, k) the derivative with respect to the ways, from that with respect to the weights, (n,)."""
        each, found = np.broadcast_to(factors, self.particles), np.zeros((self.particles, self.images[0].ways.shape[1]))
        for image in self.images:
            found[image.near] += (each[image.near] * image.weights.slopes / self.reach**2)[:, None] * image.ways
        return found / self.parts


ACROSS = {1: 1.5, 2: 7.0 / np.pi}
"""What w is multiplied with, over the reach to the number of dimensions, so that it has the integral 1."""

LEAST_REACH = 5.0
"""In spacings: with it the weights of a lattice add up to 1 within 0.1 %, wherever a plane or a column lies in it."""
MOST_PARTS = 40
"""Along an axis: enough for a reach of half a spacing, and less is warned of."""


def reach_of(given: float | None, at: Cut) -> float:
    """How far from a plane or an axis particles count [m]: what is given, or else two support radii, or five spacings
    where these are more."""
    if given is not None:
        return given
    return max(2.0 * at.lattice.support, LEAST_REACH * at.lattice.cell ** (1.0 / at.dimension))


def parts_of(reach: float, at: Reading, across: Across, axes: int) -> NDArray[Any]:
    """(m, d) where parts of a particle lie from it [m]: evenly in its cell along so many axes, those that are seen
    best, with `LEAST_REACH` of them to a reach, as then the weights of a lattice add up to 1."""
    spacing = at.lattice.cell ** (1.0 / at.dimension)
    count = min(int(np.ceil(LEAST_REACH * spacing / reach * (1.0 - 1e-9))), MOST_PARTS)
    best = np.argsort(-np.linalg.norm(across(np.eye(at.dimension)), axis=1), kind="stable")[:axes]
    along = spacing * ((np.arange(count) + 0.5) / count - 0.5)
    return grid([along if axis in best else np.zeros(1) for axis in range(at.dimension)])


def load_columns(dimension: int) -> dict[str, str]:
    """The names of a force and its torque, with their units: in the plane those of a metre across it."""
    force, torque = ("N", "N m") if dimension == 3 else ("N/m", "N")
    turning = ["torque_x", "torque_y", "torque_z"] if dimension == 3 else ["torque"]
    return dict.fromkeys(["force_x", "force_y", "force_z"][:dimension], force) | dict.fromkeys(turning, torque)


def point(what: str, values: Any) -> NDArray[Any]:
    """A place or a direction, (d,), finite; raises `InputError`."""
    array = corner(what, values)
    if not np.isfinite(array).all():
        raise InputError(f"{what} is {array.tolist()}, but must be finite.")
    return array


def corner(what: str, values: Any) -> NDArray[Any]:
    """The same, or infinite where a region has no end."""
    array = read_only(what, values)
    if array.shape not in ((2,), (3,)):
        raise InputError(f"{what} has shape {array.shape}, but must have 2 or 3 components.")
    if np.isnan(array).any():
        raise InputError(f"{what} is {array.tolist()}, but must be numbers.")
    return array


def direction(what: str, values: Any) -> NDArray[Any]:
    """The same of length 1."""
    array = point(what, values)
    if not array.any():
        raise InputError(f"{what} is {array.tolist()}, but must not be 0.")
    return unit(array)


def positive(what: str, value: Any) -> float:
    """A finite number above 0; raises `InputError`."""
    number = as_one_number(what, value)
    if not 0.0 < number < np.inf:
        raise InputError(f"{what} is {number:g}, but must be greater than 0 and finite.")
    return number


def checked_sensor(sensor: Any) -> Sensor:
    """What a user gives as a sensor; raises `InputError`."""
    require_methods("sensor", sensor, ("columns", "value", "adjoint"), "a sensor, such as one of cortado.sensors")
    return sensor


def value_of(sensor: Sensor, at: Reading) -> NDArray[Any]:
    """(k,) what a sensor reads; raises `InputError` unless it has one number for each of its columns."""
    what, columns = f"value of the sensor {type(sensor).__name__}", len(sensor.columns(at.dimension))
    found = as_numbers(what, sensor.value(at))
    if found.shape != (columns,):
        raise InputError(f"{what} has shape {found.shape}, but must be ({columns},), a number for each column.")
    return found


def in_dimension(what: str, values: NDArray[Any], dimension: int) -> NDArray[Any]:
    """A place with as many components as the scene has dimensions; raises `InputError`."""
    if len(values) != dimension:
        raise InputError(f"{what} has {len(values)} components, but must have {dimension}, as the scene has.")
    return values
