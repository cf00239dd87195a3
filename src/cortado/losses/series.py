"""A sensor against a measured series."""

from hashlib import sha256
from typing import Any

import numpy as np

from cortado.arrays import as_numbers, as_one_number, read_only, whole_number
from cortado.calls import fixed
from cortado.errors import InputError
from cortado.losses.loss import Adjoint, Frames, Snapshot
from cortado.runs.sensor import Sensor, checked_sensor, value_of

SAME = 1e-6
"""Relative: time steps that differ by less are the same, as one of them may have been rounded to float32."""


@fixed
class SensorMatch:
    """Sum of the squared differences of what a sensor reads from what it should read, over squared scales."""

    def __init__(self, sensor: Sensor, target: Any, weight: float = 1.0, scale: Any = 1.0):
        """``target`` (k,), a number for each column of the sensor, NaN for one that does not count; ``weight`` of the
        sum; ``scale``, a number or (k,)."""
        self.sensor, self.weight = checked_sensor(sensor), as_one_number("weight", weight)
        self.target = np.atleast_1d(read_only("target", target))
        self.scale = np.broadcast_to(as_numbers("scale", scale), self.target.shape)
        arrays = self.target.tobytes() + self.scale.tobytes()
        self.fingerprint = sha256(f"{sensor!r} {self.weight!r}".encode() + arrays).hexdigest()
        """Tells one target from another, for checkpoints."""

    def value(self, end: Snapshot) -> float:
        return self.weight * float((self._miss(end) ** 2).sum())

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        bar = 2.0 * self.weight * self._miss(end) / self.scale
        return self.value(end), self.sensor.adjoint(end, bar)

    def _miss(self, end: Snapshot) -> np.ndarray:
        found = value_of(self.sensor, end)
        if found.shape != self.target.shape:
            columns = ", ".join(self.sensor.columns(end.dimension))
            raise InputError(
                f"values has {len(self.target)} columns, but must have {len(found)}, those of the sensor: {columns}."
            )
        return np.where(np.isnan(self.target), 0.0, found - self.target) / self.scale


@fixed
class Series(Frames):
    """A sensor against a measured series: the mean over steps of the squared difference of the two, all columns added
    up.

    The series is interpolated linearly to the times of the steps; steps before its first and after its last time do not
    count.
    """

    def __init__(self, sensor: Sensor, times: Any, values: Any, time_step: float, every: int = 1, scale: Any = 1.0):
        """``times`` (m,) [s], rising; ``values`` (m,) or (m, k), a number for each column of the sensor, NaN for one
        that does not count; ``time_step`` of the problem [s]; ``every``: take only every so many steps into account;
        ``scale``: what a difference is divided by, a number or (k,)."""
        moments, series = read_only("times", times), as_numbers("values", values)
        series = series[:, None] if series.ndim == 1 else series
        if moments.ndim != 1 or len(moments) < 2 or not (np.diff(moments) > 0.0).all():
            raise InputError("times must be a list of at least two rising numbers.")
        if series.ndim != 2 or len(series) != len(moments):
            raise InputError(f"values has shape {series.shape}, but must have {len(moments)} rows, one for each time.")
        if np.isinf(series).any() or np.isnan(series).all():
            raise InputError("values must be finite, or NaN for those that do not count, but not for all of them.")
        columns, sizes = series.shape[1], as_numbers("scale", scale)
        if sizes.shape not in ((), (columns,)):
            raise InputError(
                f"scale has shape {sizes.shape}, but must be a number or ({columns},), one for each column."
            )
        if not (sizes > 0.0).all():
            raise InputError("scale must be greater than 0.")
        step, stride = as_one_number("time_step", time_step), whole_number("every", every, 1)
        if not step > 0.0:
            raise InputError(f"time_step is {step:g}, but must be greater than 0.")
        first, last = int(np.ceil(moments[0] / step - 1e-9)), int(np.floor(moments[-1] / step + 1e-9))
        steps = [k for k in range(max(first, 0), last + 1) if k % stride == 0]
        if not steps:
            raise InputError(f"times go from {moments[0]:g} to {moments[-1]:g} s, between which there is no step.")
        rows = np.stack([np.interp(np.array(steps) * step, moments, column) for column in series.T], axis=1)
        weight = 1.0 / len(steps)
        self.time_step = step
        super().__init__({k: SensorMatch(sensor, row, weight, scale) for k, row in zip(steps, rows, strict=True)})

    def check(self, time_steps: np.ndarray) -> None:
        """The states are of the times that their numbers of steps stand for in the series."""
        other = time_steps[np.abs(time_steps - self.time_step) > SAME * time_steps]
        if len(other):
            found = f"time_step of the series is {self.time_step:g} s"
            raise InputError(f"{found}, but must be that of the run, {other[0]:g} s, which cannot be varied beside it.")
