"""Kernels that take entries of particles from the scene's order to the sorted one, and back."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp


@dataclass(frozen=True)
class OrderKernels:
    """Kernels between the scene's order and the sorted one."""

    sort: Any
    unsort: Any


@cache
def order_kernels(dtype: Any, module: Any) -> OrderKernels:
    """The kernels for entries of a Warp type, in a Warp module."""

    @wp.kernel(module=module)
    def sort(
        order: wp.array(dtype=wp.int32),
        a_scene: wp.array(dtype=dtype),
        # out
        a: wp.array(dtype=dtype),
    ):
        i = wp.tid()
        a[i] = a_scene[order[i]]

    @wp.kernel(module=module)
    def unsort(
        order: wp.array(dtype=wp.int32),
        a: wp.array(dtype=dtype),
        # out
        a_scene: wp.array(dtype=dtype),
    ):
        i = wp.tid()
        a_scene[order[i]] = a[i]

    return OrderKernels(sort, unsort)
