"""Iterations within a time step that end when the errors are small enough. Kernels decide when to stop."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any, Protocol, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import HostCopy, KernelLauncher
from cortado.device.modules import by_name, kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.device.reduction import sum_and_maximum
from cortado.particles.state import Layout
from cortado.solvers.containment import NO_PARTICLE, Containment
from cortado.solvers.solver import Counts

UNKNOWN = 2**31 - 1
"""Number of iterations of a loop that has not ended."""


@dataclass(frozen=True)
class Measure:
    """A reduction of the errors of all particles to one or two numbers per step."""

    columns: tuple[str, ...]
    """Names of the reduced numbers in diagnostics."""
    is_weighted: bool
    """True for a weighted root mean square, False for average and maximum."""


AVERAGE = Measure(("{}", "greatest_{}"), is_weighted=False)
ROOT_MEAN_SQUARE = Measure(("{}",), is_weighted=True)


@cache
def convergence_kernels(precision: Precision, measure: Measure = AVERAGE) -> SimpleNamespace:
    """Make the kernels that count and stop iterations."""
    real, pair = precision.real, precision.pair
    module = kernel_module(f"convergence_{precision.name}{'_weighted' * measure.is_weighted}")

    @wp.func
    def average_and_maximum(sums: pair, particles: int) -> pair:
        return pair(sums[0] / real(particles), sums[1])

    @wp.func
    def root_of_mean(sums: pair, particles: int) -> pair:
        mean = real(0.0)
        if sums[1] != real(0.0):
            mean = sums[0] / sums[1]
        return pair(wp.sqrt(mean), real(0.0))

    reached = root_of_mean if measure.is_weighted else average_and_maximum

    typed = TypesByName(real, {pair: "sums", wp.int32: "iteration rounds active bad step count"})

    @typed.kernel(module)
    def decide(
        done: int, most: int, particles: int, tolerance: real, greatest_tolerance: real, sums, iteration, rounds, active
    ):
        """Add ``done`` to the number of iterations, and stop scenes that have converged or reached ``most``
        iterations."""
        b = wp.tid()
        if rounds[b] != wp.static(UNKNOWN):
            return
        count = iteration[b] + done
        found = reached(sums[b], particles)
        iteration[b] = count
        if count >= most or not (found[0] > tolerance or found[1] > greatest_tolerance):
            rounds[b] = count
            wp.atomic_sub(active, 0, 1)

    @wp.func
    def end_step(
        b: int, bad: wp.array(dtype=wp.int32), bad_step: wp.array(dtype=wp.int32), step: wp.array(dtype=wp.int32)
    ):
        if bad[b] != wp.static(NO_PARTICLE) and bad_step[b] < 0:
            bad_step[b] = step[b]
        step[b] = step[b] + 1

    @typed.kernel(module)
    def record(
        particles: int, undecided: int, is_last: int, sums, bad, step, iteration, bad_step, rounds, active,
        iterations: wp.array2d(dtype=wp.int32), errors: wp.array2d(dtype=pair),
    ):  # fmt: skip
        """Record the number of iterations and the errors of a loop. After the last loop, increment the step number."""
        b = wp.tid()
        n = step[b]
        iterations[n, b] = iteration[b] + undecided
        errors[n, b] = reached(sums[b], particles)
        iteration[b] = 0
        rounds[b] = wp.static(UNKNOWN)
        if b == 0:
            active[0] = bad.shape[0]
        if is_last != 0:
            end_step(b, bad, bad_step, step)

    @typed.kernel(module)
    def count_step(bad, bad_step, step):
        end_step(wp.tid(), bad, bad_step, step)

    @typed.kernel(module)
    def note(count, step, iterations: wp.array2d(dtype=wp.int32)):
        b = wp.tid()
        iterations[step[b], b] = count[b]

    return by_name(decide, record, count_step, note)


class IterativeSolve(Protocol):
    """Protocol of an iterative solve for a force. The force has it as the attribute ``solve``."""

    name: str
    """Name of the iterations in the diagnostics of a run."""
    count: wp.array
    """Number of iterations of the last solve in each scene (members,)."""


@dataclass(frozen=True)
class LoopLimits:
    minimum_iterations: int
    maximum_iterations: int
    tolerance: float
    """Upper bound on the average or root mean square error."""
    greatest_tolerance: float
    """Upper bound on the error of every particle; may be infinite."""


class StepRecord(ABC):
    """Arrays (steps, members) on the device with numbers of a loop or a solve for each step."""

    def __init__(self, steps: int, layout: Layout, *kinds: Any):
        """Allocate an array of iterations, and arrays of the Warp types ``kinds``."""
        shape = (max(steps, 1), layout.members)
        self.arrays = [wp.zeros(shape, dtype=kind, device=layout.device) for kind in (wp.int32, *kinds)]
        self.copies, self._batch = [HostCopy(array) for array in self.arrays], layout.batch
        self.read(0)

    def read(self, steps: int) -> None:
        """Take the first ``steps`` steps as the steps of the last run. They are read when they are asked for."""
        self.steps, self._diagnostics = steps, None

    @property
    def diagnostics(self) -> dict[str, NDArray]:
        """Return the diagnostics by name (steps,), in a batch (steps, batch)."""
        if self._diagnostics is None:
            found = [copy.read(self.steps) for copy in self.copies]
            self._diagnostics = self._named(*(array[:, 0] if self._batch is None else array for array in found))
        return self._diagnostics

    _diagnostics: dict[str, NDArray] | None

    @abstractmethod
    def _named(self, iterations: NDArray, *others: NDArray) -> dict[str, NDArray]:
        """Return diagnostics by name from the numbers of the last run."""

    @abstractmethod
    def is_calm(self, limits: Mapping[str, float]) -> bool:
        """Test if all steps have converged, without columns above the given limits."""

    def assign(self, other: Self) -> None:
        for own, given, copy in zip(self.arrays, other.arrays, self.copies, strict=True):
            wp.copy(own, given)
            copy.is_fetched = False
        self.read(other.steps)


class SolveRecord(StepRecord):
    """Numbers of iterations of a force's solve in each step."""

    def __init__(self, steps: int, solve: IterativeSolve, layout: Layout):
        super().__init__(steps, layout)
        self.solve, self._note = solve, convergence_kernels(layout.precision).note

    def _named(self, iterations: NDArray, *others: NDArray) -> dict[str, NDArray]:
        return {self.solve.name: iterations.astype(int)}

    def is_calm(self, limits: Mapping[str, float]) -> bool:
        return not (self.copies[0].read(self.steps) > limits.get(self.solve.name, np.inf)).any()

    def note(self, launch: KernelLauncher, step: wp.array) -> None:
        """Record the number of iterations of a solve. ``step`` is the number of the step in each scene."""
        (iterations,) = self.arrays
        launch(self._note, count=self.solve.count, step=step, iterations=iterations, threads=iterations.shape[1])


