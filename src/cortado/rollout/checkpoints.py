"""States that a run keeps on its way forward, so that another way may lead back, and one that it goes on from."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from math import isqrt

import numpy as np

from cortado.errors import InputError
from cortado.particles.state import State, StateSeries
from cortado.rollout.step_sizes import StepSizes

MEMORY_BUDGET = 8 * 2**30
"""Bytes of checkpoints; beyond it states are kept less often and recomputed on the way back."""


def checkpoint_interval(steps: int, affordable: int) -> int:
    """Steps from one checkpoint to the next: the fewest with which no more states than affordable are alive at a time,
    those between two checkpoints included; about the square root of the steps where that cannot be."""
    if steps <= affordable:
        return 1
    intervals = range(1, isqrt(steps) + 2)
    return next((n for n in intervals if -(-steps // n) + n <= affordable), isqrt(steps) + 1)


class Checkpoints:
    """Of one evaluation of a rollout."""

    def __init__(self, first: State, interval: int):
        """``interval``: steps from one to the next."""
        self._first, self._interval = first, interval
        self._states: dict[int, Callable[[], State]] = {0: lambda: first}
        """By their number, each as what gives the state."""
        self._copies: list[StateSeries] = []
        """Of whole chunks, which hold them."""

    def __len__(self) -> int:
        return len(self._states)

    def keep(self, step: int, chunk: list[State], series: StateSeries, length: int, spare: list[StateSeries]) -> None:
        """Keep some of the states after a step. A chunk of the greatest ``length`` is all of a ``series``, and is
        copied at once, to one of those that are ``spare``."""
        numbers = [n for n in range(step + 1, step + len(chunk) + 1) if n % self._interval == 0]
        if len(numbers) == length:
            copy = spare.pop() if spare else series.like()
            copy.assign(series)
            self._copies.append(copy)
            self._states |= {n: partial(copy.state, k) for k, n in enumerate(numbers)}
            return
        for n in numbers:
            state = self._first.following()
            state.assign(chunk[n - step - 1])
            self._states[n] = partial(_itself, state)

    def state(self, n: int, next_state: Callable[[int, State], State]) -> State:
        """State n, asked for from the last to the first: a checkpoint, or computed once more from the one before, with
        the states in between, by ``next_state(m, state m)``."""
        if n not in self._states:
            for m in range(n - n % self._interval, n):
                self._states[m + 1] = partial(_itself, next_state(m, self._states[m]()))
        if (n + 1) % self._interval:
            self._states.pop(n + 1, None)
        return self._states[n]()

    def release(self) -> list[StateSeries]:
        """The copies of whole chunks, which nobody may come back to any more."""
        copies, self._copies = self._copies, []
        return copies


def _itself(state: State) -> State:
    return state


@dataclass(frozen=True)
class Progress:
    """How far an earlier process came with the same first state, parameters and steps of a single scene. The rest of
    the run has the same bits as if that process had not stopped."""

    step: int = 0
    """Steps that it took."""
    state: State | None = None
    """The state after them; None of the first one."""
    diagnostics: Mapping[str, np.ndarray] = field(default_factory=dict)
    """(step,) by name, what was noted of these steps."""

    def begin(self, initial: State, sizes: StepSizes, keep: bool) -> tuple[State, int, bool]:
        """The state to go on from, its number, and whether the run ends with it. Raises `InputError` where states shall
        be kept for a backward pass, as those before are not known."""
        if self.state is None:
            return initial, 0, False
        if keep:
            raise InputError("keep is True, but must be False in a run that goes on from the middle.")
        return self.state, self.step, sizes.go_on(self.step, self.state, self.diagnostics.get("time_steps"))

    def whole(self, found: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """What was noted of all steps, given what the present process has noted, whose first steps mean nothing."""
        if self.state is None:
            return dict(found)
        n = self.step
        return {name: np.concatenate([self.diagnostics[name][:n], column[n:]]) for name, column in found.items()}
