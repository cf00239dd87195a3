"""Readings of sensors in every step of a run: arrays, a table in a file, a summary, and measured data beside them."""

import csv
import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.errors import DivergedError, InputError, shown
from cortado.files.input_files import read_columns
from cortado.runs.sensors.sensor import Reading, Sensor, value_of

TIME = "time [s]"
"""The first column of a table of readings."""


@dataclass(frozen=True, eq=False)
class Readings:
    """What one sensor has read."""

    times: NDArray[Any]
    """(readings,) [s]"""
    values: NDArray[Any]
    """(readings, k)"""
    units: Mapping[str, str]
    """Of its numbers, by their names, in their order."""

    def __repr__(self) -> str:
        return f"Readings({len(self.times)} of {', '.join(self.units)})"

    def __getitem__(self, column: str) -> NDArray[Any]:
        """(readings,) one of its numbers, by name; raises `InputError` where there is no such."""
        if column not in self.units:
            raise InputError(f"a column is {shown(column)}, but must be one of {', '.join(self.units)}.")
        return self.values[:, list(self.units).index(column)]


class SensorLog:
    """The numbers of several sensors, state by state."""

    def __init__(self, sensors: Mapping[str, Sensor], dimension: int):
        """``sensors`` by the names that tell them apart. Raises `InputError` for what is no sensor."""
        if not isinstance(sensors, Mapping):
            raise InputError(f"sensors is {shown(sensors)}, but must be a table of sensors by name.")
        for name, sensor in sensors.items():
            if isinstance(sensor, type) or not all(hasattr(sensor, part) for part in ("columns", "value", "adjoint")):
                raise InputError(f"sensors has {shown(sensor)} as {name!r}, but must have a sensor of cortado.sensors.")
        self.sensors = dict(sensors)
        self._units = {name: dict(sensor.columns(dimension)) for name, sensor in self.sensors.items()}
        self._rows: list[dict[str, NDArray[Any]]] = []
        """One for each state that all sensors have read: an interruption leaves whole rows."""

    def read(self, at: Reading) -> None:
        """Have every sensor read a state."""
        self._rows.append({name: self._value(name, sensor, at) for name, sensor in self.sensors.items()})

    def known(self, readings: Mapping[str, Readings]) -> float:
        """The last step of which there are all readings of these sensors; infinite without sensors."""
        if any(name not in readings or readings[name].units != self._units[name] for name in self.sensors):
            return -1
        return min((len(readings[name].times) - 1 for name in self.sensors), default=inf)

    def go_on(self, steps: int, readings: Mapping[str, Readings]) -> None:
        """Have what was read of the first state and after so many steps."""
        self._rows = [{name: readings[name].values[k] for name in self.sensors} for k in range(steps + 1)]

    def _value(self, name: str, sensor: Sensor, at: Reading) -> NDArray[Any]:
        """NaN where the step after the state loses a particle: the run says so where it takes it."""
        try:
            return value_of(sensor, at)
        except DivergedError:
            return np.full(len(self._units[name]), np.nan)

    def readings(self, times: NDArray[Any]) -> dict[str, Readings]:
        """What was read, at the first of these times [s]."""
        found = {}
        for name, units in self._units.items():
            values = np.array([row[name] for row in self._rows]).reshape(len(self._rows), len(units))
            found[name] = Readings(np.asarray(times)[: len(self._rows)], values, units)
        return found


