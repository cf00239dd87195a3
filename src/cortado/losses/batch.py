"""Losses of the scenes of a batch: of all at once where a loss can, else one by one."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, overload, runtime_checkable

import numpy as np

from cortado.device.precision import Precision
from cortado.losses.loss import Loss, Snapshot, SnapshotAdjoint, by_field, precision_of
from cortado.particles.state import State
from cortado.runs.quantities.moment import Moment
from cortado.words import counted


@dataclass(frozen=True, eq=False)
class SnapshotBatch(Sequence[Snapshot]):
    """A state of a rollout of a batch: ``end[b]`` is the `Snapshot` of scene b."""

    state: State
    """Warp arrays (batch n,), in the scenes' order; `State.numbers` shows them as (batch, n, ...)."""
    dimension: int
    colours: np.ndarray
    """(batch, phases, 3) of the phases: red, green and blue, linear, from 0 to 1."""
    moment: Moment | None = None
    """As that of `Snapshot`."""

    def __repr__(self) -> str:
        scenes = counted(len(self), "scene")
        return f"SnapshotBatch({scenes} of {counted(len(self.state.positions) // len(self), 'particle')})"

    def __len__(self) -> int:
        """Number of scenes."""
        return len(self.colours)

    @overload
    def __getitem__(self, b: int) -> Snapshot: ...

    @overload
    def __getitem__(self, b: slice) -> Sequence[Snapshot]: ...

    def __getitem__(self, b: int | slice) -> Snapshot | Sequence[Snapshot]:
        if isinstance(b, slice):
            return [self[k] for k in range(len(self))[b]]
        number = range(len(self))[b]
        own = self.state.member(number), self.dimension, self.colours[number], self.moment
        return _Member(*own, batch=self, number=number)

    @property
    def precision(self) -> Precision:
        """Of the Warp arrays."""
        return precision_of(self.state)

    @property
    def positions(self) -> np.ndarray:
        """(batch, n, d) [m], float64, read-only"""
        return self._host["positions"]

    @property
    def velocities(self) -> np.ndarray:
        """(batch, n, d) [m / s], float64, read-only"""
        return self._host["velocities"]

    @property
    def mass_fractions(self) -> np.ndarray:
        """(batch, n, phases) [-], float64, read-only"""
        return self._host["mass_fractions"]

    @cached_property
    def _host(self) -> dict[str, np.ndarray]:
        """Read from the device at once, for all scenes."""
        found = {name: array.astype(np.float64) for name, array in self.state.numpy(self.dimension).items()}
        for array in found.values():
            array.flags.writeable = False
        return found


@dataclass(frozen=True, repr=False, kw_only=True)
class _Member(Snapshot):
    """One scene of a batch, whose arrays come to the host with those of the others."""

    batch: SnapshotBatch
    number: int

    def _quantity(self, name: str) -> np.ndarray:
        return super()._quantity(name)[self.number]

    @cached_property
    def positions(self) -> np.ndarray:
        return self.batch.positions[self.number]

    @cached_property
    def velocities(self) -> np.ndarray:
        return self.batch.velocities[self.number]

    @cached_property
    def mass_fractions(self) -> np.ndarray:
        return self.batch.mass_fractions[self.number]


@runtime_checkable
class BatchedLoss(Protocol):
    """A loss that looks at all scenes of a batch at once, which saves a launch and a look of the host for each. Scene b
    gets the bits that it would get alone."""

    def values(self, end: SnapshotBatch) -> np.ndarray:
        """(batch,) the losses; of scenes that were lost they mean nothing."""

    def values_and_adjoint(self, end: SnapshotBatch) -> tuple[np.ndarray, State]:
        """The same, and the derivatives with respect to the states, as Warp arrays: ``end.state.like()`` makes them,
        all 0, and ``set({"positions": array})`` of it writes an array (batch, n, d)."""


def values(loss: Loss, end: SnapshotBatch, members: Sequence[int]) -> np.ndarray:
    """(batch,) the losses of some scenes; NaN for others."""
    found = np.full(len(end), np.nan)
    if isinstance(loss, BatchedLoss):
        found[members] = loss.values(end)[members]
        return found
    for b in members:
        found[b] = loss.value(end[b])
    return found


def values_and_adjoints(loss: Loss, end: SnapshotBatch, members: Sequence[int]) -> tuple[np.ndarray, SnapshotAdjoint]:
    """The same, with the adjoints of the states of these scenes; 0 for others."""
    found = np.full(len(end), np.nan)
    if isinstance(loss, BatchedLoss):
        all_found, state = loss.values_and_adjoint(end)
        found[members] = all_found[members]
        for b in set(range(len(end))).difference(members):
            state.member(b).clear()
        return found, SnapshotAdjoint(state, np.zeros_like(end.colours))
    adjoint = SnapshotAdjoint(end.state.like(), np.zeros_like(end.colours))
    arrays: dict[str, np.ndarray] = {}
    for b in members:
        found[b], bar = loss.value_and_adjoint(end[b])
        if isinstance(bar, SnapshotAdjoint):
            adjoint.colours[b] = bar.colours
            for name, array in bar.quantities.items():
                arrays.setdefault(name, np.zeros((len(end), *array.shape)))[b] = array
            bar = bar.state
        if isinstance(bar, State):
            adjoint.state.member(b).assign(bar)
            continue
        for name, array in by_field(bar, end.dimension).items():
            arrays.setdefault(name, np.zeros((len(end), *array.shape)))[b] = array
    adjoint.state.set(arrays)
    of_quantities = {name: array for name, array in arrays.items() if name not in end.state.names}
    return found, replace(adjoint, quantities=of_quantities)
