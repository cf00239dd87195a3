"""When the frames of a run are due that records so many in a second."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

SAME = 1e-9
"""Of a frame: a state that comes earlier than a frame is due by less is that frame, as times are rounded."""


@dataclass(frozen=True)
class Marks:
    """Frame k is due at the time start + k / rate, and is the first state at that time or after it."""

    start: float
    """[s] when the run began"""
    rate: float
    """[1/s] frames in a second that is simulated"""

    def passed(self, times: NDArray[Any]) -> NDArray[np.int64]:
        """(n,) the number of the last mark at or before each of the times (n,) [s]."""
        return np.floor((np.asarray(times) - self.start) * self.rate + SAME).astype(np.int64)

    def at(self, numbers: NDArray[Any]) -> NDArray[np.float64]:
        """(n,) [s] the times of marks of these numbers (n,)."""
        return self.start + np.asarray(numbers) / self.rate

    def due(self, times: NDArray[Any]) -> NDArray[np.float64]:
        """(frames,) [s] when frames recorded at ``times`` (frames,) were due. The last state of a run, which may be at
        no mark, and states that are farther apart than marks have their own times."""
        numbers = self.passed(times)
        one_by_one = np.diff(numbers, prepend=numbers[:1] - 1) == 1
        return np.where(one_by_one, self.at(numbers), times)

    def chosen(self, times: NDArray[Any], stride: int) -> Marks | None:
        """The marks of every so many frames of a run, of those recorded at ``times`` (frames,) [s]; None where they are
        not evenly spaced among the marks, but for the last."""
        numbers = self.passed(times)
        apart = np.diff(numbers)
        every = 1 if stride == 1 else int(apart[0]) if len(apart) else 0
        if not len(numbers) or every < 1 or (stride != 1 and ((apart[:-1] != every).any() or apart[-1] > every)):
            return None
        return Marks(float(self.at(numbers[0])), self.rate / every)


def common_rate(each: Iterable[Marks | None]) -> float | None:
    """[1/s] how many frames in a second all of several runs record; None where not all of them say so, or another
    number."""
    rates = {None if marks is None else marks.rate for marks in each}
    return rates.pop() if len(rates) == 1 else None
