"""The kernels of what steps of the projection add to the compression of particles."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision


@dataclass(frozen=True)
class CompressionKernels:
    """They have no derivatives: a chosen step is held constant."""

    compare: Any
    """What a step adds to each particle's compression."""
    record: Any
    """The greatest of it in each scene."""


@cache
def compression_kernels(precision: Precision) -> CompressionKernels:
    """The kernels for a precision."""
    real, pair, vector = precision.real, precision.pair, precision.vector
    module = kernel_module(f"compressions_{precision.name}")

    @wp.kernel(module=module, enable_backward=False)
    def compare(
        particles: int,
        first_waiting: int,
        order: wp.array(dtype=wp.int32),
        n: wp.array(dtype=real),
        excess: wp.array(dtype=real),
        x_free: wp.array(dtype=vector),
        x: wp.array(dtype=vector),
        # out
        added: wp.array(dtype=pair),
    ):
        """``added`` is a pair for a sum, which nobody reads, and a maximum, of sorted particles: (n - 1)+ as the last
        repair finds it less the same before the step. What a nozzle leads, which is not where the step has left it and
        may be in walls, adds nothing."""
        i = wp.tid()
        more = wp.max(excess[i], real(0.0)) - wp.max(n[i] - real(1.0), real(0.0))
        p = order[i]
        let_go = bool(True)
        if p % particles >= first_waiting:
            let_go = x[p] == x_free[i]
        if not let_go:
            more = real(0.0)
        added[i] = pair(real(0.0), more)

    @wp.kernel(module=module, enable_backward=False)
    def record(
        greatest: wp.array(dtype=pair),
        step: wp.array(dtype=wp.int32),
        # out
        added: wp.array2d(dtype=real),
    ):
        b = wp.tid()
        added[step[b] - 1, b] = greatest[b][1]

    return CompressionKernels(compare, record)
