"""The series of a sensor: a force, a pressure, a flow, the height of a surface."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cortado.arrays import as_numbers
from cortado.errors import InputError, shown
from cortado.fixed import fixed
from cortado.losses import Snapshot
from cortado.optimisation.fitting.observation import Direction, Measurement, clock_of, only_a_clock
from cortado.runs.sensors.sensor import Sensor, checked_sensor, value_of


@fixed
class SensorSeries:
    """What a sensor measured over time."""

    def __init__(
        self,
        sensor: Sensor,
        times: Any,
        values: Any,
        dimension: int,
        columns: Sequence[str] | None = None,
        noise: float | None = None,
        calibrate: Sequence[str] = (),
        clock: float = 0.0,
    ):
        """``sensor`` of `cortado.sensors`; ``times`` (frames,) [s] after the start of the run; ``values`` (frames,) or
        (frames, k) in the sensor's units, NaN for what does not count; ``dimension`` of the scene; ``columns``, the
        names of the k numbers of the sensor that were measured, all of them if left out; ``noise``, their standard
        deviation, if it is known; ``clock`` [s], what is added to the times, which ``calibrate=["start"]`` searches."""
        only_a_clock(calibrate)
        self.sensor = checked_sensor(sensor)
        known = dict(sensor.columns(dimension))
        names = list(known) if columns is None else list(columns)
        for name in names:
            if name not in known:
                raise InputError(f"a column is {shown(name)}, but must be one of {', '.join(known)}.")
        array = as_numbers("values", values)
        array = array[:, None] if array.ndim == 1 else array
        if array.ndim != 2 or array.shape[1] != len(names):
            raise InputError(f"values has shape {array.shape}, but must have columns for {', '.join(names)}.")
        if len({known[name] for name in names}) > 1:
            raise InputError(f"columns are {', '.join(names)}, but must be of one unit: give each unit a series.")
        self.start = clock_of(calibrate, clock)
        own = Measurement.of(times, array, noise, clock)
        self.times, self.measured, self.noise = own.times, own.measured, own.noise
        self.unit, self.columns = known[names[0]], tuple(names)
        self._picked = np.array([list(known).index(name) for name in names])
        self._width = len(known)

    def value(self, at: Snapshot, own: Mapping[str, np.ndarray]) -> np.ndarray:
        return value_of(self.sensor, at)[self._picked]

    def tangents(self, at: Snapshot, own: Mapping[str, np.ndarray], along: Sequence[Direction]) -> np.ndarray:
        """By the adjoint of each number, which is all that sensors have."""
        rows = [self.sensor.adjoint(at, np.eye(self._width)[k]) for k in self._picked]
        others = [name for name in rows[0] if along and name not in along[0].fields]
        found = np.zeros((len(rows), len(along)))
        for k, one in enumerate(along):
            dots = {**one.fields, **one.quantities(others)}
            found[:, k] = [sum(float((bar * dots[name]).sum()) for name, bar in row.items()) for row in rows]
        return found
