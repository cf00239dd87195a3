"""The interface of sensors, the readings of a run, and the comparison with measured data."""

import csv
import io
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import as_numbers, as_one_number, read_only, require_methods, require_table, unit
from cortado.errors import DivergedError, InputError, shown
from cortado.files.disk import name_and_unit, read_columns
from cortado.scene.discrete_scene import Lattice
from cortado.scene.shape_tables import Container
from cortado.scene.solids import SolidTable

TIME = "time [s]"


class Cut(Protocol):
    @property
    def dimension(self) -> int: ...

    @property
    def lattice(self) -> Lattice: ...


class SensedScene(Cut, Protocol):
    @property
    def solids(self) -> tuple[SolidTable, ...]: ...

    @property
    def container(self) -> Container: ...


class Reading(SensedScene, Protocol):
    """Protocol of a state for sensors, such as `cortado.losses.Snapshot`."""

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a field of the state, or a quantity of its particles, as a float64 array."""


class Sensor(Protocol):
    """Protocol of sensors, which compute a few numbers from a state, with derivatives."""

    def columns(self, dimension: int) -> dict[str, str]:
        """Return the units of the sensor's numbers by name."""

    def value(self, at: Reading) -> NDArray[Any]:
        """Return the reading (k,) of a state, with one number for each of `columns`."""

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Convert the adjoint ``bar`` (k,) of the reading to adjoints of fields and quantities by name."""


def named(what: str, name: Any, of: str) -> str:
    if not isinstance(name, str) or not name:
        raise InputError(f"{what} is {shown(name)}, but must be the name of a {of}.")
    return name


def point(what: str, values: Any) -> NDArray[Any]:
    """Return a finite position or direction (d,)."""
    array = corner(what, values)
    if not np.isfinite(array).all():
        raise InputError(f"{what} is {array.tolist()}, but must be finite.")
    return array


def corner(what: str, values: Any) -> NDArray[Any]:
    """Return the corner (d,) of a region, whose components may be infinite."""
    array = read_only(what, values)
    if array.shape not in ((2,), (3,)):
        raise InputError(f"{what} has shape {array.shape}, but must have 2 or 3 components.")
    if np.isnan(array).any():
        raise InputError(f"{what} is {array.tolist()}, but must not contain NaN.")
    return array


def direction(what: str, values: Any) -> NDArray[Any]:
    """Return a direction (d,) scaled to length 1."""
    array = point(what, values)
    if not array.any():
        raise InputError(f"{what} is {array.tolist()}, but must not be 0.")
    return unit(array)


def positive(what: str, value: Any) -> float:
    number = as_one_number(what, value)
    if not 0.0 < number < np.inf:
        raise InputError(f"{what} is {number:g}, but must be greater than 0 and finite.")
    return number


def checked_sensor(sensor: Any) -> Sensor:
    require_methods("sensor", sensor, ("columns", "value", "adjoint"), "a sensor, such as one of cortado.sensors")
    return sensor


def checked_sensors(given: Mapping[str, Sensor] | None, taken: set[str]) -> dict[str, Sensor]:
    if given is None:
        return {}
    require_table("sensors", given, "{'gauge': sensor}")
    for name in given:
        if not isinstance(name, str) or name in taken:
            wanted = f"names must be texts other than {', '.join(sorted(taken))}"
            raise InputError(f"sensors has the name {shown(name)}, but {wanted}.")
    return {name: checked_sensor(sensor) for name, sensor in given.items()}


def value_of(sensor: Sensor, at: Reading) -> NDArray[Any]:
    what, columns = f"value of the sensor {type(sensor).__name__}", len(sensor.columns(at.dimension))
    found = as_numbers(what, sensor.value(at))
    if found.shape != (columns,):
        raise InputError(f"{what} has shape {found.shape}, but must be ({columns},), a number for each column.")
    return found


def in_dimension(what: str, values: NDArray[Any], dimension: int) -> NDArray[Any]:
    if len(values) != dimension:
        raise InputError(f"{what} has {len(values)} components, but must have {dimension}, one for each axis.")
    return values


@dataclass(frozen=True, eq=False)
class Readings:
    """The readings of one sensor over time."""

    times: NDArray[Any]
    """Times of the readings (readings,) [s]."""
    values: NDArray[Any]
    """Readings (readings, k), with one column for each number of the sensor."""
    units: Mapping[str, str]
    """Units of the sensor's numbers by name, in the order of the columns."""

    def __repr__(self) -> str:
        return f"Readings({len(self.times)} of {', '.join(self.units)})"

    def __getitem__(self, column: str) -> NDArray[Any]:
        """Return one number of the sensor over time, (readings,). Raises `InputError` for an unknown name."""
        if column not in self.units:
            raise InputError(f"a column is {shown(column)}, but must be one of {', '.join(self.units)}.")
        return self.values[:, list(self.units).index(column)]


