"""Decisions of the loops of a step and records of them, taken on the device."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.solvers.containment_kernels import NO_PARTICLE


@dataclass(frozen=True)
class ConvergenceKernels:
    """The kernels of one thread that count iterations and steps."""

    decide: Any
    """Whether to go on iterating."""
    record: Any
    """A loop that has ended; the last one of a step ends the step."""
    count_step: Any
    """The end of a step without loops."""


@cache
def convergence_kernels(precision: Precision) -> ConvergenceKernels:
    """The kernels for a precision."""
    real, pair = precision.real, precision.pair
    module = wp.get_module(f"cortado_convergence_{precision.name}")
    module.options["enable_backward"] = False

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
        # out
        active: wp.array(dtype=wp.int32),
    ):
        """``done`` iterations are added to the count; ``active`` stays 1 while the error is above a tolerance."""
        count = iteration[0] + done
        average = sums[0][0] / real(particles)
        iteration[0] = count
        active[0] = wp.where(count < most and (average > tolerance or sums[0][1] > greatest_tolerance), 1, 0)

    @wp.func
    def end_step(bad: wp.array(dtype=wp.int32), bad_step: wp.array(dtype=wp.int32), step: wp.array(dtype=wp.int32)):
        if bad[0] != wp.static(NO_PARTICLE) and bad_step[0] < 0:
            bad_step[0] = step[0]
        step[0] = step[0] + 1

    @wp.kernel(module=module, enable_backward=False)
    def record(
        particles: int,
        is_last: int,
        sums: wp.array(dtype=pair),
        bad: wp.array(dtype=wp.int32),
        # in and out
        step: wp.array(dtype=wp.int32),
        iteration: wp.array(dtype=wp.int32),
        bad_step: wp.array(dtype=wp.int32),
        # out
        iterations: wp.array(dtype=wp.int32),
        errors: wp.array(dtype=pair),
    ):
        """Record the loop's iterations and its (average, greatest) error, and after the last loop count the step."""
        n = step[0]
        iterations[n] = iteration[0]
        errors[n] = pair(sums[0][0] / real(particles), sums[0][1])
        iteration[0] = 0
        if is_last != 0:
            end_step(bad, bad_step, step)

    @wp.kernel(module=module, enable_backward=False)
    def count_step(
        bad: wp.array(dtype=wp.int32),
        # in and out
        bad_step: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int32),
    ):
        end_step(bad, bad_step, step)

    return ConvergenceKernels(decide, record, count_step)
