"""Quantities that change over time, from constants, lists or CSV files."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError, Words, shown
from cortado.files.disk import cached_by_file, name_and_unit, read_columns
from cortado.scene.tables import GREATEST, MISSING, FieldPath, field_error, quantity, usable_file

Interpolation = Literal["linear", "spline"]
Ramp = Annotated[float, quantity("s", gt=0.0)]
WITHIN = np.minimum(np.arange(9) / 8.0, 1.0 - 1e-9)
RAMP_PARTS = 16


@dataclass(frozen=True, eq=False)
class Steady:
    rate: NDArray[np.float64]
    """Rate of change per second, a number or an array (components,)."""

    def at(self, times: NDArray) -> NDArray:
        """Return the values (n,) or (n, components) at ``times`` (n,) [s]. The value at time 0 is 0."""
        return np.multiply.outer(times, self.rate)

    def greatest(self) -> float:
        return float(np.linalg.norm(self.rate))

    def rates(self, times: NDArray) -> NDArray:
        return np.broadcast_to(self.rate, (*np.shape(times), *self.rate.shape))


@dataclass(frozen=True, eq=False)
class Knots:
    """A curve through given values at given times. Values between the times are interpolated linearly, or by a cubic
    spline with zero slope at both ends. The curve is constant before the first and after the last time.

    A ramp makes the curve start smoothly from the value ``begun``. The difference between curve and ``begun`` is
    multiplied by 10 s³ - 15 s⁴ + 6 s⁵. In this formula, t is the time, and s = min(t / ramp, 1).
    """

    times: NDArray[np.float64]
    """Times of the given values (k,) [s]."""
    values: NDArray[np.float64]
    """Values of the curve at `times`, (k,) or (k, components)."""
    interpolation: Interpolation = "linear"
    ramp: float = 0.0
    """Duration of the ramp, which begins at time 0 [s]; 0 for no ramp."""
    begun: Any = 0.0

    def at(self, times: NDArray) -> NDArray:
        found = self._curve(times)
        return found if not self.ramp else self.begun + self._weights(times)[0] * (found - self.begun)

    def rates(self, times: NDArray) -> NDArray:
        """Return the time derivatives at ``times`` (n,) [s]. At a kink, return the derivative just after the kink."""
        if self.interpolation == "spline" and len(self.times) > 1:
            found = np.asarray(self._spline(times, 1)).T
            found = np.where((times >= self.times[0]) & (times < self.times[-1]), found, 0.0).T
        else:
            lengths = np.diff(self.times).reshape(-1, *(1,) * (self.values.ndim - 1))
            slopes = np.concatenate([np.diff(self.values, axis=0) / lengths, np.zeros_like(self.values[:1])])
            found = slopes[np.searchsorted(self.times, times, side="right") - 1]
        if not self.ramp:
            return found
        weights, growth = self._weights(times)
        return weights * found + growth * (self._curve(times) - self.begun)

    def greatest(self) -> float:
        return float(fastest([(1.0, self)], self.breaks).max())

    @cached_property
    def breaks(self) -> NDArray[np.float64]:
        """Times (m,) [s] at which the curve may have kinks."""
        along = np.linspace(0.0, self.ramp, RAMP_PARTS + 1) if self.ramp else self.times[:1]
        return np.unique(np.concatenate([self.times, along]))

    @property
    def seen(self) -> NDArray[np.float64]:
        """Samples of the curve, (m,) or (m, components), which cover the range of its values."""
        straight = self.interpolation == "linear" and not self.ramp
        return self.values if straight else self.at(np.append(_within(self.breaks).ravel(), self.breaks[-1]))

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import CubicSpline

        return CubicSpline(self.times, self.values, bc_type="clamped")

    def _curve(self, times: NDArray) -> NDArray:
        if self.interpolation == "spline" and len(self.times) > 1:
            return np.asarray(self._spline(np.clip(times, self.times[0], self.times[-1])))
        columns = self.values.reshape(len(self.times), -1).T
        found = np.stack([np.interp(times, self.times, column) for column in columns], axis=-1)
        return found.reshape(len(times), *self.values.shape[1:])

    def _weights(self, times: NDArray) -> tuple[NDArray, NDArray]:
        """Return the factor of the ramp at ``times``, and the time derivative of this factor [1/s]."""
        s = np.clip(np.asarray(times) / self.ramp, 0.0, 1.0).reshape(-1, *(1,) * (self.values.ndim - 1))
        return s**3 * (10.0 - 15.0 * s + 6.0 * s * s), 30.0 * (s * (1.0 - s)) ** 2 / self.ramp


def fastest(moved: Iterable[tuple[float, Knots]], times: NDArray) -> NDArray[np.float64]:
    """Return the greatest speed in each interval between ``times`` (k,) [s]. ``moved`` are pairs of a factor and a
    curve. The speed is a sum over the curves: factor times magnitude of the curve's time derivative."""
    inner = _within(times).ravel()
    sizes = [factor * np.linalg.norm(one.rates(inner).reshape(len(inner), -1), axis=1) for factor, one in moved]
    return np.append(sum(sizes, np.zeros(len(inner))).reshape(-1, len(WITHIN)).max(axis=1), 0.0)