class LoopRecord(StepRecord):
    """Numbers of iterations and errors of a loop in each step."""

    def __init__(self, steps: int, loop: "Loop"):
        self.loop = loop
        super().__init__(steps, loop.layout, loop.layout.precision.pair)

    def _named(self, iterations: NDArray, *others: NDArray) -> dict[str, NDArray]:
        (errors,) = others
        found = {name: errors[..., number].astype(np.float64) for number, name in enumerate(self.loop.columns)}
        return {self.loop.iterations_name: iterations.astype(int), **found}

    @property
    def counts(self) -> NDArray:
        """Return the number of iterations of each step (steps,). In a batch it is the greatest number of all scenes."""
        return self.copies[0].read(self.steps).max(axis=1)

    @property
    def _bounds(self) -> tuple[float, ...]:
        limits = self.loop.limits
        if limits is None or limits.minimum_iterations == limits.maximum_iterations:
            return ()
        return limits.tolerance, limits.greatest_tolerance

    @property
    def converged(self) -> NDArray:
        """Test for each step if the errors are within the tolerances, (steps,) or (steps, batch)."""
        found = [self.diagnostics[name] for name in self.loop.columns]
        columns = [column <= bound for column, bound in zip(found, self._bounds, strict=False)]
        return np.logical_and.reduce([np.ones(found[0].shape, dtype=bool), *columns])

    def is_calm(self, limits: Mapping[str, float]) -> bool:
        wanted = [limits.get(name, np.inf) for name in self.loop.columns]
        bounds = [min(pair) for pair in zip(wanted, (*self._bounds, np.inf, np.inf), strict=False)]
        errors = self.copies[1].read(self.steps)
        return all(bool((errors[..., k] <= bound).all()) for k, bound in enumerate(bounds) if bound < np.inf)


class IterationLog:
    """A `StepLog` of loops and of the solves of forces."""

    def __init__(self, steps: int, loops: Sequence["Loop"], solves: Sequence[IterativeSolve], layout: Layout):
        self.loops = tuple(LoopRecord(steps, loop) for loop in loops)
        self.solves = tuple(SolveRecord(steps, solve, layout) for solve in solves)
        self.records: tuple[StepRecord, ...] = (*self.loops, *self.solves)
        self._steps, self._layout = 0, layout

    @property
    def diagnostics(self) -> dict[str, NDArray]:
        scenes = () if self._layout.batch is None else (self._layout.batch,)
        found, converged = dict[str, NDArray](), np.ones((self._steps, *scenes), dtype=bool)
        for record in self.records:
            found |= record.diagnostics
        for loop in self.loops:
            converged &= loop.converged
        return {**found, "converged": converged}

    def is_calm(self, limits: Mapping[str, float]) -> bool:
        """Test if all loops have converged in all steps, without diagnostics above the given ``limits`` by name."""
        return all(record.is_calm(limits) for record in self.records)

    @property
    def copies(self) -> list[HostCopy]:
        return [copy for record in self.records for copy in record.copies]

    def read(self, steps: int) -> None:
        self._steps = steps
        for record in self.records:
            record.read(steps)

    def assign(self, other: "IterationLog") -> None:
        self._steps = other._steps
        for own, given in zip(self.records, other.records, strict=True):
            own.assign(given)

    def seek(self, step: int) -> Counts:
        return tuple(record.loop.seek(record, step) for record in self.loops)


