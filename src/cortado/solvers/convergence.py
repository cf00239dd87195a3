"""Decisions of the loops of a step and records of them, taken on the device."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.solvers.containment_kernels import NO_PARTICLE

UNKNOWN = 2**31 - 1
"""What stands for the number of rounds of a loop before it is known."""


@dataclass(frozen=True)
class Measure:
    """What the errors of particles, in pairs, come to in a step."""

    columns: tuple[str, ...]
    """Names in the diagnostics of a run, made of that of the loop; the first is what a tolerance bounds."""
    is_weighted: bool
    """Whether a pair is a weighted square and its weight, of which the root of the mean is taken. Otherwise both are
    the error, of which the average and the maximum are."""


AVERAGE = Measure(("{}", "greatest_{}"), is_weighted=False)
ROOT_MEAN_SQUARE = Measure(("{}",), is_weighted=True)


@dataclass(frozen=True)
class ConvergenceKernels:
    """The kernels of one thread a scene that count iterations and steps."""

    decide: Any
    """Whether to go on iterating."""
    record: Any
    """A loop that has ended; the last one of a step ends the step."""
    count_step: Any
    """The end of a step without loops."""
    note: Any
    """The iterations that a force took in a step to solve its equations."""


@cache
def convergence_kernels(precision: Precision, measure: Measure = AVERAGE) -> ConvergenceKernels:
    """The kernels for a precision and what is measured."""
    real, pair = precision.real, precision.pair
    module = kernel_module(f"convergence_{precision.name}{'_weighted' * measure.is_weighted}")

    @wp.func
    def average_and_maximum(sums: pair, particles: int) -> pair:
        return pair(sums[0] / real(particles), sums[1])

    @wp.func
    def root_of_mean(sums: pair, particles: int) -> pair:
        """Without any weight, 0."""
        mean = real(0.0)
        if sums[1] != real(0.0):
            mean = sums[0] / sums[1]
        return pair(wp.sqrt(mean), real(0.0))

    reached = root_of_mean if measure.is_weighted else average_and_maximum

    @wp.kernel(module=module, enable_backward=False)
    def decide(
        done: int,
        most: int,
        particles: int,
        tolerance: real,
        greatest_tolerance: real,
        sums: wp.array(dtype=pair),
        # in and out
        iteration: wp.array(dtype=wp.int32),
        rounds: wp.array(dtype=wp.int32),
        active: wp.array(dtype=wp.int32),
    ):
        """``done`` iterations are added to the count of each scene that has not come to an end; ``rounds`` becomes
        known where the error is below the tolerances, and ``active`` counts the scenes where it is not."""
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

    @wp.kernel(module=module, enable_backward=False)
    def record(
        particles: int,
        undecided: int,
        is_last: int,
        sums: wp.array(dtype=pair),
        bad: wp.array(dtype=wp.int32),
        # in and out
        step: wp.array(dtype=wp.int32),
        iteration: wp.array(dtype=wp.int32),
        bad_step: wp.array(dtype=wp.int32),
        # out
        rounds: wp.array(dtype=wp.int32),
        active: wp.array(dtype=wp.int32),
        iterations: wp.array2d(dtype=wp.int32),
        errors: wp.array2d(dtype=pair),
    ):
        """Record the loop's iterations, those that were ``undecided`` included, and what its errors come to, and after
        the last loop count the step. The next loop begins with all scenes."""
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

    @wp.kernel(module=module, enable_backward=False)
    def count_step(
        bad: wp.array(dtype=wp.int32),
        # in and out
        bad_step: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int32),
    ):
        end_step(wp.tid(), bad, bad_step, step)

    @wp.kernel(module=module, enable_backward=False)
    def note(
        count: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int32),
        # out
        iterations: wp.array2d(dtype=wp.int32),
    ):
        b = wp.tid()
        iterations[step[b], b] = count[b]

    return ConvergenceKernels(decide, record, count_step, note)
