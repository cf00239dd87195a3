"""Sums over particles in a fixed order: a tree of partial sums, so that the same bits come back every time.

Each scene of a batch has ``count`` values, one scene behind the other, which ``stride`` threads add up.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision


def type_name(dtype: Any) -> str:
    """Of a number, vector or matrix type, to tell their modules apart."""
    shape = getattr(dtype, "_shape_", ())
    return "_".join([getattr(dtype, "_wp_scalar_type_", dtype).__name__, *map(str, shape)])


@cache
def sum_kernel(dtype: Any) -> Any:
    """Sums of numbers, vectors or matrices of one type: of each scene partial[t] from values t, t + T, t + 2 T, ..."""
    module = wp.get_module(f"cortado_sum_{type_name(dtype)}")
    module.options["enable_backward"] = False

    @wp.kernel(module=module, enable_backward=False)
    def add(count: int, stride: int, values: wp.array(dtype=dtype), partial: wp.array(dtype=dtype)):
        t = wp.tid() % stride
        first = wp.tid() // stride * count
        total = values[first + t]
        for k in range(t + stride, count, stride):
            total += values[first + k]
        partial[wp.tid()] = total

    return add


@cache
def sum_and_maximum_kernel(precision: Precision) -> Any:
    """Sums of the first and maxima of the second components of pairs, in the same way."""
    pair = precision.pair
    module = wp.get_module(f"cortado_sum_and_maximum_{precision.name}")
    module.options["enable_backward"] = False

    @wp.kernel(module=module, enable_backward=False)
    def sum_and_maximum(count: int, stride: int, values: wp.array(dtype=pair), partial: wp.array(dtype=pair)):
        t = wp.tid() % stride
        first = wp.tid() // stride * count
        total = values[first + t][0]
        largest = values[first + t][1]
        for k in range(t + stride, count, stride):
            total += values[first + k][0]
            largest = wp.max(largest, values[first + k][1])
        partial[wp.tid()] = pair(total, largest)

    return sum_and_maximum


@cache
def add_kernel(dtype: Any) -> Any:
    """total += value, element by element."""
    module = wp.get_module(f"cortado_add_{type_name(dtype)}")
    module.options["enable_backward"] = False

    @wp.kernel(module=module, enable_backward=False)
    def accumulate(value: wp.array(dtype=dtype), total: wp.array(dtype=dtype)):
        i = wp.tid()
        total[i] = total[i] + value[i]

    return accumulate
