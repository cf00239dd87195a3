"""What sensors have read over a run, in few numbers."""

from collections.abc import Mapping

import numpy as np

from cortado.runs.sensors.log import Readings

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
