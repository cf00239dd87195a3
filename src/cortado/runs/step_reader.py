"""What is read of the states of a run while it goes on: sums over particles on the device by sensors, and whole states
by copies off the device, with tables of what is recorded of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.particles.state import Entry, State, StateSeries
from cortado.rollout.chunk_reader import Beside
from cortado.rollout.rollout import Rollout
from cortado.runs.particle_sums import Summed
from cortado.runs.quantity_values import QuantityEvaluator
from cortado.runs.step_sums import SIX, ChunkSums, StepQuantities
from cortado.scene.parameter_values import Arrays
from cortado.scene.parameters import Axis

MOST = 2**28
"""Bytes of copies above which they are looked at before the next steps begin."""


@dataclass(frozen=True)
class Row:
    """A sensor's reading of a state."""

    sensor: str
    number: int
    """Number of the state."""
    member: int
    """Number of the scene in a batch, else 0."""
    reading: Callable[[], NDArray[Any]]
    """Makes the reading (k,) of the sensor."""


class _Poses(dict[str, NDArray[Any]]):
    """A state as sensors see it of which the poses of solids alone are known: a `cortado.runs.sensor.Reading`."""

    def __init__(self, scene: QuantityEvaluator, fields: Mapping[str, NDArray[Any]]):
        super().__init__(fields)
        self.dimension, self.lattice = scene.dimension, scene.lattice
        self.solids, self.container = scene.solids, scene.container


def kept_by_steps(scene: QuantityEvaluator, rollout: Rollout, names: tuple[str, ...]) -> StepQuantities:
    """Return what keeps quantities of steps by their names, made once for a rollout."""
    kept: dict[tuple[str, ...], Any] = rollout.beside
    if names not in kept:
        kept[names] = StepQuantities(scene.within(names), scene.solver, rollout.longest_chunk)
    found: StepQuantities = kept[names]
    return found


class QuantityReader:
    """A `cortado.rollout.chunk_reader.ChunkReader` of quantities that need the step after a state, which is the run's
    own."""

    def __init__(self, scene: QuantityEvaluator, rollout: Rollout, wanted: Mapping[int, str]):
        """Prepare to read of the states with these numbers a quantity each, by its name."""
        self.found: dict[int, Arrays] = {}
        """Quantities by name, by the numbers of states."""
        self.beside = kept_by_steps(scene, rollout, tuple(sorted(set(wanted.values()))))
        self._scene, self._wanted = scene, wanted

    def read(self, step: int, end: int, first: State, later: StateSeries) -> None:
        for number in self._wanted.keys() & range(step, end):
            values = self.beside.of_step(self._wanted[number], number - step).numpy()
            self.found[number] = {self._wanted[number]: self._scene.of_scene(self._wanted[number], values)}


class StepReader:
    """A `cortado.rollout.chunk_reader.ChunkReader` of sensors. What it reads is copied to the host, where `rows` looks
    at it while a GPU takes the next steps."""

    def __init__(self, scene: QuantityEvaluator, rollout: Rollout, sensors: Mapping[str, Summed]):
        """Prepare to read ``sensors`` by their names in the run of a rollout, whose solver the ``scene`` has too."""
        self.sensors, self._scene, self._rollout = dict(sensors), scene, rollout
        length, layout, first = rollout.longest_chunk, rollout.solver.layout, rollout.initial
        summed = {name: one.summed(scene) for name, one in sensors.items()}
        made = (ChunkSums(one, scene.lattice.domain, scene.solver, length) for one in summed.values())
        self._sums = dict(zip(summed, made, strict=True))
        self._needs_the_step = {name for name, one in summed.items() if one.quantity is not None}
        self.quantities = tuple(sorted({one.quantity for one in summed.values() if one.quantity is not None}))
        """Names of the quantities that are read."""
        self._beside = kept_by_steps(scene, rollout, self.quantities) if self.quantities else None
        moved = any(table.moves for table in scene.solids)
        self._poses = [f for f in first.fields if f.axis is Axis.SCALAR and not f.is_constant] if moved else []
        options = {"device": "cpu", "pinned": first.positions.device.is_cuda}
        self._found = {name: wp.empty(length * layout.members, dtype=SIX, **options) for name in summed}
        """Sums, state by state, on the host."""
        sizes = {f.name: (first[f.name].dtype, layout.members) for f in self._poses}
        self._first = {name: wp.empty(size, dtype=kind, **options) for name, (kind, size) in sizes.items()}
        self._later = {name: wp.empty(length * size, dtype=kind, **options) for name, (kind, size) in sizes.items()}
        """Poses of solids in the first state of a chunk, and in those behind it, on the host."""
        self._is_ready = wp.Event(first.positions.device) if first.positions.device.is_cuda else None
        self._step = self._count = 0
        """The first state of the last chunk, and how many of its states wait to be looked at."""
        self._rows = list[Row]()

    @property
    def beside(self) -> Beside | None:
        return self._beside

    def read(self, step: int, end: int, first: State, later: StateSeries) -> None:
        self._look()
        self._step, self._count = step, end - step
        rows, kept = self._count * (first.batch or 1), {} if self._beside is None else self._beside.kept
        for name, sums in self._sums.items():
            wp.copy(self._found[name], sums.launch(self._count, first, later, kept), count=rows)
        for pose in self._poses:
            wp.copy(self._first[pose.name], first[pose.name])
            wp.copy(self._later[pose.name], later.whole(pose.name), count=rows)
        if self._is_ready is not None:
            first.positions.device.stream.record_event(self._is_ready)

    def rows(self) -> list[Row]:
        """Return the readings of all states that were read since the last call, state by state."""
        self._look()
        found, self._rows = self._rows, []
        return found

    def _look(self) -> None:
        """Make rows of the sums of the last chunk."""
        if self._is_ready is not None and self._count:
            wp.synchronize_event(self._is_ready)
        count, self._count = self._count, 0
        sums = {name: array.numpy().reshape(-1, self._members, 6)[:count].copy() for name, array in self._found.items()}
        lost = {member: error.step - 1 for member, error in self._rollout.lost.items()}
        for k in range(count):
            number = self._step + k
            for member in (b for b in range(self._members) if number <= lost.get(b, number)):
                at = _Poses(self._scene, self._poses_of(k, member))
                for name, sensor in self.sensors.items():
                    is_lost = number == lost.get(member) and name in self._needs_the_step
                    found = np.full(6, np.nan) if is_lost else sums[name][k, member]
                    self._rows.append(Row(name, number, member, partial(sensor.reading, at, found)))

    @property
    def _members(self) -> int:
        return self._rollout.solver.layout.members

    def _poses_of(self, k: int, member: int) -> dict[str, NDArray[Any]]:
        """Return fields (1, ...) of solids in state k of the last chunk."""
        found = {}
        for pose in self._poses:
            array, row = (self._first, 0) if k == 0 else (self._later, k - 1)
            values = array[pose.name].numpy()[row * self._members + member][None].astype(np.float64)
            found[pose.name] = values[:, : self._scene.dimension] if pose.entry is Entry.VECTOR else values
        return found


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
