"""States that a forward run keeps for its backward pass, and the state at which a resumed run starts.

If a run loses a particle, these states show where, for the error message.

Protocols define what is computed from states on the device: with each step, and after each chunk.
"""

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
"""Bytes of memory for checkpoints; a run that needs more keeps fewer states and recomputes the others."""


def checkpoint_interval(steps: int, affordable: int) -> int:
    """Return the fewest steps between checkpoints for which at most ``affordable`` states are in memory: the
    checkpoints and the states recomputed between two of them. If no number is few enough, return about the square root
    of the steps."""
    if steps <= affordable:
        return 1
    intervals = range(1, isqrt(steps) + 2)
    return next((n for n in intervals if -(-steps // n) + n <= affordable), isqrt(steps) + 1)


class Checkpoints:
    """The states that one forward run of a rollout keeps, from which a backward pass recomputes the others."""

    def __init__(self, first: State, interval: int):
        """Begin with the first state alone; a checkpoint is kept every ``interval`` steps."""
        self._first, self._interval = first, interval
        self._states: dict[int, Callable[[], State]] = {0: lambda: first}
        """States by number, each as a function that returns it."""
        self._copies: list[StateSeries] = []
        """Series with copies of whole chunks."""

    def __len__(self) -> int:
        return len(self._states)

    def keep(self, step: int, chunk: list[State], series: StateSeries, length: int, spare: list[StateSeries]) -> None:
        """Keep every interval-th state of a chunk of steps; a chunk of full ``length`` is copied whole into one of the
        ``spare`` series."""
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
        """Return state ``n``, recomputed from the last checkpoint with ``next_state(m, state m)`` if need be; called
        from the last to the first."""
        if n not in self._states:
            for m in range(n - n % self._interval, n):
                self._states[m + 1] = partial(_itself, next_state(m, self._states[m]()))
        if (n + 1) % self._interval:
            self._states.pop(n + 1, None)
        return self._states[n]()

    def release(self) -> list[StateSeries]:
        """Hand over the copies of whole chunks for reuse; no checkpoint may be read afterwards."""
        copies, self._copies = self._copies, []
        return copies


def _itself(state: State) -> State:
    return state


@dataclass(frozen=True)
class Progress:
    """The point at which an earlier process stopped a run with equal first state, parameters and steps; a run resumed
    here has the bits of an unbroken one."""

    step: int = 0
    """Number of steps that the earlier process took."""
    state: State | None = None
    """State after the steps of the earlier process; None for the first state of the run."""
    diagnostics: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Diagnostics of the earlier steps: arrays (step,) by name."""

    def begin(self, initial: State, sizes: StepSizes, keep: bool) -> tuple[State, int, bool]:
        """Return the state to resume at, its step number, and True if the run ends there. Raises `InputError` where
        ``keep`` asks for a backward pass, as earlier states are unknown."""
        if self.state is None:
            return initial, 0, False
        if keep:
            raise InputError("keep is True, but must be False in a run that goes on from the middle.")
        return self.state, self.step, sizes.go_on(self.step, self.state, self.diagnostics.get("time_steps"))

    def whole(self, found: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the diagnostics of all steps: those of the earlier process, then those just ``found``."""
        if self.state is None:
            return dict(found)
        n = self.step
        return {name: np.concatenate([self.diagnostics[name][:n], column[n:]]) for name, column in found.items()}


class Beside(Protocol):
    """Launches beside the steps of a chunk, which are captured with them."""

    def launch(self, step: int, parameters: Parameters) -> None:
        """Launch what reads the solver's arrays after a step of a chunk, counted from 0."""


class ChunkReader(Protocol):
    """A reader of the states of a run on the device, chunk by chunk."""

    @property
    def beside(self) -> Beside | None:
        """Return what is to be launched beside each step; None for nothing."""

    def read(self, step: int, end: int, first: State, later: StateSeries) -> None:
        """Read the states at which steps ``step`` to ``end`` began, the ``first`` and those ``later``; the next chunk
        overwrites them."""


AROUND = 6.0
"""Distance, in spacings, around a lost particle's last position within which causes are sought."""


def diverged(solver: Solver, member: int, lost: Lost, known: Sequence[State], advice: str) -> DivergedError:
    """Return the error for a scene of a batch that lost a particle, given at least two states up to the failed step,
    and advice."""
    containment, particles = solver.containment, solver.layout.particles
    spacing, d = containment.walled.spacing, containment.walled.dimension
    own = slice(member * particles, (member + 1) * particles)
    first, was, after = (known[k].positions.numpy()[own, :d] for k in (0, -2, -1))
    if not np.isfinite(was[lost.particle]).all():
        where = "had been lost in steps before these"
        return DivergedError(lost.step + 1, lost.particle, "begin that scene anew", where, lost.others)
    position, places = after[lost.particle], np.concatenate([first, was])
    if not lost.others:
        places = places[np.linalg.norm(places - was[lost.particle], axis=1) < AROUND * spacing]
    if narrow := shut_in(containment, member, places):
        advice = f"{narrow}, or {advice}"
    return DivergedError(
        step=lost.step + 1,
        particle=lost.particle,
        advice=f"{advice}, or float64 for fluid that flies that far" if containment.is_imprecise(position) else advice,
        where=containment.where(position),
        others=lost.others,
    )
