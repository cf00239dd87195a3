"""Which states of a run become frames of its trajectory: every so many steps, or so many in a simulated second."""

from dataclasses import dataclass
from math import inf
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError
from cortado.rollout.durations import expected_frames
from cortado.rollout.rollout import Rollout
from cortado.runs.marks import Marks
from cortado.scene.restart import Clock


class FrameChoice(Protocol):
    """Which states are frames, besides the first and the last."""

    @property
    def settings(self) -> dict[str, Any]:
        """By which one run is told from another."""

    @property
    def rate(self) -> float | None:
        """[1/s] frames in a second that is simulated; None where steps are chosen, not times."""

    def is_due(self, step: int, before: float, now: float) -> bool:
        """Whether the state after a step is a frame, given how long after the first state [s] the one before and itself
        are."""

    def announced(self, rollout: Rollout) -> NDArray[Any]:
        """(frames,) [s] as many as there can be, at the times that are known before the run, others about then."""

    def expected(self, rollout: Rollout) -> int:
        """How many frames are likely to come."""

    def count(self, steps: int, time: float | None) -> int | None:
        """How many frames so many steps of one length have that simulate a time [s]; None where that depends on a time
        that is not known."""


@dataclass(frozen=True)
class EverySteps:
    """A frame for every so many steps."""

    steps: int

    @property
    def settings(self) -> dict[str, Any]:
        """See `FrameChoice`."""
        return {"record_every": self.steps}

    @property
    def rate(self) -> None:
        """See `FrameChoice`."""

    def is_due(self, step: int, before: float, now: float) -> bool:
        """See `FrameChoice`."""
        return step % self.steps == 0

    def announced(self, rollout: Rollout) -> NDArray[Any]:
        """See `FrameChoice`."""
        recorded = np.array([*range(0, rollout.steps, self.steps), rollout.steps])
        return _clock(rollout).times(recorded, float(rollout.time_steps[0]))

    def expected(self, rollout: Rollout) -> int:
        """See `FrameChoice`."""
        return expected_frames(rollout, self.steps)

    def count(self, steps: int, time: float | None) -> int:
        """See `FrameChoice`."""
        return 1 + -(-steps // self.steps)


@dataclass(frozen=True)
class FramesPerSecond:
    """So many frames in each second that is simulated: each is the first state at its time or after it.

    Raises:
        InputError: a rate that is not a number greater than 0.
    """

    rate: float
    """[1/s]"""

    def __post_init__(self) -> None:
        if not 0.0 < self.rate < inf:
            raise InputError(f"--fps is {self.rate:g}, but must be a number of frames in a second greater than 0.")

    @property
    def settings(self) -> dict[str, Any]:
        """See `FrameChoice`."""
        return {"fps": self.rate}

    def is_due(self, step: int, before: float, now: float) -> bool:
        """See `FrameChoice`."""
        passed, due = Marks(0.0, self.rate).passed(np.array([before, now])).tolist()
        return due > passed

    def announced(self, rollout: Rollout) -> NDArray[Any]:
        """See `FrameChoice`."""
        start, size = rollout.clocks[0].time, float(rollout.time_steps[0])  # where steps are chosen the longest one
        duration = min(rollout.steps * size, rollout.step_sizes.end - start + size)
        return Marks(start, self.rate).at(np.arange(min(rollout.steps, int(duration * self.rate) + 1) + 2))

    def expected(self, rollout: Rollout) -> int:
        """See `FrameChoice`."""
        return len(self.announced(rollout))

    def count(self, steps: int, time: float | None) -> int | None:
        """See `FrameChoice`."""
        if time is None:
            return None
        before, due = Marks(0.0, self.rate).passed(np.array([time - time / steps, time])).tolist()
        return 1 + min(steps, due if due > before else due + 1)


def _clock(rollout: Rollout) -> Clock:
    """Of the first state, as steps of one length go on from it."""
    return Clock(rollout.clocks[0].steps, rollout.clocks[0].time)
