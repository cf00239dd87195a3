"""How far particles are from where they should be."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision


@dataclass(frozen=True)
class MatchingKernels:
    """The kernels of distances to targets, particle by particle."""

    squared_distance: Any
    difference: Any


@cache
def matching_kernels(precision: Precision) -> MatchingKernels:
    """Kernels ``squared_distance`` (in float64) and ``difference`` (times a factor) of vectors from targets, which
    are the same for every scene of a batch."""
    real, vector = precision.real, precision.vector
    module = kernel_module(f"matching_{precision.name}")

    @wp.kernel(module=module, enable_backward=False)
    def squared_distance(
        x: wp.array(dtype=vector),
        target: wp.array(dtype=vector),
        # out
        squares: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        miss = wp.vec3d(x[i] - target[i % target.shape[0]])
        squares[i] = wp.dot(miss, miss)

    @wp.kernel(module=module, enable_backward=False)
    def difference(
        factor: real,
        x: wp.array(dtype=vector),
        target: wp.array(dtype=vector),
        # out
        bar: wp.array(dtype=vector),
    ):
        i = wp.tid()
        bar[i] = factor * (x[i] - target[i % target.shape[0]])

    return MatchingKernels(squared_distance=squared_distance, difference=difference)
