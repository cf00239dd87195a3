"""The choice of the next time step, on the device: one thread for each scene of a batch."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision


@dataclass(frozen=True)
class StepSizeKernels:
    """The kernels that choose a time step. They have no derivatives: a chosen step is held constant."""

    speeds: Any
    """The square of each particle's speed."""
    choose: Any
    """The next time step of each scene."""


@cache
def step_size_kernels(precision: Precision) -> StepSizeKernels:
    """The kernels for a precision."""
    real, pair, vector = precision.real, precision.pair, precision.vector
    module = kernel_module(f"step_sizes_{precision.name}")

    @wp.kernel(module=module, enable_backward=False)
    def speeds(v: wp.array(dtype=vector), squares: wp.array(dtype=pair)):
        """As pairs, for a sum, which nobody reads, and a maximum."""
        i = wp.tid()
        squares[i] = pair(real(0.0), wp.length_sq(v[i]))

    @wp.kernel(module=module, enable_backward=False)
    def choose(
        length: real,
        least: real,
        growth: real,
        greatest: wp.array(dtype=pair),
        bounds: wp.array2d(dtype=real),
        first: wp.array(dtype=real),
        step: wp.array(dtype=wp.int32),
        # in and out
        times: wp.array2d(dtype=wp.float64),
        sizes: wp.array2d(dtype=real),
        # out
        longest: wp.array2d(dtype=real),
        time_step: wp.array(dtype=real),
    ):
        """dt = min(bound, max(length / max |v|, least bound), growth dt of the step before), and the time at which the
        step begins.

        ``length``: how far a particle may move in a step; ``first``: dt of the step before the first, 0 where there was
        none; ``longest`` is dt without it. Where no particle moves, nothing is divided by its speed. A speed that is
        not finite bounds nothing: its particle is lost, and the bound stands until the host has seen it.
        """
        b = wp.tid()
        n = step[b]
        dt = bounds[wp.min(n, bounds.shape[0] - 1), b]
        speed = wp.sqrt(greatest[b][1])
        if wp.isfinite(speed) and dt * speed > length:
            dt = wp.max(length / speed, least * dt)
        longest[n, b] = dt
        before = first[b]
        if n > 0:
            before = sizes[n - 1, b]
            times[n, b] = times[n - 1, b] + wp.float64(before)
        if before > real(0.0):
            dt = wp.min(dt, growth * before)
        sizes[n, b] = dt
        time_step[b] = dt

    return StepSizeKernels(speeds, choose)
