"""States that were copied off the device, and wait to be looked at while a GPU takes the next steps; and tables of what
is recorded of them."""

from collections.abc import Callable, Mapping

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.particles.state import State

MOST = 2**28
"""Bytes of copies above which they are looked at before the next steps begin."""


class Waiting:
    """Copies of states in pinned memory of the host, in their order. It is filled as an observer of a forward run,
    and emptied by `look`, which the run calls while a GPU takes the next steps."""

    def __init__(self, look: Callable[[int, State], None], first: State, copies: list[State]):
        """Take the function that is to look at the number of a state and at its copy, which is overwritten later.
        ``first`` is a state of the run, and ``copies`` are those of earlier runs, which are used again."""
        self._look, self._device = look, first.positions.device
        names = [field.name for field in first.fields if field.is_constant]
        self._constant = {name: copies[0][name] if copies else _empty(first[name]) for name in names}
        for name, own in self._constant.items():
            wp.copy(own, first[name])
        self._numbers, self._copies = list[int](), copies
        self._is_ready = wp.Event(self._device) if self._device.is_cuda else None
        self._most = max(MOST // sum(array.capacity for array in first.arrays()), 1)

    def keep(self, number: int, state: State) -> None:
        """Copy a state; on a GPU after the work that was launched, without waiting for it."""
        if len(self._numbers) == len(self._copies):
            own = {n: self._constant[n] if n in self._constant else _empty(state[n]) for n in state.names}
            self._copies.append(State(state.fields, own, state.batch))
        copy = self._copies[len(self._numbers)]
        for name in state.names:
            if name not in self._constant:
                wp.copy(copy[name], state[name])
        if self._is_ready is not None:
            self._device.stream.record_event(self._is_ready)
        self._numbers.append(number)
        if len(self._numbers) >= self._most:
            self.look()

    def look(self) -> None:
        """Look at all copies; on a GPU work that was launched after them goes on meanwhile."""
        if self._is_ready is not None and self._numbers:
            wp.synchronize_event(self._is_ready)
        numbers, self._numbers = self._numbers, []
        for number, copy in zip(numbers, self._copies, strict=False):
            self._look(number, copy)


class Table:
    """Arrays by name, one row for each record. They are allocated at once, as to allocate each row by itself costs more
    than to copy it."""

    def __init__(self, expected: int):
        self._rows, self._count, self._arrays = expected, 0, dict[str, NDArray]()

    def add(self, record: Mapping[str, NDArray]) -> None:
        """Copy a record to the next row."""
        if self._count == self._rows:
            self._rows *= 2
            self._arrays = {name: np.concatenate([own, np.empty_like(own)]) for name, own in self._arrays.items()}
        for name, value in record.items():
            if name not in self._arrays:
                self._arrays[name] = np.empty((self._rows, *value.shape), dtype=value.dtype)
            self._arrays[name][self._count] = value
        self._count += 1

    def arrays(self) -> dict[str, NDArray]:
        """Return the arrays (records, ...) by name. They hold memory for one further record at most."""
        own = {name: array[: self._count] for name, array in self._arrays.items()}
        return own if self._count >= self._rows - 1 else {name: array.copy() for name, array in own.items()}


def _empty(array: wp.array) -> wp.array:
    """Allocate an array of the host, which a GPU can write to while the host goes on."""
    return wp.empty(array.shape, dtype=array.dtype, device="cpu", pinned=array.device.is_cuda)
