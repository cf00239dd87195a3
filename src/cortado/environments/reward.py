"""The reward of a step, and the same as a loss of the state after it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.device.threads import WARP
from cortado.discretise.room import WITHOUT_PERIODS, Domain
from cortado.environments.terms import StepEnd, Term
from cortado.losses.loss import Snapshot, SnapshotBatch
from cortado.particles.state import State


@dataclass(frozen=True)
class Reward:
    """A constant, and terms times their weights."""

    terms: tuple[tuple[float, Term], ...]
    constant: float = 0.0
    domain: Domain = WITHOUT_PERIODS
    """Along which axes the scene repeats."""

    def at(self, state: State, goal: NDArray, step: NDArray) -> StepEnd:
        """What it is a function of: the states of all scenes, with ``goal`` and ``step`` as of `StepEnd`."""
        return StepEnd(state, goal, step, self.domain)

    @WARP
    def values(self, at: StepEnd) -> NDArray:
        """(scenes,)"""
        found = np.full(at.scenes, self.constant)
        for weight, term in self.terms:
            found += weight * term.values(at)
        return found

    @WARP
    def adjoint(self, at: StepEnd, factor: float) -> State:
        """The derivative times ``factor``."""
        bar, each = at.state.like(), np.full(at.scenes, factor)
        for weight, term in self.terms:
            term.adjoint(at, weight * each, bar)
        return bar


@dataclass(frozen=True)
class MinusReward:
    """The loss of one step: minus its reward."""

    reward: Reward
    goal: NDArray
    """(scenes, g), or (1, g) for all of them"""
    step: int
    """Which step of the episode it is, counted from 1."""

    @property
    def fingerprint(self) -> str:
        """Tells one step from another, for checkpoints."""
        return f"{[(weight, type(term).__name__) for weight, term in self.reward.terms]} {self.goal} {self.step}"

    def value(self, end: Snapshot) -> float:
        return -float(self.reward.values(self._at(end))[0])

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, State]:
        return self.value(end), self.reward.adjoint(self._at(end), -1.0)

    def values(self, end: SnapshotBatch) -> NDArray:
        """See `losses.batch.BatchedLoss`."""
        return -self.reward.values(self._at(end))

    def values_and_adjoint(self, end: SnapshotBatch) -> tuple[NDArray, State]:
        """See `losses.batch.BatchedLoss`."""
        return self.values(end), self.reward.adjoint(self._at(end), -1.0)

    def _at(self, end: Any) -> StepEnd:
        scenes = end.state.batch or 1
        goal = np.broadcast_to(self.goal, (scenes, self.goal.shape[1]))
        return self.reward.at(end.state, goal, np.full(scenes, self.step))
