"""What sensors read in every step of a run."""

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
from cortado.files.csv_columns import read_columns
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
