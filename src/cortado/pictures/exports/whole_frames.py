"""The times of a run at which an animation shows it: whole frames, so many in each second."""

from dataclasses import dataclass
from math import floor

import numpy as np
from numpy.typing import NDArray

from cortado.runs.marks import SAME, Marks

EVEN = 1e-6
"""Recorded frames whose distances in time differ by less than this part are evenly spaced."""
DIGITS = (0, 1, 2, 3)
"""Places behind the point that a number of frames in a second may have where recorded frames are not evenly spaced."""


@dataclass(frozen=True)
class WholeFrames:
    """Frame k of an animation is at the time start + k / rate; each is a recorded state, moved to that time."""

    rate: float
    """[1/s] frames in a second"""
    times: NDArray[np.float64]
    """(frames,) [s]"""
    recorded: NDArray[np.intp]
    """(frames,) the number of the recorded state that it is made of: the nearest in time, or of a run with marks the
    first one from then on, as a step back along velocities is the way between the states of a step"""
    shifts: NDArray[np.float64]
    """(frames,) [s] from the time of that state to that of the frame; 0 where recorded states are evenly spaced"""
    left_out: float
    """[s] how much later than the last frame the run ends"""

    @classmethod
    def of(cls, times: NDArray[np.float64], marks: Marks | None = None) -> "WholeFrames":
        """The frames for states recorded at ``times`` (m,) [s]: at the ``marks`` for which they were. Without marks,
        evenly spaced states are the frames; of others the rate is a round number near that of the states."""
        if marks is not None:
            whole = marks.at(np.arange(int(marks.passed(times[-1:])[0]) + 1))
            recorded = np.searchsorted(times, whole - SAME / marks.rate)
            shifts = whole - times[recorded]
            shifts[np.abs(shifts) < EVEN / marks.rate] = 0.0
            return cls(marks.rate, whole, recorded, shifts, float(times[-1] - whole[-1]))
        steps = np.diff(times)
        if not len(steps):
            return cls(24.0, times, np.zeros(1, dtype=np.intp), np.zeros(1), 0.0)
        start, usual = float(times[0]), float(steps[0])
        if (np.abs(steps[:-1] / usual - 1.0) < EVEN).all() and steps[-1] < usual * (1.0 + EVEN):
            rate, count = 1.0 / usual, len(times) if steps[-1] > usual * (1.0 - EVEN) else len(times) - 1
            return cls(rate, times[:count], np.arange(count), np.zeros(count), float(times[-1] - times[count - 1]))
        rate = _round_rate(times - start)
        whole = start + np.arange(floor((times[-1] - start) * rate + EVEN) + 1) / rate
        recorded = _nearest(times, whole)
        return cls(rate, whole, recorded, whole - times[recorded], float(times[-1] - whole[-1]))

    @property
    def in_words(self) -> str:
        """How the frames differ from recorded states; empty where they do not."""
        found = []
        if self.shifts.any():
            most = 1e3 * float(np.abs(self.shifts).max())
            found.append(f"states are moved along their velocities to whole frames, by at most {most:.3g} ms")
        if self.left_out > EVEN / self.rate:
            found.append(f"the last state, {1e3 * self.left_out:.3g} ms after the last whole frame, is left out")
        return "; ".join(found)


def _round_rate(times: NDArray[np.float64]) -> float:
    """[1/s] the roundest number of frames in a second of which each is the nearest to one of the states, recorded at
    ``times`` (m,) [s] from 0 on, the last apart; the mean number where there is none."""
    usual = times[:-1]
    mean = (len(usual) - 1) / float(usual[-1])
    for digits in DIGITS:
        rate = round(mean, digits)
        if rate > 0.0 and (np.abs(usual - np.arange(len(usual)) / rate) < 0.5 / rate).all():
            return rate
    return float(f"{mean:.3g}")


def _nearest(times: NDArray[np.float64], wanted: NDArray[np.float64]) -> NDArray[np.intp]:
    """(k,) the numbers of those of increasing ``times`` (m,) that are nearest to ``wanted`` (k,)."""
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    return np.where(wanted - times[after - 1] <= times[after] - wanted, after - 1, after)