class SensorLog:
    def __init__(self, sensors: Mapping[str, Sensor], dimension: int):
        for name, sensor in sensors.items():
            if isinstance(sensor, type) or not all(hasattr(sensor, part) for part in ("columns", "value", "adjoint")):
                raise InputError(f"sensors has {shown(sensor)} as {name!r}, but must have a sensor of cortado.sensors.")
        self.sensors = dict(sensors)
        self._units = {name: dict(sensor.columns(dimension)) for name, sensor in self.sensors.items()}
        self._rows: dict[str, list[NDArray[Any]]] = {name: [] for name in self.sensors}

    def read(self, name: str, number: int, reading: Callable[[], NDArray[Any]]) -> None:
        """Store the reading (k,) of state ``number`` once, or NaN if the next step loses a particle."""
        if number == len(self._rows[name]):
            try:
                self._rows[name].append(reading())
            except DivergedError:
                self._rows[name].append(np.full(len(self._units[name]), np.nan))

    def known(self, readings: Mapping[str, Readings]) -> float:
        """Return the number of the last state with readings of all sensors, or infinity without sensors."""
        if any(name not in readings or readings[name].units != self._units[name] for name in self.sensors):
            return -1
        return min((len(readings[name].times) - 1 for name in self.sensors), default=inf)

    def go_on(self, steps: int, readings: Mapping[str, Readings]) -> None:
        self._rows = {name: list(readings[name].values[: steps + 1]) for name in self.sensors}

    def readings(self, times: NDArray[Any]) -> dict[str, Readings]:
        count = min(map(len, self._rows.values()), default=0)
        found = {}
        for name, units in self._units.items():
            values = np.array(self._rows[name][:count]).reshape(count, len(units))
            found[name] = Readings(np.asarray(times)[:count], values, units)
        return found


