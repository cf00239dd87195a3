"""Chooses the frames of a run, and reads states, quantities and sensors during the run."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import inf
from typing import Any, ClassVar, overload

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.calls import counted
from cortado.errors import DivergedError, InputError
from cortado.particles.state import Entry, State, StateSeries
from cortado.rollout.rollout import Rollout
from cortado.rollout.step_bounds import expected_frames
from cortado.runs.frames import Marks, SolidMotions
from cortado.runs.particle_sums import Summed
from cortado.runs.quantity_values import QuantityEvaluator
from cortado.runs.sensor import Readings, SensorLog
from cortado.runs.step_sums import SIX, ChunkSums, StepQuantities
from cortado.runs.trajectory import Trajectory
from cortado.scene.motions import moving
from cortado.scene.parameter_values import Arrays
from cortado.scene.parameters import Axis
from cortado.scene.restart import Clock
from cortado.scene.scene import Scene

MOST = 2**28
"""Greatest size of copied states that are not yet read [bytes]."""


@dataclass(frozen=True)
class EverySteps:
    """Frames at every ``steps``-th state, with the first and the last state."""

    steps: int
    rate: ClassVar[None] = None

    @property
    def settings(self) -> dict[str, Any]:
        return {"record_every": self.steps}

    def is_due(self, step: int, before: float, now: float) -> bool:
        return step % self.steps == 0

    def announced(self, rollout: Rollout) -> NDArray[Any]:
        recorded = np.array([*range(0, rollout.steps, self.steps), rollout.steps])
        clock = Clock(rollout.clocks[0].steps, rollout.clocks[0].time)  # as steps of one length go on from the first
        return clock.times(recorded, float(rollout.time_steps[0]))

    def expected(self, rollout: Rollout) -> int:
        return expected_frames(rollout, self.steps)

    def count(self, steps: int, time: float | None) -> int:
        """Return the number of frames if ``steps`` equal steps take ``time`` [s]."""
        return 1 + -(-steps // self.steps)


@dataclass(frozen=True)
class FramesPerSecond:
    """Frames at the first state at or after each due time, with the first and the last state. ``rate`` [1/s] is the
    number of frames per second. Raises `InputError` unless the rate is positive and finite."""

    rate: float

    def __post_init__(self) -> None:
        if not 0.0 < self.rate < inf:
            raise InputError(f"--fps is {self.rate:g}, but must be a number of frames per second greater than 0.")

    @property
    def settings(self) -> dict[str, Any]:
        return {"fps": self.rate}

    def is_due(self, step: int, before: float, now: float) -> bool:
        passed, due = Marks(0.0, self.rate).passed(np.array([before, now])).tolist()
        return due > passed

    def announced(self, rollout: Rollout) -> NDArray[Any]:
        start, size = rollout.clocks[0].time, float(rollout.time_steps[0])  # where steps are chosen the longest one
        duration = min(rollout.steps * size, rollout.step_sizes.end - start + size)
        return Marks(start, self.rate).at(np.arange(min(rollout.steps, int(duration * self.rate) + 1) + 2))

    def expected(self, rollout: Rollout) -> int:
        return len(self.announced(rollout))

    def count(self, steps: int, time: float | None) -> int | None:
        if time is None:
            return None
        before, due = Marks(0.0, self.rate).passed(np.array([time - time / steps, time])).tolist()
        return 1 + min(steps, due if due > before else due + 1)


FrameChoice = EverySteps | FramesPerSecond


@dataclass(frozen=True, eq=False)
class TrajectoryBatch(Sequence[Trajectory]):
    """The trajectories of a batch of runs. ``batch[b]`` is the `Trajectory` of scene b, with exactly the numbers of a
    run of this scene alone. If scene b lost a particle, the trajectory of scene b ends before the lost particle."""

    trajectories: tuple[Trajectory, ...]
    fields: Mapping[str, NDArray[Any]]
    """Fields that change, by name, (frames, batch, ...). After the last frame of a lost scene the values are NaN."""
    lost: Mapping[int, DivergedError]
    """Errors of the scenes that lost a particle, by scene number."""

    def __repr__(self) -> str:
        lost = f", {len(self.lost)} lost" if self.lost else ""
        frames, _, particles, _ = self.positions.shape
        sizes = f"{counted(frames, 'frame')} of {counted(particles, 'particle')}"
        return f"TrajectoryBatch({counted(len(self), 'scene')}{lost}, {sizes})"

    def __len__(self) -> int:
        return len(self.trajectories)

    @overload
    def __getitem__(self, b: int) -> Trajectory: ...

    @overload
    def __getitem__(self, b: slice) -> Sequence[Trajectory]: ...

    def __getitem__(self, b: int | slice) -> Trajectory | Sequence[Trajectory]:
        return self.trajectories[b]

    @property
    def positions(self) -> NDArray[Any]:
        """Return the positions (frames, batch, n, d) [m]."""
        return self.fields["positions"]

    @property
    def velocities(self) -> NDArray[Any]:
        """Return the velocities (frames, batch, n, d) [m/s]."""
        return self.fields["velocities"]

    @property
    def mass_fractions(self) -> NDArray[Any] | None:
        """Return the mass fractions (frames, batch, n, phases) [-], or None for a single phase."""
        return self.fields.get("mass_fractions")


def recorded(
    rollout: Rollout,
    scene: Scene,
    steps: np.ndarray,
    fields: Arrays,
    constants: Arrays,
    quantities: Arrays,
    readings: Callable[[int], Mapping[str, Readings]],
) -> Trajectory | TrajectoryBatch:
    """``steps`` (frames,) has the number of steps before each frame. Arrays have the shape (frames, ...), or (frames,
    batch, ...) for a batch. ``readings`` returns the sensor readings of a scene by its number."""

    def one(number: int, kept: slice, at: tuple[Any, ...]) -> Trajectory:
        own = {name: array[kept][at] for name, array in fields.items()}
        clock, motions = rollout.clocks[number], SolidMotions.of(own, scene.dimension)
        return Trajectory(
            times=clock.times(steps[kept], float(rollout.time_steps[number])),
            steps=clock.steps + steps[kept],
            positions=own.pop("positions"),
            velocities=own.pop("velocities"),
            diagnostics={name: column[at] for name, column in rollout.diagnostics.items()},
            mass_fractions=own.pop("mass_fractions", None),
            others=own,
            solids=SolidMotions({one.name: motions[one.name] for one in moving(scene.solid) if one.name in motions}),
            scene=scene,
            constants={name: array[at[1:]] for name, array in constants.items()},
            substeps=rollout.substeps,
            origin=rollout.origins[number],
            quantities={name: array[kept][at] for name, array in quantities.items()},
            sensors=readings(number),
        )

    batch = rollout.solver.layout.batch
    if batch is None:
        return one(0, slice(None), (slice(None),))
    found = []
    for b in range(batch):
        good = np.count_nonzero(steps < rollout.lost[b].step) if b in rollout.lost else len(steps)
        found.append(one(b, slice(good), (slice(None), b)))
        for array in fields.values():
            array[good:, b] = np.nan
    return TrajectoryBatch(tuple(found), fields, rollout.lost)


class _Poses(dict[str, NDArray[Any]]):
    def __init__(self, scene: QuantityEvaluator, fields: Mapping[str, NDArray[Any]]):
        super().__init__(fields)
        self.dimension, self.lattice = scene.dimension, scene.lattice
        self.solids, self.container = scene.solids, scene.container


def kept_by_steps(scene: QuantityEvaluator, rollout: Rollout, names: tuple[str, ...]) -> StepQuantities:
    kept: dict[tuple[str, ...], Any] = rollout.beside
    if names not in kept:
        kept[names] = StepQuantities(scene.within(names), scene.solver, rollout.longest_chunk)
    return kept[names]


class QuantityReader:
    def __init__(self, scene: QuantityEvaluator, rollout: Rollout, wanted: Mapping[int, str]):
        """``wanted`` maps the number of a state to the name of a quantity."""
        self.found: dict[int, Arrays] = {}
        self.beside = kept_by_steps(scene, rollout, tuple(sorted(set(wanted.values()))))
        self._scene, self._wanted = scene, wanted

    def read(self, step: int, end: int, first: State, later: StateSeries) -> None:
        for number in self._wanted.keys() & range(step, end):
            name = self._wanted[number]
            values = self.beside.of_step(name, number - step).numpy()
            self.found[number] = {name: self._scene.of_scene(name, values)}


class StepReader:
    def __init__(self, scene: QuantityEvaluator, rollout: Rollout, sensors: dict[str, Summed], logs: list[SensorLog]):
        self.sensors, self._scene, self._rollout, self._logs = sensors, scene, rollout, logs
        length, layout, first = rollout.longest_chunk, rollout.solver.layout, rollout.initial
        summed = {name: one.summed(scene) for name, one in sensors.items()}
        self._sums = {name: ChunkSums(one, scene, scene.solver, length) for name, one in summed.items()}
        self._needs_the_step = {name for name, one in summed.items() if one.quantity is not None}
        self.quantities = tuple(sorted({one.quantity for one in summed.values() if one.quantity is not None}))
        self.beside = kept_by_steps(scene, rollout, self.quantities) if self.quantities else None
        moved = any(table.moves for table in scene.solids)
        self._poses = [f for f in first.fields if f.axis is Axis.SCALAR and not f.is_constant] if moved else []
        options = {"device": "cpu", "pinned": first.positions.device.is_cuda}
        self._found = {name: wp.empty(length * layout.members, dtype=SIX, **options) for name in summed}
        self._first, self._later = (
            {f.name: wp.empty(states * layout.members, dtype=first[f.name].dtype, **options) for f in self._poses}
            for states in (1, length)
        )
        self._is_ready = wp.Event(first.positions.device) if first.positions.device.is_cuda else None
        self._step, self._count, self._members = 0, 0, layout.members

    def read(self, step: int, end: int, first: State, later: StateSeries) -> None:
        self.look()
        self._step, self._count = step, end - step
        rows, kept = self._count * (first.batch or 1), {} if self.beside is None else self.beside.kept
        for name, sums in self._sums.items():
            wp.copy(self._found[name], sums.launch(self._count, first, later, kept), count=rows)
        for pose in self._poses:
            wp.copy(self._first[pose.name], first[pose.name])
            wp.copy(self._later[pose.name], later.whole(pose.name), count=rows)
        if self._is_ready is not None:
            first.positions.device.stream.record_event(self._is_ready)

    def look(self) -> None:
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
                    self._logs[member].read(name, number, partial(sensor.reading, at, found))

    def _poses_of(self, k: int, member: int) -> dict[str, NDArray[Any]]:
        found = {}
        for pose in self._poses:
            array, row = (self._first, 0) if k == 0 else (self._later, k - 1)
            values = array[pose.name].numpy()[row * self._members + member][None].astype(np.float64)
            found[pose.name] = values[:, : self._scene.dimension] if pose.entry is Entry.VECTOR else values
        return found


class Waiting:
    """A queue of copies of states in pinned host memory."""

    def __init__(self, look: Callable[[int, State], None], first: State, copies: list[State]):
        """Call ``look`` with the number and the copy of each state. ``copies`` are buffers, which are reused."""
        self._look, self._device = look, first.positions.device
        names = [field.name for field in first.fields if field.is_constant]
        self._constant = {name: copies[0][name] if copies else _empty(first[name]) for name in names}
        for name, own in self._constant.items():
            wp.copy(own, first[name])
        self._numbers, self._copies = list[int](), copies
        self._is_ready = wp.Event(self._device) if self._device.is_cuda else None
        self._most = max(MOST // sum(array.capacity for array in first.arrays()), 1)

    def keep(self, number: int, state: State) -> None:
        """Copy a state without waiting for the GPU."""
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
        if self._is_ready is not None and self._numbers:
            wp.synchronize_event(self._is_ready)
        numbers, self._numbers = self._numbers, []
        for number, copy in zip(numbers, self._copies, strict=False):
            self._look(number, copy)


class Table:
    def __init__(self, expected: int):
        self._rows, self._count, self._arrays = expected, 0, dict[str, NDArray]()

    def add(self, record: Mapping[str, NDArray]) -> None:
        if self._count == self._rows:
            self._rows *= 2
            self._arrays = {name: np.concatenate([own, np.empty_like(own)]) for name, own in self._arrays.items()}
        for name, value in record.items():
            if name not in self._arrays:
                self._arrays[name] = np.empty((self._rows, *value.shape), dtype=value.dtype)
            self._arrays[name][self._count] = value
        self._count += 1

    def arrays(self) -> dict[str, NDArray]:
        own = {name: array[: self._count] for name, array in self._arrays.items()}
        return own if self._count >= self._rows - 1 else {name: array.copy() for name, array in own.items()}


def _empty(array: wp.array) -> wp.array:
    return wp.empty(array.shape, dtype=array.dtype, device="cpu", pinned=array.device.is_cuda)
