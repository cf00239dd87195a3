"""Checks of parameter values, and gravity as a function of tilt angles, with NumPy in float64."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import as_numbers, require_table
from cortado.calls import FixedDict
from cortado.errors import InputError, OutOfRangeError, shown
from cortado.scene.parameters import BY_NAME, Axis, Parameter, Range, Role, Source, names


def reference_density(fractions: np.ndarray, rest_density: np.ndarray) -> np.ndarray:
    """Return the rest density (n,) of mixtures, given mass fractions (n, phases) and rest densities (phases,)
    [kg/m3]."""
    return 1.0 / (fractions / rest_density).sum(axis=1)


def reference_density_tangent(
    fractions: np.ndarray, rest_density: np.ndarray, fractions_dot: np.ndarray, rest_density_dot: np.ndarray
) -> np.ndarray:
    change = (fractions_dot - fractions * rest_density_dot / rest_density) / rest_density
    return -(reference_density(fractions, rest_density) ** 2) * change.sum(axis=1)


def reference_density_adjoint(
    fractions: np.ndarray, rest_density: np.ndarray, reference_density_bar: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the adjoints of ``fractions`` and ``rest_density``, given the adjoint of the density of mixtures (n,)."""
    by_volume = (reference_density_bar * reference_density(fractions, rest_density) ** 2)[:, None] / rest_density
    return -by_volume, (by_volume * fractions / rest_density).sum(axis=0)


SMALL = 1e-2
"""Smallest angle by which a formula divides [rad]. For smaller angles, the formula is a series."""


