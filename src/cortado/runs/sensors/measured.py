"""Measured data beside what the sensors of a run have read: a table like sensors.csv, and how far apart they are."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError
from cortado.files.csv_columns import read_columns
from cortado.runs.sensors.log import TIME, Readings


@dataclass(frozen=True, eq=False)
class Measured:
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


def measured_beside(path: Path, readings: Mapping[str, Readings]) -> list[Measured]:
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
        found.append(Measured(name, own.units[column], times[within], values[within], simulated, left_out))
    if not found:
        raise InputError(f"{path} has times alone, but must have some of {', '.join(known)}.")
    return found


def _name_and_unit(head: str) -> tuple[str, str | None]:
    """Of a column; None where it has no unit in brackets."""
    name, bracket, unit = head.partition("[")
    return name.strip(), unit.rstrip().removesuffix("]").strip() if bracket else None
