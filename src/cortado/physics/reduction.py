"""Sums over particles in a fixed order: a tree of partial sums, so that the same bits come back every time."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.precision import Precision


@cache
def reduction_kernels(precision: Precision) -> SimpleNamespace:
    """Kernels ``sum`` (vectors) and ``sum_and_maximum`` (pairs): partial[t] from values t, t + T, t + 2 T, ..."""
    vector, pair = precision.vector, precision.pair
    module = wp.get_module(f"cortado_reduction_{precision.name}")
    module.options["enable_backward"] = False

    @wp.kernel(module=module, enable_backward=False)
    def vector_sum(count: int, stride: int, values: wp.array(dtype=vector), partial: wp.array(dtype=vector)):
        t = wp.tid()
        total = vector()
        for k in range(t, count, stride):
            total += values[k]
        partial[t] = total

    @wp.kernel(module=module, enable_backward=False)
    def sum_and_maximum(count: int, stride: int, values: wp.array(dtype=pair), partial: wp.array(dtype=pair)):
        t = wp.tid()
        total = values[t][0]
        largest = values[t][1]
        for k in range(t + stride, count, stride):
            total += values[k][0]
            largest = wp.max(largest, values[k][1])
        partial[t] = pair(total, largest)

    return SimpleNamespace(sum=vector_sum, sum_and_maximum=sum_and_maximum)


@cache
def number_sum_kernel() -> Any:
    """The same for numbers in float64."""
    module = wp.get_module("cortado_reduction_numbers")
    module.options["enable_backward"] = False

    @wp.kernel(module=module, enable_backward=False)
    def number_sum(count: int, stride: int, values: wp.array(dtype=wp.float64), partial: wp.array(dtype=wp.float64)):
        t = wp.tid()
        total = wp.float64(0.0)
        for k in range(t, count, stride):
            total += values[k]
        partial[t] = total

    return number_sum
