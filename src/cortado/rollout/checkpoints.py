"""Checkpoints of a forward run, the progress of a resumed run, and the error for a lost particle."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import isqrt
from typing import Protocol

import numpy as np

from cortado.errors import DivergedError, InputError
from cortado.particles.state import Parameters, State, StateSeries
from cortado.rollout.step_sizes import StepSizes
from cortado.solvers.containment import Lost, shut_in
from cortado.solvers.solver import Solver

MEMORY_BUDGET = 8 * 2**30


class Checkpoints:
    """States of a forward run at every ``interval``-th step. A backward pass recomputes all other states."""

    def __init__(self, first: State, interval: int):
        self._first, self._interval = first, interval
        self._states: dict[int, Callable[[], State]] = {0: lambda: first}
        self._copies: list[StateSeries] = []

    def __len__(self) -> int:
        return len(self._states)

    @staticmethod
    def interval(steps: int, affordable: int) -> int:
        """Return the smallest interval that keeps at most ``affordable`` states, or about sqrt(steps)."""
        if steps <= affordable:
            return 1
        intervals = range(1, isqrt(steps) + 2)
        return next((n for n in intervals if -(-steps // n) + n <= affordable), isqrt(steps) + 1)

    def keep(self, step: int, chunk: list[State], series: StateSeries, length: int, spare: list[StateSeries]) -> None:
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
        """Return state ``n``. ``n`` must decrease from call to call. ``next_state`` recomputes a missing state."""
        if n not in self._states:
            for m in range(n - n % self._interval, n):
                self._states[m + 1] = partial(_itself, next_state(m, self._states[m]()))
        if (n + 1) % self._interval:
            self._states.pop(n + 1, None)
        return self._states[n]()

    def release(self) -> list[StateSeries]:
        """Return the stored arrays for reuse. A release makes all checkpoints invalid."""
        copies, self._copies = self._copies, []
        return copies


def _itself(state: State) -> State:
    return state


@dataclass(frozen=True)
class Progress:
    """The point at which an earlier process stopped a run."""

    step: int = 0
    state: State | None = None
    """Last state of the earlier process, or None if no step was taken."""
    diagnostics: Mapping[str, np.ndarray] = field(default_factory=dict)

    def begin(self, initial: State, sizes: StepSizes, keep: bool) -> tuple[State, int, bool]:
        """Return the first state of the resumed run, its step number, and True if the run ends there."""
        if self.state is None:
            return initial, 0, False
        if keep:
            raise InputError("keep is True, but must be False in a run that continues from a later step.")
        return self.state, self.step, sizes.go_on(self.step, self.state, self.diagnostics.get("time_steps"))

    def whole(self, found: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        if self.state is None:
            return dict(found)
        n = self.step
        return {name: np.concatenate([self.diagnostics[name][:n], column[n:]]) for name, column in found.items()}


class Beside(Protocol):
    """Protocol of additional kernel launches after each step of a chunk."""

    def launch(self, step: int, parameters: Parameters) -> None:
        """Launch kernels that read the solver's arrays after a step of a chunk. The first ``step`` is 0."""


class ChunkReader(Protocol):
    """Protocol of objects that read the states of a chunk on the device."""

    @property
    def beside(self) -> Beside | None:
        """Return the kernel launches after each step, or None."""

    def read(self, step: int, end: int, first: State, later: StateSeries) -> None:
        """Read the states before the steps ``step`` to ``end`` - 1. ``first`` is the state before step ``step``, and
        ``later`` contains the following states. The next chunk overwrites the states ``first`` and ``later``."""


def diverged(solver: Solver, member: int, lost: Lost, known: Sequence[State], advice: str) -> DivergedError:
    """Return the error for a lost particle. ``known`` ends with the state before the failed step."""
    containment, particles = solver.containment, solver.layout.particles
    spacing, d = containment.walled.spacing, containment.walled.dimension
    own = slice(member * particles, (member + 1) * particles)
    first, was, after = (known[k].positions.numpy()[own, :d] for k in (0, -2, -1))
    if not np.isfinite(was[lost.particle]).all():
        where = "had been lost in steps before these"
        return DivergedError(lost.step + 1, lost.particle, "begin that scene anew", where, lost.others)
    position, places = after[lost.particle], np.concatenate([first, was])
    if not lost.others:  # the cause is near the particle
        places = places[np.linalg.norm(places - was[lost.particle], axis=1) < 6.0 * spacing]
    if narrow := shut_in(containment, member, places):
        advice = f"{narrow}, or {advice}"
    if containment.is_imprecise(position):
        advice = f"{advice}, or float64 for fluid that flies that far"
    return DivergedError(lost.step + 1, lost.particle, advice, containment.where(position), lost.others)
