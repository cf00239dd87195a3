"""One clock for several runs: the times of a film of them, and which frame each run shows at each of these times."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil, log10
from typing import Any

import numpy as np
from numpy.typing import NDArray

SAME = 0.01
"""Of the time between two frames: those that are apart by less are at the same time."""


def common_times(each: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """(frames,) [s] of a film of runs whose frames are at times (own frames,): those of the run with most frames in a
    second, and before and after it those of others."""
    found = np.zeros(0)
    for times in sorted(each, key=lambda own: (interval_of(own), -len(own))):
        if not len(found):
            found = np.asarray(times, dtype=np.float64)
            continue
        apart = 0.5 * interval_of(times)
        outside = (times < found[0] - apart) | (times > found[-1] + apart)
        found = np.sort(np.concatenate([found, times[outside]]))
    return found


def interval_of(times: NDArray[Any]) -> float:
    """The usual time between two frames [s]; infinite with a single one."""
    return float(np.median(np.diff(times))) if len(times) > 1 else np.inf


@dataclass(frozen=True, eq=False)
class ShownFrames:
    """Which frames of one run a film shows: at each of its times the nearest one that was recorded."""

    own: NDArray[Any]
    """(own frames,) when they were recorded [s]"""
    times: NDArray[Any]
    """(frames,) of the film, in the time of the run [s]"""

    @cached_property
    def nearest(self) -> NDArray[np.int64]:
        """(frames,) the number of the run's frame."""
        return np.rint(np.interp(self.times, self.own, np.arange(len(self.own)))).astype(np.int64)

    @cached_property
    def during(self) -> NDArray[np.bool_]:
        """(frames,) whether the run has begun, and has not ended yet."""
        near = SAME * interval_of(self.times)
        return (self.times > self.own[0] - near) & (self.times < self.own[-1] + near)

    @property
    def off(self) -> float:
        """How far a frame is from the time at which it is shown, at most, while the run goes on [s]."""
        return float(np.abs(self.own[self.nearest] - self.times)[self.during].max(initial=0.0))

    def time_in_words(self, k: int) -> str:
        """When the frame was recorded that is shown as frame k, with as many digits as tell frames apart."""
        interval = interval_of(self.times)
        digits = max(ceil(-log10(interval)), 0) if 0.0 < interval < np.inf else 3
        time = f"{self.own[self.nearest[k]]:.{digits}f} s"
        return time if self.during[k] else f"stands still at {time}"

    def notes(self, name: str) -> list[str]:
        """What is to be said of a run of that name."""
        ends = f'"{name}" ends at {self.own[-1]:.4g} s and stands still from then on'
        begins = f'"{name}" begins at {self.own[0]:.4g} s'
        return [note for note, is_on in ((begins, self.during[0]), (ends, self.during[-1])) if not is_on]
