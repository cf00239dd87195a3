"""The time loop: forward runs, checkpoints and backward passes.

A rollout launches steps in chunks. After a chunk, the host checks for lost particles, and repeats the chunk if
neighbour lists were too short.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from itertools import count
from typing import Any, Protocol
from weakref import WeakSet

import numpy as np
import warp as wp

from cortado.calls import Staying
from cortado.device.launching import CapturedGraph, HostCopy
from cortado.device.modules import compile_ahead
from cortado.device.reduction import add
from cortado.device.threads import WARP, in_turn, require, step_parts, within
from cortado.errors import DivergedError, InputError
from cortado.particles.state import Parameters, State, StateSeries
from cortado.rollout.checkpoints import MEMORY_BUDGET, Beside, Checkpoints, ChunkReader, Progress, diverged
from cortado.rollout.step_sizes import StepSizes
from cortado.scene.restart import Clock, Origin
from cortado.solvers.solver import Counts, Solver, StepLog, StepTangent

Observer = Callable[[int, State], None]
"""Function that is called with the number of a state and the state. Later steps overwrite the state."""
OBSERVED = "a number of steps", "a state"
CHUNK = {"cpu": 8, "cuda": 64}
"""Greatest number of steps in a chunk, by kind of device."""
FILLED = {"cpu": 32_000, "cuda": 16_000_000}
"""Number of particles times number of steps in a chunk, above which longer chunks are not faster."""


class BackwardStep(Protocol):
    """Protocol of the backward pass through one step, made by an `AdjointEstimator`."""

    capturable: bool
    """True if a CUDA graph may capture the backward step."""
    rollout: "Rollout"
    solver: Solver

    def begin(self) -> None:
        """Set the adjoints of the parameters to 0."""

    def step(self, state: State, counts: Counts, bar: State) -> None:
        """Replace ``bar``, the adjoint of the state after a step, by the adjoint of ``state`` before the step."""

    def parameters(self) -> Parameters:
        """Return the adjoints of the parameters, summed over all steps since `begin`."""


class AdjointStep:
    """The exact `BackwardStep`, which repeats a step and then computes the adjoint."""

    capturable = True

    def __init__(self, rollout: "Rollout"):
        self.rollout, self.solver, self._parameters = rollout, rollout.solver, rollout.parameters
        self._adjoint = self.solver.adjoint(rollout.steps)

    def begin(self) -> None:
        self._adjoint.begin()

    def step(self, state: State, counts: Counts, bar: State) -> None:
        self.solver.reserve(counts)
        self.solver.replay(state, self._parameters, counts)
        self._adjoint.step(counts, bar, self._parameters)

    def parameters(self) -> Parameters:
        return self._adjoint.collect()


class Rollout(Staying):
    """Steps of a solver from a first state. ``steps`` may change between evaluations, up to ``room``."""

    instead = "but the simulation of the rollout can"

    @WARP
    def __init__(self, solver: Solver, steps: int, memory_budget: int = MEMORY_BUDGET):
        self.solver, self.steps, self.room, self._device, self.turn = solver, steps, steps, solver.device, solver.turn
        require(step_parts(steps, solver.discretisation.precision.bytes), "take fewer steps", self._device)
        self.initial, self.parameters = solver.new_state(), solver.new_parameters(steps)
        self.substeps = 0
        self.time_steps = np.zeros(solver.layout.members)
        """Time steps (members,) [s] in double precision."""
        self.advice: Callable[[int], str] = lambda member: "try a smaller time step, or more pressure iterations"
        self.clocks = [Clock()] * solver.layout.members
        self.origins: list[Origin] = []
        self.lost: dict[int, DivergedError] = {}
        self.log = solver.new_log(steps)
        self.step_sizes = StepSizes()
        self.progress, self.taken = Progress(), 0
        state_bytes = sum(self.initial[f.name].capacity for f in self.initial.fields if not f.is_constant)
        self._interval = Checkpoints.interval(steps, within(memory_budget, self._device) // state_bytes)
        self._checkpoints, self._spare = Checkpoints(self.initial, self._interval), list[StateSeries]()
        self._buffer, self._bar = self.initial.following(), self.initial.like()
        self._input = self._buffer
        kind = "cpu" if self._device.is_cpu else "cuda"
        length = max(min(CHUNK[kind], FILLED[kind] // max(solver.layout.all_particles, 1), steps), 1)
        self._series = StateSeries(self.initial, length)
        self._chunk = [self._series.state(k) for k in range(length)]
        self._tangent: tuple[Parameters, StepTangent, State] | None = None
        self._generation = -1
        self._forget_stale_graphs()
        self.copies: list[State] = []
        self.beside: dict[tuple[str, ...], Beside] = {}
        self.longest_chunk, self.goes_on = length, False
        self._copies = [*solver.copies, *(self.log.copies if steps <= length else ())]
        self.evaluation = 0
        """Number of the evaluation. Every new first state or parameter begins an evaluation."""
        self._evaluations = count(1)
        self.derivatives: dict[Any, BackwardStep] = {}
        self.pending: WeakSet[Residual] = WeakSet()
        self.aside: list[tuple[State, StepLog]] = []
        self._kept = self._run = -1

    @property
    def diagnostics(self) -> Mapping[str, np.ndarray]:
        """Diagnostics of the last forward run by name, (steps,), or (steps, batch) for a batch. See `StepLog`."""
        found = self.log.diagnostics
        return self.progress.whole({**found, **self.step_sizes.diagnostics(len(found["converged"]))})

    def is_calm(self, limits: Mapping[str, float]) -> bool:
        """Return True if no scene was lost, all steps converged, and no diagnostic exceeds its limit in ``limits``."""
        return not self.lost and self.progress.state is None and self.log.is_calm(limits)

    def is_last(self, step: int) -> bool:
        return step == self.steps or self.step_sizes.is_end(step)

    def begin_evaluation(self) -> None:
        """Prepare for a new first state and new parameters. Residuals in use copy the current values first."""
        if self.pending:
            pending = list(self.pending)
            if len(pending) > 1:
                self._checkpoints.release()  # several residuals share them, so they must not be reused
            for residual in pending:
                residual.put_aside()
            self._checkpoints = Checkpoints(self.initial, self._interval)
            self.pending.clear()
        self.progress, self.evaluation = Progress(), next(self._evaluations)

    @in_turn
    def forward(
        self,
        observe: Observer | None = None,
        keep: bool = True,
        meanwhile: Callable[[], None] | None = None,
        reader: ChunkReader | None = None,
    ) -> State:
        """Run to the last step or the end time, and return the last state. The next run overwrites the returned state.

        ``observe`` is called with every state. ``keep`` stores checkpoints for a backward pass. ``meanwhile`` is called
        while a GPU computes. ``reader`` reads states on the device. Raises `DivergedError` if a particle is lost, after
        ``observe`` was called with all valid states. A batch continues without the scenes in ``lost``.
        """
        self._kept = self._run = -1
        self._spare += self._checkpoints.release()
        self._checkpoints = Checkpoints(self.initial, self._interval)
        self.lost = {}
        state, step, ended = self.progress.begin(self.initial, self.step_sizes, keep)
        self.solver.set_substeps(self.substeps)
        self._forget_stale_graphs()
        if self.steps > 0:
            compile_ahead(self.solver, self._device)
        if step > 0:
            self.solver.reset(step)
        try:
            while step < self.steps and not ended:
                last = step + self._length(self.steps - step)
                self._input = self.initial
                if self.room > self.longest_chunk or state is not self.initial:
                    self._input = self._buffer
                    self._buffer.assign(state)  # steps may overwrite this state
                chunk = self._advance(step, last, reader)
                if meanwhile is not None:
                    meanwhile()
                self._wait()
                while self.solver.make_room() or self.step_sizes.again(step, last):
                    self._forget_stale_graphs()
                    if step > 0:
                        self.solver.reset(step)
                    chunk = self._advance(step, last, reader)
                    self._wait()
                end, ended = self.step_sizes.read(step, last)
                chunk = chunk[: end - step]
                lost = {b: one for b, one in self.solver.containment.lost().items() if one.step < end}
                for b in lost.keys() - self.lost.keys():
                    known = [self._input, *chunk[: lost[b].step + 1 - step]]
                    self.lost[b] = diverged(self.solver, b, lost[b], known, self.advice(b))
                stops = bool(lost) and self.solver.layout.batch is None
                if reader is not None:
                    reader.read(step, lost[0].step + 1 if stops else end, self._input, self._series)
                for number, new_state in enumerate(chunk[: lost[0].step - step] if stops else chunk, step + 1):
                    if observe is not None:
                        observe(number, new_state)
                if keep and not stops and step + 1 < self.steps:  # no pass back begins at the last state
                    self._checkpoints.keep(step, chunk, self._series, len(self._chunk), self._spare)
                if stops:
                    step = lost[0].step + 1
                    raise self.lost[0]
                state, step = chunk[-1], end
        finally:
            self.taken = step
            self.log.read(step)
            self._mark(self.solver.copies, is_fetched=False)
        self._run, self._kept = self.evaluation, self.evaluation if keep else -1
        return state

    def _advance(self, first: int, last: int, reader: ChunkReader | None) -> list[State]:
        length, beside = last - first, None if reader is None else reader.beside
        if self._device.is_cuda and beside not in self._warm:
            self._warm_up(first, beside)
        if first > 0:
            self._begin_at(first)
        else:
            self._reset()
            self.step_sizes.seek(0)
        self._mark(self._copies, is_fetched=False)
        key = length, beside, self._input is self._buffer
        if is_new := key not in self._chunks:
            work = partial(self._take, length, beside)
            self._chunks[key] = CapturedGraph(work, self.solver.launch, beside in self._warm)
        self._chunks[key]()
        if is_new and (self.solver.step_number.numpy() != last).any():  # then no lost particle would be noticed
            name = type(self.solver).__name__
            raise InputError(f"solver {name} does not count its steps: the method step must end with self.end_step.")
        return self._chunk[:length]

    def _wait(self) -> None:
        """Wait for the device. After this call, the copies that a chunk fetched are up to date."""
        if self._device.is_cuda:
            wp.synchronize_stream(self._device)
            self._mark(self._copies, is_fetched=True)

    def _mark(self, copies: Iterable[HostCopy], is_fetched: bool) -> None:
        for copy in copies:
            copy.is_fetched = is_fetched

    def _length(self, left: int) -> int:
        length = min(len(self._chunk), self.step_sizes.longest_chunk, left)
        return length if self.steps == self.room or length < left else 1 << (length.bit_length() - 1)

    def _warm_up(self, first: int, beside: Beside | None) -> None:
        """Take a step and undo the step, because a graph capture must not load modules or allocate memory."""
        self._begin_at(first)
        self._take(1, beside)
        is_short = self.solver.make_room()
        self._forget_stale_graphs()
        self.solver.reset(first)
        if is_short:
            self._warm_up(first, beside)
        self._warm.add(beside)

    def _take(self, length: int, beside: Beside | None) -> None:
        state = self._input
        for number, new_state in enumerate(self._chunk[:length]):
            self.solver.step(state, new_state, self.parameters, self.log)
            if beside is not None:
                beside.launch(number, self.parameters)
            self.step_sizes.choose(new_state)
            state = new_state
        for copy in self._copies:
            copy.fetch()

    def _forget_stale_graphs(self) -> None:
        if self._generation == self.solver.generation:
            return
        self._generation, self._warm = self.solver.generation, set[Beside | None]()
        self._chunks: dict[tuple[int, Beside | None, bool], CapturedGraph] = {}
        self._reset = CapturedGraph(self.solver.reset, self.solver.launch, lends=False)
        self._steps_back: dict[tuple[BackwardStep, Counts], CapturedGraph] = {}
        self._steps_along: dict[Counts, CapturedGraph] = {}

    @in_turn
    def backward(self, derivative: BackwardStep, bars: Mapping[int, State], observe: Observer | None = None) -> State:
        """Return the adjoint of the first state. ``bars`` maps numbers of states to adjoints of the states. The next
        backward pass overwrites the returned adjoint.

        ``observe`` is called with the adjoint of every state, from the last to the first. Raises `InputError` unless
        ``forward`` has run to the end with ``keep``, the current first state and the current parameters.
        """
        if derivative.rollout is not self:
            raise InputError("The derivative was made for another rollout, but must be made for this one.")
        if beyond := [step for step in bars if step not in range(self.steps + 1)]:
            raise InputError(f"bars has the state {beyond[0]}, but must have states from 0 to {self.steps}.")
        self._require("backward", self._kept)
        self.solver.set_substeps(self.substeps)
        if self.steps > 0:
            compile_ahead(derivative, self._device, adjoints=True)
        derivative.begin()
        self._forget_stale_graphs()
        if self.steps in bars:
            self._bar.assign(bars[self.steps])
        else:
            self._bar.clear()
        for n in reversed(range(self.steps + 1)):
            if n in bars and n < self.steps:
                for bar, total in zip(bars[n].arrays(), self._bar.arrays(), strict=True):
                    add(bar, total)
            if observe is not None:
                observe(n, self._bar)
            if n > 0:
                self._buffer.assign(self._checkpoints.state(n - 1, self._replayed))
                counts = self._seek(n - 1)
                work: Callable[[], None] = partial(derivative.step, self._buffer, counts, self._bar)
                if derivative.capturable:
                    work = self._steps_back.setdefault((derivative, counts), CapturedGraph(work, self.solver.launch))
                work()
        return self._bar

    @in_turn
    def tangent(self, dot: State, parameters_dot: Parameters, observe: Observer) -> None:
        """Replace ``dot``, the tangent of the first state, by the tangent of the last state. ``observe`` is called with
        the tangent of every state. Raises `InputError` unless ``forward`` has run with the current parameters."""
        self._require("along a tangent", self._run)
        self.solver.set_substeps(self.substeps)
        self._forget_stale_graphs()
        if self._tangent is None or self._tangent[0] is not parameters_dot:
            self._tangent = parameters_dot, self.solver.tangent(parameters_dot), self.solver.new_state()
            self._steps_along.clear()
        _, derivative, present = self._tangent
        self._buffer.assign(self.initial)
        present.assign(dot)
        observe(0, present)

        def step_along(counts: Counts) -> None:
            self.solver.replay(self._buffer, self.parameters, counts)
            derivative.step(counts, present, self.parameters)
            self.solver.write_state(counts, self.parameters, self._buffer)

        for n in range(self.steps):
            counts = self._seek(n)
            self._steps_along.setdefault(counts, CapturedGraph(partial(step_along, counts), self.solver.launch))()
            observe(n + 1, present)
        dot.assign(present)

    def _require(self, what: str, evaluation: int) -> None:
        if evaluation != self.evaluation:
            lacking = "as no forward run with these parameters has kept its states"
            raise InputError(f"The rollout cannot run {what}, {lacking}: call forward with keep=True first.")

    def _replayed(self, n: int, state: State) -> State:
        counts, new_state = self._seek(n), self.initial.following()
        self.solver.replay(state, self.parameters, counts)
        self.solver.write_state(counts, self.parameters, new_state)
        return new_state

    def _seek(self, step: int) -> Counts:
        """Prepare the solver to repeat a step, and return the recorded iteration counts. The first ``step`` is 0."""
        self._begin_at(step)
        return self.log.seek(step)

    def _begin_at(self, step: int) -> None:
        self.solver.step_number.fill_(step)
        self.step_sizes.seek(step)


OF_RUNS = "lost", "_checkpoints", "_kept", "_run"
REPLACED = *OF_RUNS, "clocks", "origins", "substeps", "advice", "goes_on", "evaluation"


class Residual:
    """Data for a backward pass after later evaluations. Before the next evaluation begins, the first state, the
    parameters and the log are copied to the residual."""

    def __init__(self, rollout: Rollout):
        self.rollout, self.turn = rollout, rollout.turn
        self._write_back: Callable[[], None] | None = None
        rollout.pending.add(self)

    def put_aside(self) -> None:
        rollout = self.rollout
        made = rollout.aside.pop() if rollout.aside else (rollout.initial.like(), rollout.solver.new_log(rollout.room))
        first, log = made
        first.assign(rollout.initial)
        log.assign(rollout.log)
        time_steps, sizes = rollout.time_steps.copy(), rollout.step_sizes.recorded()
        written = rollout.parameters.written.items()
        rows = {name: wp.clone(row) if isinstance(row, wp.array) else row.copy() for name, row in written}
        replaced = {name: getattr(rollout, name) for name in REPLACED}

        def write_back() -> None:
            rollout.initial.assign(first)
            rollout.parameters.set(rows)
            rollout.time_steps[:] = time_steps
            rollout.log.assign(log)
            rollout.aside.append(made)
            rollout.step_sizes.assign(sizes)
            for name, value in replaced.items():
                setattr(rollout, name, value)

        self._write_back = write_back

    @in_turn
    def bring_back(self) -> None:
        if self._write_back is not None:
            write_back, self._write_back = self._write_back, None
            self.rollout.begin_evaluation()
            write_back()
            self.rollout.pending.add(self)