class Loop:
    """A loop of iterations over all particles. It ends on the device when the errors are small enough."""

    def __init__(
        self,
        limits: LoopLimits | None,
        layout: Layout,
        launch: KernelLauncher,
        iterations_name: str = "iterations",
        errors_name: str = "density_errors",
        measure: Measure = AVERAGE,
    ):
        """Prepare a loop. With ``limits`` None it has no iterations. The names appear in diagnostics."""
        precision, device = layout.precision, layout.device
        self.limits, self.iterations_name, self.layout = limits, iterations_name, layout
        self.columns = [column.format(errors_name) for column in measure.columns]
        self.errors = wp.zeros(layout.all_particles, dtype=precision.pair, device=device)
        """Errors of each particle in the last iteration, as pairs of numbers (n,)."""
        self.rounds = wp.full(layout.members, UNKNOWN, dtype=wp.int32, device=device)
        """Number of iterations of each scene (members,), or `UNKNOWN` while the loop runs. Scenes that have ended must
        not change in later iterations."""
        self._launch, self._kernels = launch, convergence_kernels(precision, measure)
        self._sum = (
            layout.sum_of(precision.pair)
            if measure.is_weighted
            else sum_and_maximum(layout.particles, precision, device, layout.members)
        )
        self._sums = wp.zeros(layout.members, dtype=precision.pair, device=device)
        is_fixed = limits is not None and limits.minimum_iterations == limits.maximum_iterations
        self._fixed = limits.minimum_iterations if limits is not None and is_fixed else 0
        """Fixed number of iterations, or 0."""
        self._iteration = wp.zeros(layout.members, dtype=wp.int32, device=device)
        self._active = wp.full(1, layout.members, dtype=wp.int32, device=device)

    def reset(self) -> None:
        self._iteration.zero_()
        self.rounds.fill_(UNKNOWN)
        self._active.fill_(self.layout.members)

    def seek(self, record: LoopRecord, step: int) -> int:
        """Prepare the loop to repeat a recorded step, and return its number of iterations."""
        if self.layout.members > 1:
            wp.copy(self.rounds, record.arrays[0][step])
        return int(record.counts[step])

    def run(self, iterate: Callable[[int], None]) -> None:
        """Iterate until the errors are small enough. ``iterate`` is called with the number of the iteration, from 0.
        After the minimum number of iterations, a CUDA graph repeats one call, with the maximum number as its argument.
        """
        limits = self.limits
        if limits is None:
            return
        for k in range(limits.minimum_iterations):
            iterate(k)
        with self._launch.aside() if self._fixed else nullcontext():
            self._sums = self._sum(self.errors)
        if limits.maximum_iterations > limits.minimum_iterations:
            self._decide(limits, limits.minimum_iterations)

            def once_more() -> None:
                iterate(limits.maximum_iterations)
                self._sums = self._sum(self.errors)
                self._decide(limits, 1)

            wp.capture_while(self._active, once_more)

    def note(self, record: LoopRecord, containment: Containment, step_number: wp.array, is_last: bool) -> None:
        """Record the iterations and errors of this step."""
        self._launch.join()
        iterations, errors = record.arrays
        known = {"iteration": self._iteration, "rounds": self.rounds, "active": self._active, "sums": self._sums}
        known |= {"bad": containment.bad_particle, "bad_step": containment.bad_step, "step": step_number}
        known |= {"iterations": iterations, "errors": errors, "particles": self.layout.particles}
        numbers = {"undecided": self._fixed, "is_last": int(is_last)}
        self._launch(self._kernels.record, known, **numbers, threads=self.layout.members)

    def _decide(self, limits: LoopLimits, done: int) -> None:
        known = {"iteration": self._iteration, "rounds": self.rounds, "active": self._active, "sums": self._sums}
        known |= {"most": limits.maximum_iterations, "particles": self.layout.particles, "done": done}
        known |= {"tolerance": limits.tolerance, "greatest_tolerance": limits.greatest_tolerance}
        self._launch(self._kernels.decide, known, threads=self.layout.members)
