"""Iterations within a time step, which end when kernels find that the errors are small enough."""

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
"""Value of the number of iterations while a loop has not ended."""


@cache
def convergence_kernels(precision: Precision, weighted: bool = False) -> SimpleNamespace:
    real, pair = precision.real, precision.pair
    module = kernel_module(f"convergence_{precision.name}{'_weighted' * weighted}")

    @wp.func
    def average_and_maximum(sums: pair, particles: int) -> pair:
        return pair(sums[0] / real(particles), sums[1])

    @wp.func
    def root_of_mean(sums: pair, particles: int) -> pair:
        mean = real(0.0)
        if sums[1] != real(0.0):
            mean = sums[0] / sums[1]
        return pair(wp.sqrt(mean), real(0.0))

    reached = root_of_mean if weighted else average_and_maximum
    typed = TypesByName(real, {pair: "sums", wp.int32: "iteration rounds active bad step count"})

    @typed.kernel(module)
    def decide(
        done: int, most: int, particles: int, tolerance: real, greatest_tolerance: real, sums, iteration, rounds, active
    ):
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
    """Protocol of the iterative solver of a force, which is the attribute ``solve`` of the force."""

    name: str
    """Name of the iterations in the diagnostics of a run."""
    count: wp.array
    """Array of shape (members,) with the number of iterations in each scene's last solve."""


@dataclass(frozen=True)
class LoopLimits:
    minimum_iterations: int
    maximum_iterations: int
    tolerance: float
    """Upper bound on the average or root mean square error."""
    greatest_tolerance: float
    """Upper bound on the error of every particle. The bound on the error of every particle may be infinite."""


class StepRecord:
    """Numbers of iterations and errors in each step, for a loop or for the iterative solver of a force."""

    def __init__(self, steps: int, layout: Layout, name: str, columns: Sequence[str] = ()):
        """Diagnostics contain the iterations under ``name``, and the errors under ``columns``."""
        shape, kinds = (max(steps, 1), layout.members), (wp.int32, layout.precision.pair)
        self.arrays = [wp.zeros(shape, dtype=kind, device=layout.device) for kind in kinds[: 2 if columns else 1]]
        """Device arrays of shape (steps, members): numbers of iterations, and with ``columns`` also errors."""
        self.copies, self._batch = [HostCopy(array) for array in self.arrays], layout.batch
        self._name, self._columns = name, columns
        self.read(0)

    def read(self, steps: int) -> None:
        """Set the length of the last run to ``steps``. The record copies its values from the device when needed."""
        self._steps = steps
        self._diagnostics: dict[str, NDArray] | None = None

    @property
    def diagnostics(self) -> dict[str, NDArray]:
        """Return the last run's diagnostics by name, as arrays of shape (steps,), or (steps, batch) for a batch."""
        if self._diagnostics is None:
            found = [copy.read(self._steps) for copy in self.copies]
            iterations, *errors = [array[:, 0] for array in found] if self._batch is None else found
            named = {name: errors[0][..., number].astype(np.float64) for number, name in enumerate(self._columns)}
            self._diagnostics = {self._name: iterations.astype(int), **named}
        return self._diagnostics

    @property
    def counts(self) -> NDArray:
        """Return an array (steps,) with each step's iterations, in a batch the greatest number over all scenes."""
        return self.copies[0].read(self._steps).max(axis=1)

    def bounds(self, limits: Mapping[str, float]) -> list[NDArray]:
        """Return an upper bound for each array in ``copies``. Without a limit, the bound is infinite."""
        columns = [limits.get(name, np.inf) for name in self._columns] + [np.inf] * (2 - len(self._columns))
        return [np.array(limits.get(self._name, np.inf)), np.array(columns)][: len(self.copies)]

    def assign(self, other: Self) -> None:
        for own, given, copy in zip(self.arrays, other.arrays, self.copies, strict=True):
            wp.copy(own, given)
            copy.is_fetched = False
        self.read(other._steps)


class IterationLog:
    """A `StepLog` of the iterations in loops and in forces."""

    def __init__(self, steps: int, loops: Sequence["Loop"], solves: Sequence[IterativeSolve], layout: Layout):
        self.loops = [(loop, StepRecord(steps, layout, loop.iterations_name, loop.columns)) for loop in loops]
        self.solves = [(solve, StepRecord(steps, layout, solve.name)) for solve in solves]
        self._records, self._steps, self._layout = [one for _, one in (*self.loops, *self.solves)], 0, layout
        self.copies = [copy for record in self._records for copy in record.copies]
        self._bounds: tuple[Mapping[str, float], list[tuple[HostCopy, NDArray]]] = {}, []

    @property
    def diagnostics(self) -> dict[str, NDArray]:
        scenes = () if self._layout.batch is None else (self._layout.batch,)
        found, converged = dict[str, NDArray](), np.ones((self._steps, *scenes), dtype=bool)
        for record in self._records:
            found |= record.diagnostics
        for loop, _ in self.loops:
            for name, bound in loop.bounds.items():
                converged &= found[name] <= bound
        return {**found, "converged": converged}

    def is_calm(self, limits: Mapping[str, float]) -> bool:
        if self._bounds[0] != limits:
            own = dict(limits)
            for loop, _ in self.loops:
                own |= {name: min(bound, own.get(name, np.inf)) for name, bound in loop.bounds.items()}
            bounds = [bound for record in self._records for bound in record.bounds(own)]
            each = zip(self.copies, bounds, strict=True)
            self._bounds = limits, [(copy, bound) for copy, bound in each if bound.min() < np.inf]
        return all((copy.read(self._steps) <= bound).all() for copy, bound in self._bounds[1])

    def read(self, steps: int) -> None:
        self._steps = steps
        for record in self._records:
            record.read(steps)

    def assign(self, other: "IterationLog") -> None:
        self._steps = other._steps
        for own, given in zip(self._records, other._records, strict=True):
            own.assign(given)

    def seek(self, step: int) -> Counts:
        return tuple(loop.seek(record, step) for loop, record in self.loops)


