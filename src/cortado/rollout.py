"""The only time loop: run forward, keep checkpoints, go back.

Steps are launched in chunks without a host read in between; at the end of a chunk the host looks whether the
neighbour lists were long enough (if not, they grow and the chunk is repeated) and whether a particle was lost.
On a GPU a step is a captured graph.
"""

from collections.abc import Callable, Mapping
from functools import partial
from math import isqrt
from typing import Protocol

import numpy as np
import warp as wp

from cortado.errors import DivergedError
from cortado.launching import Replayed, add
from cortado.memory import require, step_parts, within
from cortado.particles import Parameters, State
from cortado.restart import Elapsed
from cortado.solvers.containment import Lost
from cortado.solvers.pcisph import Pcisph
from cortado.solvers.pcisph_derivatives import PcisphTangent
from cortado.threads import WARP, Turn, in_turn

CHUNK = 16
"""Steps between two looks of the host, on a GPU."""
MEMORY_BUDGET = 8 * 2**30
"""Bytes of checkpoints; beyond it states are kept less often and recomputed on the way back."""

Observer = Callable[[int, State], None]


class StepDerivative(Protocol):
    """How one step is gone back through; made by a policy for one rollout."""

    capturable: bool
    """Whether a step may be captured as a graph."""
    solver: Pcisph
    """Whose fields hold the recorded step after `step`."""

    def begin(self) -> None:
        """Forget the parameters' adjoints of an earlier way back."""

    def step(self, state: State, iterations: int, bar: State) -> None:
        """Replace ``bar``, the adjoint of the step's result, by that of its first state."""

    def parameters(self) -> Parameters:
        """Adjoints of the parameters, of all steps since `begin`."""