def _within(times: NDArray) -> NDArray[np.float64]:
    return np.asarray(times[:-1, None] + np.diff(times)[:, None] * WITHIN)


UNITS: Mapping[str, Mapping[str, float]] = {
    "s": {"s": 1.0, "ms": 1e-3, "min": 60.0},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6},
    "rad": {"rad": 1.0, "deg": np.pi / 180.0},
    "degrees": {"deg": 1.0, "rad": 180.0 / np.pi},
    "m3/s": {"m^3/s": 1.0, "m3/s": 1.0, "m³/s": 1.0, "l/s": 1e-3, "l/min": 1e-3 / 60.0},
    "m2/s": {"m^2/s": 1.0, "m2/s": 1.0, "m²/s": 1.0},
    "N m": {"N m": 1.0, "Nm": 1.0, "kN m": 1e3, "N": 1.0},
    "rad/s": {"rad/s": 1.0, "deg/s": np.pi / 180.0, "rpm": np.pi / 30.0},
    "m/s2": {"m/s^2": 1.0, "m/s2": 1.0, "m/s²": 1.0, "cm/s^2": 1e-2, "mm/s^2": 1e-3, "g": 9.80665},
}
"""Conversion factors by scene unit and by unit in the file."""
MOST_BYTES = 2**25
"""Greatest size of a CSV file [byte]."""
Columns = tuple[tuple[str, str], ...]
"""For each column of a file, its name and its unit in the scene."""


@cached_by_file(8, MOST_BYTES)
def values_in_file(file: str, columns: Columns, needs_all: bool) -> tuple[NDArray, dict[str, NDArray]]:
    """Return the times (k,) [s] in a CSV file, and its other columns (k,) by name, in units of a scene.

    Args:
        file: path of the file. Its header has names with units, such as ``time [s],x [mm],rotation [deg]``.
        columns: allowed columns besides the time.
        needs_all: True if the file must have all of ``columns``, False if one column is enough.
    """
    known, found = dict((("time", "s"), *columns)), dict[str, NDArray]()
    listed = ", ".join(f"{name} [{next(iter(UNITS[unit]))}]" for name, unit in known.items())
    for head, values in read_columns(file).items():
        name, unit = name_and_unit(head)
        if name not in known:
            raise InputError(f"{file} has the column {head!r}, but its columns must be among {listed}.")
        if name in found:
            raise InputError(f"{file} has two columns {name!r}, but must have each of them once.")
        units = UNITS[known[name]]
        if unit is None or unit not in units:
            has = f"{head!r} without a unit in brackets" if unit is None else f"{name!r} in {shown(Words(unit))}"
            raise InputError(f"{file} has the column {has}, but must have it in one of {', '.join(units)}: {listed}.")
        wrong = np.flatnonzero(~(np.abs(values) <= GREATEST))
        if len(wrong):
            raise InputError(f"{file} has no number of finite size in column {head!r}, line {wrong[0] + 2}.")
        found[name] = values * units[unit]
        found[name].flags.writeable = False
    missing = [name for name in known if name not in found]
    if "time" in missing or len(found) < 2 or (needs_all and missing):
        what = f"all of {listed}" if needs_all else f"time [s] and one or more of {listed.partition(', ')[2]}"
        raise InputError(f"{file} has no column {missing[0]!r}, but must have {what}.")
    times = found["time"]
    later = np.flatnonzero(np.diff(times, prepend=np.nextafter(min(0.0, times[0]), -1.0)) <= 0.0)
    if len(later) or times[0] < 0.0 or len(times) < 2:
        row = int(later[0]) if len(later) else 0
        has = f"the time {times[row]:g} s in line {row + 2}" if len(later) or times[0] < 0.0 else "one line of numbers"
        wanted = "times from 0 on, each greater than the one before, at least two of them"
        raise InputError(f"{file} has {has}, but must have {wanted}.")
    return times, {name: values for name, values in found.items() if name != "time"}


