"""What was measured of an experiment, and what a simulation says of the same."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from cortado.arrays import as_numbers, as_one_number, read_only
from cortado.errors import InputError, shown
from cortado.losses import Snapshot
from cortado.scene.parameter_values import Arrays

CLOCK = "start"
"""The parameter of an observation that says when its frames are."""
LEAST_FRAMES = 4
"""Of an observation: the scatter from frame to frame is what error bars are made of."""


@dataclass(frozen=True)
class Direction:
    """A direction of a derivative, as an observation of one state sees it."""

    fields: Arrays
    """The tangent of the state, by fields: vectors (n, d), fractions (n, phases)."""
    parameters: Mapping[str, np.ndarray]
    """The direction of the parameters of the simulation, by name."""
    own: Mapping[str, np.ndarray]
    """The direction of the observation's own parameters, by name."""
    quantities: Callable[[Iterable[str]], Arrays]
    """The tangents of quantities of the particles, by name."""


class Observation(Protocol):
    """Numbers that were measured at several times, which are called frames, and how a state predicts them."""

    times: np.ndarray
    """(frames,) [s] after the start of the run, rising."""
    measured: np.ndarray
    """(frames, m); NaN for a number that does not count."""
    noise: float | None
    """Standard deviation of a number, as far as it is known; None where the residuals shall tell."""
    unit: str
    """Of the numbers."""

    @property
    def start(self) -> Mapping[str, np.ndarray]:
        """Its own parameters, such as those of a camera, as the fit starts. One that is called "start" is a clock [s]:
        frames are later by as much as it grows, which an `Experiment` sees to."""

    def value(self, at: Snapshot, own: Mapping[str, np.ndarray]) -> np.ndarray:
        """(m,) what a state predicts, given values of its own parameters."""

    def tangents(self, at: Snapshot, own: Mapping[str, np.ndarray], along: Sequence[Direction]) -> np.ndarray:
        """(m, directions) the derivatives of `value` along directions."""


class Again:
    """An observation with other numbers measured."""

    def __init__(self, observation: Observation, measured: np.ndarray):
        own = Measurement.of(observation.times, measured, observation.noise)
        if own.measured.shape != observation.measured.shape:
            raise InputError(f"measured has shape {own.measured.shape}, but must be {observation.measured.shape}.")
        self._observation, self.measured = observation, own.measured

    def __getattr__(self, name: str) -> Any:
        if name == "_observation":  # while it is unpickled
            raise AttributeError(name)
        return getattr(self._observation, name)


@dataclass(frozen=True)
class Frames:
    """Where the frames of an observation are between the steps of a run: in between two states what they predict is
    interpolated linearly."""

    steps: np.ndarray
    """(frames,) number of steps before each frame."""
    shares: np.ndarray
    """(frames,) of the state after the next step, from 0 to 1."""

    @classmethod
    def of(cls, times: np.ndarray, time_step: float, steps: int) -> "Frames":
        """Raises `InputError` for times beyond the run."""
        places = times / time_step
        if places[-1] > steps + 1e-6:
            raise InputError(
                f"times go up to {times[-1]:g} s, but must end with the run, after {steps} steps of {time_step:g} s."
            )
        whole = np.minimum(np.floor(places + 1e-6).astype(int), steps)
        shares = np.clip(places - whole, 0.0, 1.0)
        return cls(whole, np.where(shares < 1e-6, 0.0, shares))

    @property
    def needed(self) -> set[int]:
        """The states that are read."""
        return {int(k) for k in self.steps} | {int(k) + 1 for k in self.steps[self.shares > 0.0]}

    @property
    def around(self) -> set[int]:
        """The states that `rates` reads."""
        return {int(k) + more for k in self.steps for more in (0, 1)}

    def rates(self, read: Mapping[int, np.ndarray], time_step: float) -> np.ndarray:
        """(frames, ...) of what was read of the states, by how much it changes in a second."""
        return np.array([(read[int(k) + 1] - read[int(k)]) / time_step for k in self.steps])

    def between(self, read: Mapping[int, np.ndarray]) -> np.ndarray:
        """(frames, ...) of what was read of the states."""
        last = max(read)
        after = [read[min(int(k) + int(share > 0.0), last)] for k, share in zip(self.steps, self.shares, strict=True)]
        before = np.array([read[int(k)] for k in self.steps])
        shares = self.shares.reshape(-1, *[1] * (before.ndim - 1))
        return (1.0 - shares) * before + shares * np.array(after)


def clock_of(calibrate: Sequence[str], start: float) -> dict[str, np.ndarray]:
    """The parameter of a clock that is calibrated, which shows ``start`` [s] of the run where it should show 0."""
    return {CLOCK: np.array(as_one_number("clock", start))} if CLOCK in calibrate else {}


def only_a_clock(calibrate: Sequence[str]) -> None:
    """Raises `InputError` for anything else."""
    for name in calibrate:
        if name != CLOCK:
            raise InputError(f"calibrate has {shown(name)}, but must be made of {CLOCK}.")


@dataclass(frozen=True)
class Measurement:
    """What all observations have, checked."""

    times: np.ndarray
    measured: np.ndarray
    noise: float | None = field(default=None)

    @classmethod
    def of(cls, times: Any, measured: Any, noise: Any, clock: Any = 0.0) -> "Measurement":
        """Raises `InputError` for what cannot be fitted. ``clock`` [s] is added to the times."""
        moments = read_only("times", as_numbers("times", times) + as_one_number("clock", clock))
        values = read_only("measured", measured)
        if moments.ndim != 1 or len(moments) < LEAST_FRAMES:
            found = f"has {len(moments)}" if moments.ndim == 1 else f"has shape {moments.shape}"
            raise InputError(
                f"times {found}, but must be a list of at least {LEAST_FRAMES} rising numbers, as error bars come from "
                "the scatter from frame to frame."
            )
        if (falls := np.flatnonzero(np.diff(moments) <= 0.0)).size:
            before, after = moments[falls[0] : falls[0] + 2]
            raise InputError(f"times has {after:g} s after {before:g} s, but must rise from frame to frame.")
        if not np.isfinite(moments).all() or moments[0] < 0.0:
            raise InputError(f"times begin with {moments[0]:g} s, but must be finite and not before the run.")
        if values.ndim != 2 or len(values) != len(moments):
            raise InputError(
                f"measured has shape {values.shape}, but must have {len(moments)} rows, one for each time."
            )
        if np.isinf(values).any() or np.isnan(values).all():
            raise InputError("measured must be finite, or NaN for what does not count, but not for all of it.")
        if noise is not None and not 0.0 < as_one_number("noise", noise) < np.inf:
            raise InputError(f"noise is {shown(noise)}, but must be greater than 0.")
        return cls(moments, values, None if noise is None else float(noise))