@dataclass(frozen=True)
class Tilt:
    """Gravity as a function of tilt angles (d - 1,) [degrees].

    Gravity along -y turns towards x by the first angle and towards z by the second angle. The function is the
    exponential map of the sphere, which is smooth at zero tilt and invertible below 180 degrees.
    """

    rest: tuple[float, ...]
    """Gravity without tilt (d,) [m/s2]. Gravity must not be zero."""

    def gravity(self, angles: np.ndarray) -> np.ndarray:
        """Return gravity (d,) or (steps, d) [m/s2] for angles (d - 1,) or (steps, d - 1) [degrees]."""
        a = np.radians(angles)
        size = np.linalg.norm(a, axis=-1, keepdims=True)
        return self._size * np.concatenate([np.cos(size), np.sinc(size / np.pi) * a], axis=-1) @ self._axes

    def tangent(self, angles: np.ndarray, dot: np.ndarray) -> np.ndarray:
        """Return the change of `gravity` [m/s2] for the change ``dot`` of the angles."""
        a, a_dot = np.radians(angles), np.radians(dot)
        sine, sine_derivative = self._factors(a)
        along = (a * a_dot).sum(axis=-1, keepdims=True)
        change = np.concatenate([-sine * along, sine * a_dot + sine_derivative * along * a], axis=-1)
        return self._size * change @ self._axes

    def adjoint(self, angles: np.ndarray, bar: np.ndarray) -> np.ndarray:
        """Return the adjoint of the angles [1/degree], given the adjoint of gravity."""
        a, bars = np.radians(angles), self._size * bar @ self._axes.T
        sine, sine_derivative = self._factors(a)
        rest_bar, lean_bar = bars[..., :1], bars[..., 1:]
        along = sine_derivative * (a * lean_bar).sum(axis=-1, keepdims=True) - sine * rest_bar
        return np.radians(sine * lean_bar + along * a)

    @property
    def towards(self) -> str:
        """Names of the axes towards which gravity turns, such as "xz"."""
        return "".join(np.delete(list("xyz"[: len(self.rest)]), np.abs(self.rest).argmax()))

    @property
    def _size(self) -> float:
        return float(np.linalg.norm(self.rest))

    @property
    def _axes(self) -> np.ndarray:
        rows = [np.array(self.rest) / self._size]
        for axis in np.delete(np.eye(len(self.rest)), np.abs(self.rest).argmax(), axis=0):
            rest = axis - sum((axis @ row) * row for row in rows)
            rows.append(rest / np.linalg.norm(rest))
        return np.array(rows)

    @staticmethod
    def _factors(a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the factor sin|a| / |a| (..., 1), and the derivative of the factor by |a|, divided by |a|."""
        size = np.linalg.norm(a, axis=-1, keepdims=True)
        sine, safe = np.sinc(size / np.pi), np.maximum(size, SMALL)
        derivative = (np.cos(safe) - np.sinc(safe / np.pi)) / safe**2
        return sine, np.where(size < SMALL, -1.0 / 3.0 + size**2 / 30.0 - size**4 / 840.0, derivative)


class Known(FixedDict):
    """Parameters by name: Cortado's parameters, and the parameters of a solver and of forces."""

    __eq__, __ne__, __hash__ = object.__eq__, object.__ne__, object.__hash__  # type: ignore[assignment]

    def __init__(self, own: Iterable[tuple[Parameter, str]] = ()):
        """Add the parameters ``own`` of forces and of a solver, each with a description of the force or solver.

        Raises `InputError` for a name that occurs twice. Only the parameter `TIME` may occur several times.
        """
        self._given = dict(own)
        found, arguments = dict(BY_NAME), {argument(name): name for name in BY_NAME}
        for parameter, whose in self._given.items():
            name = parameter.name
            if other := arguments.get(argument(name)):
                raise InputError(
                    f"parameter {name} of {whose} has the name of another one, {other}, but must have its own: give "
                    f"{whose.replace('a ', 'the ')} another name."
                )
            arguments[argument(name)], found[name] = name, parameter
        super().__init__(found)
        self.own = tuple(p for p in self.values() if p.name not in BY_NAME)
        self.run = tuple(name for name, p in self.items() if p.role in (Role.RUN, Role.CLOCK))
        self.state = tuple(name for name, p in self.items() if p.role is Role.STATE)
        self.over_time = tuple(name for name, p in self.items() if p.axis is Axis.STEP)
        self.vectors = tuple(name for name in self.run if self[name].components is not None)
        self.views = {p.name: p.in_place_of for p in self.values() if p.in_place_of is not None}
        """Names of alternative parameters, such as a tilt, with the names of the parameters that they replace."""
        self.courses = {p.name: p.course for p in self.own if p.course is not None}

    def __reduce__(self) -> tuple[Any, ...]:
        return Known, (tuple(self._given.items()),)

    def has_rows(self, name: str, value: Any) -> bool:
        """Test if the value of a parameter is an array over time steps or over given times."""
        parameter = self[name]
        return parameter.axis is Axis.STEP and np.ndim(value) == parameter.rank + 1


class _Passing:
    def at(self, times: NDArray) -> NDArray:
        return times

    def rates(self, times: NDArray) -> NDArray:
        return np.ones_like(times)


TIME = Parameter(
    "time", "s", "when a step begins", Axis.STEP, lambda source: 0.0, role=Role.CLOCK, moment=0.0, course=_Passing()
)
"""The time as a parameter of forces. Kernels read the time from an array (members, steps)."""


def argument(name: str) -> str:
    """Return the name of a parameter as a kernel argument, such as ``drag_k`` for ``drag.k``."""
    return name.replace(".", "_")


REGISTRY = Known()
Values = Mapping[str, Any]
Arrays = dict[str, np.ndarray]
NAMES = names()
UNITS = {name: parameter.unit for name, parameter in BY_NAME.items()}
OVER_TIME = names(axis=Axis.STEP)
SUM_TOLERANCE = 0.01
"""Greatest difference between 1 and the sum of a particle's mass fractions."""


def scene_values(source: Source, known: Known = REGISTRY) -> Arrays:
    """Return the values of parameters in a scene, without alternative parameters such as a tilt."""
    phases, positions = len(source.scene.phase), source.positions.shape
    found = {}
    for name, parameter in known.items():
        if parameter.present(source.scene) and parameter.role not in (Role.VIEW, Role.CLOCK):
            shape = parameter.shapes(0, phases, positions)[0]
            found[name] = np.asarray(parameter.value(source), dtype=np.float64).reshape(shape)
    return found


def check_known(name: str, scene: Any, what: str = "parameter", known: Known = REGISTRY) -> None:
    if name not in known or known[name].role is Role.CLOCK:
        owner = str(name).rpartition(".")[0]
        if owner in (solid.name for solid in scene.solid if not solid.moves):
            wanted = 'only those whose motion is "path" or "free" have parameters'
            raise InputError(f"{what} {name!r} is unknown, as the solid {owner!r} is at rest: {wanted}.")
        present = [p.name for p in known.values() if p.present(scene) and p.role is not Role.CLOCK]
        raise InputError(f"{what} {name!r} is unknown, but must be one of {', '.join(present)} in this scene.")
    parameter = known[name]
    if not parameter.present(scene):
        raise InputError(f"{what} {name} is given, but must be left out, as the scene {parameter.absent}.")


def require_points(points: Any, are_read: bool = True) -> None:
    """Check ``points``. If ``are_read`` is false, any iterable is allowed, and the tables in ``points`` are not
    checked."""
    is_fit = isinstance(points, Sequence) and len(points) > 0 if are_read else isinstance(points, Iterable)
    if not is_fit or isinstance(points, (str, bytes, Mapping)):
        raise InputError(f"points is {shown(points)}, but must be a list with a table of parameters for each point.")
    for point in points if are_read else ():
        require_table("a point", point, "{'gravity': value}")


def is_too_small(array: np.ndarray, allowed: Range) -> bool:
    if allowed is Range.POSITIVE:
        return bool((array <= 0.0).any())
    return allowed is Range.NOT_NEGATIVE and bool((array < 0.0).any())


def checked_value(
    name: str, value: Any, shapes: list[tuple[int, ...]], what: str = "parameter", known: Known = REGISTRY
) -> np.ndarray:
    """Return a value as a float64 array, after a check of its shape and range.

    Raise `OutOfRangeError` if only a number is out of range, and `InputError` for any other error. Numbers may be
    negative if ``what`` is "direction".
    """
    array, parameter = as_numbers(f"{what} {name}", value), known[name]
    unit = f" in {parameter.unit}" if parameter.unit else ""
    if array.shape not in shapes:
        raise InputError(f"{what} {name} has shape {array.shape}, but must be {' or '.join(map(str, shapes))}{unit}.")
    if not np.isfinite(array).all():
        raise OutOfRangeError(f"{what} {name} has a value that is not finite, but must be numbers{unit}.")
    if what == "direction":
        return array
    if is_too_small(array, parameter.range):
        raise OutOfRangeError(f"{what} {name} is {shown(float(array.min()))}, but must be {parameter.range.value}.")
    if parameter.range is Range.FRACTIONS:
        totals = array.sum(axis=-1)
        worst = np.unravel_index(np.abs(totals - 1.0).argmax(), totals.shape)
        if abs(totals[worst] - 1.0) > SUM_TOLERANCE:
            place = f"particle {worst[-1]}" + (f" of scene {worst[0]}" if totals.ndim > 1 else "")
            raise OutOfRangeError(f"{what} {name} of {place} add up to {totals[worst]:g}, but must add up to 1.")
    return array


def stacked(tables: Sequence[Arrays]) -> Arrays:
    return {name: np.stack([one[name] for one in tables]) for name in tables[0]}


def entry(arrays: Arrays, number: int) -> Arrays:
    return {name: array[number] for name, array in arrays.items()}
