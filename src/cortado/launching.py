"""Launches over particles, and sums over particles in a fixed order."""

from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

from cortado.physics.reduction import reduction_kernels
from cortado.precision import Precision

BRANCHES = 32
"""Values that one thread of a tree sum adds up."""


class Launcher:
    """Launches kernels with one thread a particle on one device."""

    def __init__(self, particles: int, device: Any, record_tape: bool):
        """``record_tape`` False keeps launches off a tape that a user may have open."""
        self.particles, self.device, self._record_tape = particles, device, record_tape

    def __call__(self, kernel: Any, inputs: Sequence[Any], outputs: Sequence[Any], threads: int | None = None) -> None:
        wp.launch(
            kernel,
            threads or self.particles,
            inputs=inputs,
            outputs=outputs,
            device=self.device,
            record_tape=self._record_tape,
        )


class Replayed:
    """Work that is done over and over with the same arrays: a captured graph from the second time on.

    The first time loads modules and allocates what a capture must not. On a CPU a graph saves the packing of arguments:
    half of the time with a hundred particles.
    """

    def __init__(self, work: Callable[[], None], device: Any):
        self._work, self._device = work, device
        self._warm, self._graph = False, None

    def __call__(self) -> None:
        if not self._warm:
            self._work()
            self._warm = True
            return
        if self._graph is None:
            with wp.ScopedCapture(device=self._device) as capture:
                self._work()
            self._graph = capture.graph
        wp.capture_launch(self._graph)


class TreeSum:
    """Adds one value of each particle on the device, in the same order every time."""

    def __init__(self, kernel: Any, dtype: Any, particles: int, device: Any):
        self._kernel, self._device = kernel, device
        self._levels: list[wp.array] = []
        size = particles
        while size > 1 or not self._levels:
            size = -(-size // BRANCHES)
            self._levels.append(wp.zeros(size, dtype=dtype, device=device))

    def __call__(self, values: wp.array) -> wp.array:
        """The sum as an array (1,), which the next call overwrites."""
        for partial in self._levels:
            wp.launch(
                self._kernel,
                partial.shape[0],
                inputs=[values.shape[0], partial.shape[0], values],
                outputs=[partial],
                device=self._device,
                record_tape=False,
            )
            values = partial
        return values


def vector_sum(particles: int, precision: Precision, device: Any) -> TreeSum:
    """Sums of vectors (n,)."""
    return TreeSum(reduction_kernels(precision).sum, precision.vector, particles, device)


def sum_and_maximum(particles: int, precision: Precision, device: Any) -> TreeSum:
    """Sums of first and maxima of second components of pairs (n,)."""
    return TreeSum(reduction_kernels(precision).sum_and_maximum, precision.pair, particles, device)