def checkpoint_interval(steps: int, affordable: int) -> int:
    """Steps from one checkpoint to the next: the fewest with which no more states than affordable are alive at a time,
    those between two checkpoints included; about the square root of the steps where that cannot be."""
    if steps <= affordable:
        return 1
    intervals = range(1, isqrt(steps) + 2)
    return next((n for n in intervals if -(-steps // n) + n <= affordable), isqrt(steps) + 1)


class Rollout:
    """A number of steps of a solver from a first state, which can be repeated and differentiated."""

    @WARP
    def __init__(self, solver: Pcisph, steps: int, memory_budget: int = MEMORY_BUDGET):
        self.solver, self.steps = solver, steps
        self._device = solver.search.device
        require(step_parts(steps, solver.discretisation.precision.bytes), "take fewer steps", self._device)
        self.initial = solver.new_state()
        self.parameters = solver.new_parameters(steps)
        self.substeps = 0
        """Explicit steps of diffusion within each step."""
        self.time_step = self.flow_rate = 0.0
        """[s] and [m3/s], in 2-D [m2/s], as they were given: the device rounds them."""
        self.elapsed = Elapsed()
        """What went before the first state."""
        self._records = (
            wp.zeros(max(steps, 1), dtype=wp.int32, device=self._device),
            wp.zeros(max(steps, 1), dtype=solver.discretisation.precision.pair, device=self._device),
        )
        state_bytes = sum(array.capacity for array in self.initial.arrays())
        self._interval = checkpoint_interval(steps, within(memory_budget, self._device) // state_bytes)
        self._states: dict[int, State] = {}
        self._buffer, self._bar = self.initial.like(), self.initial.like()
        self._growth = -1
        self._forget_stale_graphs()
        self.evaluation = 0
        """How often the first state and the parameters were replaced: a way back belongs to one evaluation."""
        self.iterations = np.zeros(0, dtype=int)
        """(steps,) pressure iterations of the last forward run."""
        self.errors = np.zeros((0, 2))
        """(steps, 2) average and greatest compression (rho* - rho_0)+ / rho_0 at each step."""

    @property
    def turn(self) -> Turn:
        """What a thread holds that uses the solver."""
        return self.solver.turn

    # ---- forward -------------------------------------------------------------------------------------------------

    @in_turn
    def forward(self, observe: Observer | None = None, keep: bool = True) -> State:
        """Run all steps and return the last state. ``observe`` is given every state; ``keep`` checkpoints for a way
        back. Raises `DivergedError` after the good states were observed."""
        self._states = {0: self.initial}
        state, step = self.initial, 0
        self._set_solver()
        self._forget_stale_graphs()
        self.solver.reset()
        try:
            while step < self.steps:
                last = min(step + (1 if self._device.is_cpu else CHUNK), self.steps)
                chunk = self._advance(state, step, last)
                if self._grow_lists():
                    continue
                lost = self.solver.containment.lost()
                good = chunk if lost is None else chunk[: lost.step - step]
                for number, new_state in enumerate(good, step + 1):
                    if observe is not None:
                        observe(number, new_state)
                    if keep and number % self._interval == 0:
                        self._states[number] = new_state
                if lost is not None:
                    bad, step = chunk[lost.step - step], lost.step + 1
                    raise self._diverged(lost, bad)
                state, step = chunk[-1], last
        finally:
            self._read_records(step)
        return state

    def _set_solver(self) -> None:
        """What the solver must know of this rollout before any of its steps, as rollouts share it."""
        self.solver.diffuse(self.substeps)
        if self.solver.emitter:
            self.solver.emitter.go_on(self.elapsed)

    def _advance(self, state: State, first: int, last: int) -> list[State]:
        self.solver.step_number.fill_(first)
        chunk = []
        self._buffer.assign(state)
        for _ in range(first, last):
            self._step()
            chunk.append(self._buffer.like())
            chunk[-1].assign(self._buffer)
        return chunk

    def _grow_lists(self) -> bool:
        """Whether the neighbour lists were too short; they are longer now, and what used them must be repeated."""
        needed = self.solver.search.needed
        if needed <= self.solver.search.capacity:
            return False
        self.solver.grow(min(needed + needed // 8 + 1, 2 * self.solver.search.capacity))
        self.solver.search.forget_needed()
        self._forget_stale_graphs()
        self.solver.reset()
        return True

    def _forget_stale_graphs(self) -> None:
        """Begin anew with graphs where arrays of the solver were replaced, by this rollout or by another."""
        if self._growth == self.solver.growth:
            return
        self._growth = self.solver.growth
        step = partial(self.solver.step, self._buffer, self._buffer, self.parameters, self._records)
        self._step = Replayed(step, self.solver.launch)
        self._steps_back: dict[tuple[StepDerivative, int], Replayed] = {}

    def _diverged(self, lost: Lost, state: State) -> DivergedError:
        containment = self.solver.containment
        position = state.positions.numpy()[lost.particle][: containment.walled.dimension]
        imprecise = ", or float64 for fluid that flies that far" if containment.is_imprecise(position) else ""
        return DivergedError(
            step=lost.step + 1,
            particle=lost.particle,
            advice=f"try a smaller time step than {self.time_step:g} s, or more pressure iterations{imprecise}",
            where=containment.where(position),
            others=lost.others,
        )

    def _read_records(self, steps: int) -> None:
        self.iterations = self._records[0].numpy()[:steps].astype(int)
        self.errors = self._records[1].numpy()[:steps].astype(np.float64)

    # ---- derivatives ---------------------------------------------------------------------------------------------

    @in_turn
    def backward(self, derivative: StepDerivative, bars: Mapping[int, State], observe: Observer | None = None) -> State:
        """The adjoint of the first state, for ``bars``, adjoints of states by their number; `forward` has run.

        ``observe`` is given the adjoint of every state, from the last to the first; the next step overwrites it.
        """
        self._set_solver()
        derivative.begin()
        self._forget_stale_graphs()
        self._bar.clear()
        for n in reversed(range(self.steps + 1)):
            if n in bars:
                for bar, total in zip(bars[n].arrays(), self._bar.arrays(), strict=True):
                    add(bar, total)
            if observe is not None:
                observe(n, self._bar)
            if n > 0:
                self._buffer.assign(self._restore(n - 1))
                self.solver.step_number.fill_(n - 1)
                self._step_back(derivative, int(self.iterations[n - 1]))
        return self._bar

    def _step_back(self, derivative: StepDerivative, iterations: int) -> None:
        work = partial(derivative.step, self._buffer, iterations, self._bar)
        if not derivative.capturable:
            work()
            return
        key = (derivative, iterations)
        if key not in self._steps_back:
            self.solver.iterates.reserve(iterations)
            self._steps_back[key] = Replayed(work, self.solver.launch)
        self._steps_back[key]()

    @in_turn
    def tangent(self, dot: State, parameters_dot: Parameters, observe: Observer) -> None:
        """From ``dot``, the tangent of the first state, to that of every state, given to ``observe``; `forward` has
        run."""
        self._set_solver()
        derivative = PcisphTangent(self.solver, parameters_dot)
        state = self.initial.like()
        state.assign(self.initial)
        observe(0, dot)
        for n in range(self.steps):
            iterations = int(self.iterations[n])
            self.solver.step_number.fill_(n)
            self.solver.record(state, self.parameters, iterations)
            derivative.step(iterations, dot, dot, self.parameters)
            self.solver.recorded(iterations, self.parameters, state)
            observe(n + 1, dot)

    def _restore(self, n: int) -> State:
        """State n: a checkpoint, or recomputed from the one before, with the states in between."""
        if n not in self._states:
            start = n - n % self._interval
            for m in range(start, n):
                self.solver.step_number.fill_(m)
                self.solver.record(self._states[m], self.parameters, int(self.iterations[m]))
                self._states[m + 1] = self.initial.like()
                self.solver.recorded(int(self.iterations[m]), self.parameters, self._states[m + 1])
        if (n + 1) % self._interval:
            self._states.pop(n + 1, None)
        return self._states[n]