def as_csv(readings: Mapping[str, Readings]) -> str:
    """A table with a column for the time and one for each number of each sensor, the unit in its head."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    heads = [f"{name}.{column} [{unit}]" for name, own in readings.items() for column, unit in own.units.items()]
    writer.writerow([TIME, *heads])
    writer.writerows(_rows(list(readings.values())))
    return text.getvalue()


def from_csv(path: Path) -> dict[str, Readings]:
    """What `as_csv` wrote into a file; raises `InputError` for anything else."""
    columns = read_columns(path)
    times, found = columns.pop(TIME, np.zeros(0)), dict[str, dict[str, str]]()
    if not len(times):
        raise InputError(f"{path} has the columns {', '.join(columns)}, but must have {TIME}.")
    for head in columns:
        name, dot, number = head.rpartition(" [")[0].rpartition(".")
        if not dot or not head.endswith("]"):
            raise InputError(f"{path} has the column {head!r}, but must be a table of readings that Cortado wrote.")
        found.setdefault(name, {})[number] = head.rpartition(" [")[2].removesuffix("]")
    return {
        name: Readings(times, np.stack([columns[f"{name}.{n} [{unit}]"] for n, unit in units.items()], axis=1), units)
        for name, units in found.items()
    }


def _rows(readings: list[Readings]) -> Iterable[list[str]]:
    for k, time in enumerate(readings[0].times):
        yield [repr(float(number)) for number in (time, *(value for own in readings for value in own.values[k]))]


Summary = dict[str, dict[str, dict[str, float]]]
"""By the sensor, by its number, by what it is: ``last``, ``mean`` and ``greatest``."""


def summary(readings: Mapping[str, Readings]) -> Summary:
    """Of each number of each sensor the last reading, the mean over time, and the greatest: the reading farthest from
    0, with its sign."""
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
    """What was measured of one number of a sensor, at times within the run."""

    name: str
    """"gauge.height" of the sensor gauge."""
    unit: str
    times: NDArray[Any]
    """(k,) [s], of those that are within the run."""
    values: NDArray[Any]
    """(k,)"""
    simulated: NDArray[Any]
    """(k,) what the sensor read then: between two steps interpolated linearly."""
    left_out: int
    """Measured points that are before or after the run."""

    @property
    def errors(self) -> dict[str, float]:
        """Of the simulated less the measured values, in the sensor's unit."""
        off = self.simulated - self.values
        worst = int(np.abs(off).argmax())
        return {
            "root_mean_square": float(np.sqrt(np.mean(off**2))),
            "mean": float(off.mean()),
            "greatest": float(abs(off[worst])),
            "greatest_at_s": float(self.times[worst]),
        }


def measured_beside(path: Path, readings: Mapping[str, Readings]) -> list[MeasuredColumn]:
    """The columns of a table of measured data, each beside the readings of a run's sensor.

    The table has a column "time" [s] and columns such as "gauge.height", named as in sensors.csv; units in brackets may
    be left out, and so may entries.

    Raises:
        InputError: a file that is no such table, columns of no sensor or in another unit, or no point within the run.
    """
    columns = read_columns(path)
    named = {_name_and_unit(head): values for head, values in columns.items()}
    times = named.get(("time", "s"), named.get(("time", None)))
    known = {f"{name}.{column}": (own, column) for name, own in readings.items() for column in own.units}
    if times is None:
        wanted = f"{TIME}, and some of {', '.join(known)}"
        raise InputError(f"{path} has the columns {', '.join(columns)}, but must have {wanted}.")
    found = []
    for (name, unit), values in named.items():
        if name == "time":
            continue
        if name not in known:
            raise InputError(f"{path} has the column {name!r}, but must have some of {', '.join(known)}.")
        own, column = known[name]
        if unit is not None and unit != own.units[column]:
            raise InputError(f"{path} has {name} in {unit}, but must have it in {own.units[column]}.")
        there = np.isfinite(times) & np.isfinite(values)
        within = there & (times >= own.times[0]) & (times <= own.times[-1])
        if not within.any():
            ends = f"{own.times[0]:g} to {own.times[-1]:g} s"
            raise InputError(f"{path} has no value of {name} within the run, but must have some from {ends}.")
        simulated = np.interp(times[within], own.times, own[column])
        left_out = int(np.count_nonzero(there & ~within))
        found.append(MeasuredColumn(name, own.units[column], times[within], values[within], simulated, left_out))
    if not found:
        raise InputError(f"{path} has times alone, but must have some of {', '.join(known)}.")
    return found


def _name_and_unit(head: str) -> tuple[str, str | None]:
    """Of a column; None where it has no unit in brackets."""
    name, bracket, unit = head.partition("[")
    return name.strip(), unit.rstrip().removesuffix("]").strip() if bracket else None
