"""Loops of a step that go round until an error is small enough, and what is noted of them in every step."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.launching import KernelLauncher, sum_and_maximum
from cortado.device.precision import Precision
from cortado.solvers.containment import Containment
from cortado.solvers.convergence import convergence_kernels
from cortado.solvers.solver import Counts


@dataclass(frozen=True)
class LoopLimits:
    """When a loop may stop."""

    minimum_iterations: int
    maximum_iterations: int
    tolerance: float
    """Bound on the average of the particles' errors."""
    greatest_tolerance: float
    """Bound on the maximum of the same; infinite where none is asked for."""


class LoopRecord:
    """What is noted of one loop in every step of a run, on the device until it is read."""

    def __init__(self, steps: int, loop: "Loop"):
        self.iterations = wp.zeros(max(steps, 1), dtype=wp.int32, device=loop.errors.device)
        """(steps,) on the device."""
        self.errors = wp.zeros(max(steps, 1), dtype=loop.errors.dtype, device=loop.errors.device)
        """(steps,) average and greatest error, on the device."""
        self._loop = loop
        self.diagnostics = self._named(np.zeros(0, dtype=int), np.zeros((0, 2)))
        """(steps,) by name, of the steps that were read."""

    def read(self, steps: int) -> None:
        """Read so many steps from the device."""
        iterations, errors = self.iterations.numpy()[:steps], self.errors.numpy()[:steps]
        self.diagnostics = self._named(iterations.astype(int), errors.astype(np.float64))

    def _named(self, iterations: NDArray, errors: NDArray) -> dict[str, NDArray]:
        loop, (average, greatest) = self._loop, errors.T
        return {
            loop.iterations_name: iterations,
            loop.errors_name: average,
            f"greatest_{loop.errors_name}": greatest,
        }

    @property
    def counts(self) -> NDArray:
        """(steps,) how often the loop went round."""
        return self.diagnostics[self._loop.iterations_name]

    @property
    def converged(self) -> NDArray:
        """(steps,) whether the errors came below the tolerances; always, with a fixed number of iterations."""
        limits, name = self._loop.limits, self._loop.errors_name
        average, greatest = self.diagnostics[name], self.diagnostics[f"greatest_{name}"]
        if limits is None or limits.minimum_iterations == limits.maximum_iterations:
            return np.ones(len(average), dtype=bool)
        return (average <= limits.tolerance) & (greatest <= limits.greatest_tolerance)


class IterationLog:
    """The records of a step's loops: a `StepLog`. A solver without loops has only to say that it converged."""

    def __init__(self, steps: int, loops: Sequence["Loop"]):
        self.records = tuple(LoopRecord(steps, loop) for loop in loops)
        self._steps = 0

    @property
    def diagnostics(self) -> dict[str, NDArray]:
        found: dict[str, NDArray] = {}
        converged = np.ones(self._steps, dtype=bool)
        for record in self.records:
            found |= record.diagnostics
            converged &= record.converged
        return {**found, "converged": converged}

    def read(self, steps: int) -> None:
        self._steps = steps
        for record in self.records:
            record.read(steps)

    def counts(self, step: int) -> Counts:
        return tuple(int(record.counts[step]) for record in self.records)


class Loop:
    """A loop over all particles, which the device ends."""

    def __init__(
        self,
        limits: LoopLimits | None,
        precision: Precision,
        launch: KernelLauncher,
        iterations_name: str = "iterations",
        errors_name: str = "density_errors",
    ):
        """``limits`` None: it never goes round. The names are those of the diagnostics of a run."""
        particles, device = launch.particles, launch.device
        self.limits, self.iterations_name, self.errors_name = limits, iterations_name, errors_name
        self.errors = wp.zeros(particles, dtype=precision.pair, device=device)
        """(n,) the error of a particle, twice (for a sum and a maximum): every iteration writes it."""
        self._launch, self._kernels = launch, convergence_kernels(precision)
        self._sum = sum_and_maximum(particles, precision, device)
        self._sums = wp.zeros(1, dtype=precision.pair, device=device)
        self._iteration, self._active = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))

    def reset(self) -> None:
        """Forget the count of a step that was interrupted."""
        self._iteration.zero_()

    def run(self, iterate: Callable[[int], None]) -> None:
        """Go round until the errors are small enough. ``iterate`` is given the number of the iteration, from 0; beyond
        the least number of them it is captured once, and always given that number."""
        limits = self.limits
        if limits is None:
            return
        for k in range(limits.minimum_iterations):
            iterate(k)
        self._decide(limits, limits.minimum_iterations)
        if limits.maximum_iterations > limits.minimum_iterations:

            def once_more() -> None:
                iterate(limits.minimum_iterations)
                self._decide(limits, 1)

            wp.capture_while(self._active, once_more)

    def note(self, record: LoopRecord, containment: Containment, step_number: wp.array, is_last: bool) -> None:
        """Record what the loop did in this step; the last loop of a step counts it."""
        self._launch(
            self._kernels.record,
            particles=self._launch.particles,
            is_last=int(is_last),
            sums=self._sums,
            bad=containment.bad_particle,
            step=step_number,
            iteration=self._iteration,
            bad_step=containment.bad_step,
            iterations=record.iterations,
            errors=record.errors,
            threads=1,
        )

    def _decide(self, limits: LoopLimits, done: int) -> None:
        self._sums = self._sum(self.errors)
        self._launch(
            self._kernels.decide,
            done=done,
            most=limits.maximum_iterations,
            particles=self._launch.particles,
            tolerance=limits.tolerance,
            greatest_tolerance=limits.greatest_tolerance,
            sums=self._sums,
            iteration=self._iteration,
            active=self._active,
            threads=1,
        )