def lists_in_file(table: Any, path: FieldPath, columns: Columns, what: str, needs_all: bool) -> dict[str, Any]:
    """Return the lists in a table's CSV file as values of keys of the table, such as ``times`` and ``torques``."""
    names = [name for name, _ in columns]
    for key in (*names, "times", *(f"{name}s" for name in names)):
        if (found := getattr(table, key)) is not None:
            raise field_error((*path, key), found, "left out, as there is a file")
    with usable_file((*path, "file"), table.file, what):
        times, columns_found = values_in_file(table.file, columns, needs_all)
    if times[0] != 0.0:
        raise field_error((*path, "file"), table.file, "a file with times from 0 on")
    lists = {f"{name}s": tuple(values.tolist()) for name, values in columns_found.items()}
    return {"file": None, "times": tuple(times.tolist()), **lists}


WAYS = {2: ("x", "y", "rotation"), 3: ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")}
Rows = NDArray[np.float64]


def path_of(solid: Any, dimension: int) -> tuple[Rows, Rows | None, Rows | None] | None:
    """Return a solid's path: times (k,) [s], displacements (k, d) [m], and rotations (k, 1) or (k, 3) [rad]."""
    if solid.path is None:
        if solid.times is None:
            return None
        return np.array(solid.times), _since_first(solid.positions), _since_first(solid.rotations)
    columns = tuple((way, "m" if k < dimension else "rad") for k, way in enumerate(WAYS[dimension]))
    times, found = values_in_file(solid.path, columns, False)
    shifts, turns = (
        None if found.keys().isdisjoint(some) else np.stack([found.get(one, 0.0 * times) for one in some], axis=1)
        for some in (WAYS[dimension][:dimension], WAYS[dimension][dimension:])
    )
    if turns is not None and np.count_nonzero(turns.any(axis=0)) > 1 and turns[0].any():
        raise InputError(f"{solid.path} begins with a rotation of {turns[0].tolist()} rad, but must begin with 0.")
    return times, _since_first(shifts), _since_first(turns)


def _since_first(rows: Any) -> Rows | None:
    return None if rows is None else np.array(rows, dtype=np.float64) - rows[0]


def check_motion(solid: Any, dimension: int, path: FieldPath) -> None:
    rows, steady = ("positions", "rotations"), ("velocity", "angular_velocity")
    given = [name for name in ("path", "times", *rows, *steady, "ramp") if getattr(solid, name) is not None]
    if solid.interpolation != "linear":
        given.append("interpolation")
    words = {"freedom": "can be held", "friction": "rubs what it touches", "restitution": "bounces"}
    for name in ("density", "mass", "centre_of_mass", "gyration_radius", "inertia", *words):
        if (value := getattr(solid, name)) is not None and solid.motion != "free":
            has = words.get(name, "has a mass")
            raise field_error((*path, name), value, f'left out, as only a body whose motion is "free" {has}')
    if solid.motion == "fixed":
        if given:
            raise field_error((*path, given[0]), Words("given"), 'left out, as motion is "fixed"')
        return
    if solid.motion == "free":
        return _check_free(solid, given, dimension, path)
    if solid.path is not None:
        with usable_file((*path, "path"), solid.path, "the file of a path"):
            path_of(solid, dimension)
        refused, reason = ["times", *rows, *steady], "the file of its path says where it is"
    elif solid.times is None:
        if wrong := [name for name in rows if name in given]:
            raise field_error((*path, "times"), MISSING, f"a list of times, as there are {wrong[0]}")
        if not set(steady) & set(given):
            raise field_error((*path, "velocity"), MISSING, 'given, or times with positions, as motion is "path"')
        refused, reason = ["ramp", "interpolation"], "there are no times, and no file of its path"
    elif not set(rows) & set(given):
        raise field_error((*path, "positions"), MISSING, "given, or rotations, as there are times")
    else:
        _check_knots(solid, dimension, path)
        refused, reason = [*steady], "there are times"
    if wrong := [name for name in refused if name in given]:
        raise field_error((*path, wrong[0]), Words("given"), f"left out, as {reason}")


def _check_free(solid: Any, given: Sequence[str], dimension: int, path: FieldPath) -> None:
    if solid.mass is None and solid.density is None:
        raise field_error((*path, "density"), MISSING, 'a density in kg/m3, or a mass, as motion is "free"')
    if None not in (solid.mass, solid.density):
        raise field_error((*path, "mass"), solid.mass, "left out, as there is a density")
    if solid.inertia is not None and solid.gyration_radius is not None:
        raise field_error((*path, "inertia"), Words("given"), "left out, as there is a gyration_radius")
    if solid.centre_of_mass is not None and solid.gyration_radius is None and solid.inertia is None:
        raise field_error((*path, "gyration_radius"), MISSING, "given, or an inertia, as there is a centre of mass")
    for name in (*given, "surface_velocity"):
        if name not in ("velocity", "angular_velocity") and getattr(solid, name) is not None:
            raise field_error((*path, name), Words("given"), 'left out, as motion is "free"')
    if solid.side == "inside":
        raise field_error((*path, "side"), solid.side, '"outside", as motion is "free"')
    if solid.freedom is not None:
        ways, found = WAYS[dimension], Words(f"a list of {', '.join(map(repr, solid.freedom)) or 'nothing'}")
        if not solid.freedom or len({*solid.freedom}) < len(solid.freedom) or not {*solid.freedom} <= {*ways}:
            raise field_error((*path, "freedom"), found, f"some of {shown(list(ways))}, each once")
        for name, own in (("velocity", ways[:dimension]), ("angular_velocity", ways[dimension:])):
            for way, value in zip(own, getattr(solid, name) or (), strict=False):
                if value != 0.0 and way not in solid.freedom:
                    raise field_error((*path, name), getattr(solid, name), f"0 where the body is held, in {way!r}")
    numbers = solid.inertia
    if numbers is None:
        return
    if len(numbers) not in ((1,) if dimension == 2 else (3, 9)):
        wanted = "one number in 2-D" if dimension == 2 else "three numbers, or the nine of a matrix, in 3-D"
        raise field_error((*path, "inertia"), Words(f"a list of {len(numbers)}"), wanted)
    whole = np.array(numbers).reshape(3, 3) if len(numbers) == 9 else np.diag(numbers)
    if not np.allclose(whole, whole.T, rtol=1e-9, atol=0.0):
        raise field_error((*path, "inertia"), numbers, "a matrix with the same numbers on both sides of its diagonal")
    moments = np.linalg.eigvalsh(whole)
    if moments.min() <= 0.0:
        raise field_error((*path, "inertia"), numbers, "greater than 0 about every axis")
    if dimension == 3 and moments[:2].sum() < moments[2] * (1.0 - 1e-9):
        wanted = "that of a body, whose two least moments together are not less than the greatest"
        raise field_error((*path, "inertia"), numbers, wanted)


def _check_knots(solid: Any, dimension: int, path: FieldPath) -> None:
    _check_times(path, solid.times)
    for name, size in (("positions", dimension), ("rotations", 2 * dimension - 3)):
        values = getattr(solid, name)
        if values is None:
            continue
        if len(values) != len(solid.times):
            wanted = f"a list of {len(solid.times)}, as are times"
            raise field_error((*path, name), Words(f"a list of {len(values)}"), wanted)
        for index, row in enumerate(values):
            if len(row) != size:
                wanted = "one number in 2-D" if size == 1 else f"a list of {size} components"
                raise field_error((*path, name, index), row, wanted)
    if solid.positions is not None and np.abs(np.subtract(solid.positions[0], solid.middle())).max() > 1e-9:
        wanted = f"{shown([float(f'{x:.9g}') for x in solid.middle()])}, where its middle is at the start"
        raise field_error((*path, "positions", 0), solid.positions[0], wanted)
    if solid.rotations is not None and any(solid.rotations[0]):
        raise field_error((*path, "rotations", 0), solid.rotations[0], "0, as it is not turned yet")


def _check_times(path: FieldPath, times: Sequence[float] | None) -> None:
    if times is None or len(times) < 2 or times[0] != 0.0 or any(b <= a for a, b in pairwise(times)):
        wanted = "at least two times, from 0 on, each greater than the one before"
        raise field_error((*path, "times"), MISSING if times is None else times, wanted)


def check_over_time(path: FieldPath, table: Any, values: str, constant: str) -> None:
    """Check that ``times`` increase from 0, that ``values`` has a value for each time, and that ``constant`` is left
    out."""
    _check_times(path, table.times)
    given, wanted = getattr(table, values), f"a list of {len(table.times)}, as are times"
    if given is None or len(given) != len(table.times):
        raise field_error((*path, values), MISSING if given is None else Words(f"a list of {len(given)}"), wanted)
    if (alone := getattr(table, constant)) is not None:
        raise field_error((*path, constant), alone, f"left out, as there are {values}")