class Loop:
    def __init__(
        self,
        limits: LoopLimits | None,
        layout: Layout,
        launch: KernelLauncher,
        iterations_name: str = "iterations",
        errors_name: str = "density_errors",
        weighted: bool = False,
    ):
        """With ``limits`` None the loop has no iterations. The errors of all particles are reduced to average and
        maximum, or to a weighted root mean square if ``weighted`` is true."""
        precision, device = layout.precision, layout.device
        self.limits, self.iterations_name, self.layout = limits, iterations_name, layout
        self.columns = [errors_name] if weighted else [errors_name, f"greatest_{errors_name}"]
        self.errors = wp.zeros(layout.all_particles, dtype=precision.pair, device=device)
        """Array of shape (n,) with two error values of each particle in the last iteration."""
        self.rounds = wp.full(layout.members, UNKNOWN, dtype=wp.int32, device=device)
        """Array of shape (members,) with each scene's number of iterations, or `UNKNOWN` while the loop runs. Later
        iterations must not change a scene that has ended."""
        self._launch, self._kernels = launch, convergence_kernels(precision, weighted)
        size = layout.particles, precision, device, layout.members
        self._sum = layout.sum_of(precision.pair) if weighted else sum_and_maximum(*size)
        self._sums = wp.zeros(layout.members, dtype=precision.pair, device=device)
        is_fixed = limits is not None and limits.minimum_iterations == limits.maximum_iterations
        self._fixed = limits.minimum_iterations if limits is not None and is_fixed else 0
        self.bounds: dict[str, float] = {}
        """Bounds on the reduced errors, by name. With a fixed number of iterations the dict is empty."""
        if limits is not None and not is_fixed:
            self.bounds = dict(zip(self.columns, (limits.tolerance, limits.greatest_tolerance), strict=False))
        self._iteration = wp.zeros(layout.members, dtype=wp.int32, device=device)
        self._active = wp.full(1, layout.members, dtype=wp.int32, device=device)
        self._known: dict[str, Any] = {"iteration": self._iteration, "rounds": self.rounds, "active": self._active}
        self._known["particles"] = layout.particles

    def reset(self) -> None:
        self._iteration.zero_()
        self.rounds.fill_(UNKNOWN)
        self._active.fill_(self.layout.members)

    def seek(self, record: StepRecord, step: int) -> int:
        """Prepare the loop to repeat a recorded step, and return its number of iterations."""
        if self.layout.members > 1:
            wp.copy(self.rounds, record.arrays[0][step])
        return int(record.counts[step])

    def run(self, iterate: Callable[[int], None]) -> None:
        """Iterate until the errors are small enough. The loop calls ``iterate`` with the iteration's number, from 0.

        After the minimum number of iterations, a CUDA graph repeats the call ``iterate(maximum_iterations)``.
        """
        limits = self.limits
        if limits is None:
            return
        for k in range(limits.minimum_iterations):
            iterate(k)
        with self._launch.aside() if self._fixed else nullcontext():
            self._sums = self._sum(self.errors)
        known: dict[str, Any] = {**self._known, "most": limits.maximum_iterations, "tolerance": limits.tolerance}
        known["greatest_tolerance"] = limits.greatest_tolerance

        def decide(done: int) -> None:
            self._launch(self._kernels.decide, known, done=done, sums=self._sums, threads=self.layout.members)

        def once_more() -> None:
            iterate(limits.maximum_iterations)
            self._sums = self._sum(self.errors)
            decide(1)

        if limits.maximum_iterations > limits.minimum_iterations:
            decide(limits.minimum_iterations)
            wp.capture_while(self._active, once_more)

    def note(self, record: StepRecord, containment: Containment, step_number: wp.array, is_last: bool) -> None:
        self._launch.join()
        iterations, errors = record.arrays
        own = {"bad": containment.bad_particle, "bad_step": containment.bad_step, "step": step_number}
        own |= {"iterations": iterations, "errors": errors, "sums": self._sums}
        numbers = {"undecided": self._fixed, "is_last": int(is_last)}
        self._launch(self._kernels.record, self._known, own, **numbers, threads=self.layout.members)