def as_csv(readings: Mapping[str, Readings]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    heads = [f"{name}.{column} [{unit}]" for name, own in readings.items() for column, unit in own.units.items()]
    writer.writerow([TIME, *heads])
    each = list(readings.values())
    for k, time in enumerate(each[0].times):
        writer.writerow([repr(float(number)) for number in (time, *(value for own in each for value in own.values[k]))])
    return text.getvalue()


def from_csv(path: Path) -> dict[str, Readings]:
    columns = read_columns(path)
    times, found = columns.pop(TIME, np.zeros(0)), dict[str, dict[str, str]]()
    if not len(times):
        raise InputError(f"{path} has the columns {', '.join(columns)}, but must have the column {TIME}.")
    for head in columns:
        name, dot, number = head.rpartition(" [")[0].rpartition(".")
        if not dot or not head.endswith("]"):
            raise InputError(f"{path} has the column {head!r}, but must be a table of readings that Cortado wrote.")
        found.setdefault(name, {})[number] = head.rpartition(" [")[2].removesuffix("]")
    return {
        name: Readings(times, np.stack([columns[f"{name}.{n} [{unit}]"] for n, unit in units.items()], axis=1), units)
        for name, units in found.items()
    }


def summary(readings: Mapping[str, Readings]) -> dict[str, dict[str, dict[str, float]]]:
    """Return the last, the mean and the greatest absolute reading, for each number of each sensor."""
    return {name: {column: _of(own, column) for column in own.units} for name, own in readings.items()}


def _of(read: Readings, column: str) -> dict[str, float]:
    values, times = read[column], read.times
    duration = float(times[-1] - times[0])
    mean = np.trapezoid(values, times) / duration if duration > 0.0 else values[-1]
    known = values[np.isfinite(values)]
    greatest = known[np.abs(known).argmax()] if len(known) else np.nan
    return {"last": float(values[-1]), "mean": float(mean), "greatest": float(greatest)}


@dataclass(frozen=True, eq=False)
class MeasuredColumn:
    name: str
    """Name of the sensor and its number, such as "gauge.height"."""
    unit: str
    times: NDArray[Any]
    values: NDArray[Any]
    """Measured values (k,)."""
    simulated: NDArray[Any]
    """Readings of the sensor at the times of the measured values (k,), linearly interpolated."""
    left_out: int

    @property
    def errors(self) -> dict[str, float]:
        """Return measures of the difference between simulated and measured values, in the unit of the sensor."""
        off = self.simulated - self.values
        worst = int(np.abs(off).argmax())
        return {
            "root_mean_square": float(np.sqrt(np.mean(off**2))),
            "mean": float(off.mean()),
            "greatest": float(abs(off[worst])),
            "greatest_at_s": float(self.times[worst]),
        }


def measured_beside(path: Path, readings: Mapping[str, Readings]) -> list[MeasuredColumn]:
    """Pair the columns of a measured table with sensor readings. A column "time" [s] and columns named as in
    sensors.csv are expected. Units in brackets may be left out, and entries may be empty."""
    columns = read_columns(path)
    named = {name_and_unit(head): values for head, values in columns.items()}
    times = named.get(("time", "s"), named.get(("time", None)))
    known = {f"{name}.{column}": (own, column) for name, own in readings.items() for column in own.units}
    if times is None:
        wanted = f"{TIME}, and at least one of {', '.join(known)}"
        raise InputError(f"{path} has the columns {', '.join(columns)}, but must have {wanted}.")
    found = []
    for (name, its_unit), values in named.items():
        if name == "time":
            continue
        if name not in known:
            raise InputError(f"{path} has the column {name!r}, but the sensors have the columns {', '.join(known)}.")
        own, column = known[name]
        if its_unit is not None and its_unit != own.units[column]:
            raise InputError(f"{path} has {name} in {its_unit}, but {name} must be in {own.units[column]}.")
        there = np.isfinite(times) & np.isfinite(values)
        within = there & (times >= own.times[0]) & (times <= own.times[-1])
        if not within.any():
            ends = f"{own.times[0]:g} to {own.times[-1]:g} s"
            raise InputError(f"{path} has no value of {name} from {ends}, but must have a value during the run.")
        simulated = np.interp(times[within], own.times, own[column])
        left_out = int(np.count_nonzero(there & ~within))
        found.append(MeasuredColumn(name, own.units[column], times[within], values[within], simulated, left_out))
    if not found:
        raise InputError(f"{path} has only times, but must have at least one of {', '.join(known)}.")
    return found


def measured_columns(
    path: Path, units: Mapping[str, str], own: str = "", sensors: Collection[str] = ()
) -> dict[str, NDArray[Any]]:
    """Return columns (lines,) by name. Column names in the file may begin with ``own`` and end with a unit."""
    found: dict[str, NDArray[Any]] = {}
    for head, values in read_columns(path).items():
        name, unit = name_and_unit(head)
        whose, _, column = name.rpartition(".")
        if whose in sensors and whose != own:
            continue
        name = column if whose == own else name
        wanted = {"time": "s", **units}.get(name, unit)
        if unit is not None and unit != wanted:
            raise InputError(f"{path} has {name} in {unit}, but {name} must be in {wanted}.")
        if name in found:
            raise InputError(f"{path} has 2 columns {name!r}, but must have each column once.")
        found[name] = values
    return found
