"""Sums over particles in a fixed order, so that repeated runs give the same bits.

A reduction first combines the values of each scene into a few partial values. Each partial value is computed by one
thread on a CPU and by one block of threads on a GPU.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import launch
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision

BRANCHES = 32
BLOCK = 1024
EACH = 8
SHARED = 32 * 1024
"""Greatest shared memory of a block of GPU threads [bytes]."""


@dataclass(frozen=True)
class ReductionKernel:
    kernel: Any
    threads: int
    most: int


def type_name(dtype: Any) -> str:
    shape = getattr(dtype, "_shape_", ())
    return "_".join([getattr(dtype, "_wp_scalar_type_", dtype).__name__, *map(str, shape)])


@cache
def sum_kernel(dtype: Any, is_cpu: bool) -> ReductionKernel:

    @wp.func
    def plus(a: dtype, b: dtype) -> dtype:
        return a + b

    return _of_threads("sum", dtype, plus) if is_cpu else _of_blocks("sum", dtype, "a + b")


@cache
def sum_and_maximum_kernel(precision: Precision, is_cpu: bool) -> ReductionKernel:
    pair = precision.pair

    @wp.func
    def sum_and_maximum(a: pair, b: pair) -> pair:
        return pair(a[0] + b[0], wp.max(a[1], b[1]))

    if is_cpu:
        return _of_threads("sum_and_maximum", pair, sum_and_maximum)
    return _of_blocks("sum_and_maximum", pair, "T(a[0] + b[0], wp::max(a[1], b[1]))")


def _of_threads(name: str, dtype: Any, combine: Any) -> ReductionKernel:
    def reduce(count: int, stride: int, values: wp.array(dtype=dtype), partial: wp.array(dtype=dtype)):
        t = wp.tid() % stride
        first = wp.tid() // stride * count
        total = values[first + t]
        for k in range(t + stride, count, stride):
            total = combine(total, values[first + k])
        partial[wp.tid()] = total

    return ReductionKernel(_kernel(name, f"{name}_{type_name(dtype)}", reduce), 1, BRANCHES)


def _of_blocks(name: str, dtype: Any, combine: str) -> ReductionKernel:
    """``combine`` is a C++ expression in a and b."""
    threads = BLOCK
    while threads * wp.types.type_size_in_bytes(dtype) > SHARED:
        threads //= 2

    @wp.func_native(f"""
        auto total = values.data[0];
        typedef decltype(total) T;
        auto combine = [](const T& a, const T& b) -> T {{ return {combine}; }};
        __shared__ alignas(16) char shared[sizeof(T) * {threads}];
        T* room = reinterpret_cast<T*>(shared);
        const long long t = threadIdx.x, part = blockIdx.x % stride, first = blockIdx.x / stride * (long long)count;
        const long long own = part * {threads} + t;
        if (own < count) total = values.data[first + own];
        for (long long k = own + (long long)stride * {threads}; k < count; k += (long long)stride * {threads})
            total = combine(total, values.data[first + k]);
        room[t] = total;
        const long long there = count - part * {threads} < {threads} ? count - part * {threads} : {threads};
        for (int half = {threads // 2}; half > 0; half /= 2) {{
            __syncthreads();
            if (t < half && t + half < there) room[t] = combine(room[t], room[t + half]);
        }}
        if (t == 0) partial.data[blockIdx.x] = room[0];
    """)
    def block(count: wp.int32, stride: wp.int32, values: wp.array(dtype=dtype), partial: wp.array(dtype=dtype)): ...

    def reduce(count: int, stride: int, values: wp.array(dtype=dtype), partial: wp.array(dtype=dtype)):
        block(count, stride, values, partial)

    kernel = _kernel(name, f"{name}_{type_name(dtype)}_blocks", reduce, grid_stride=False)
    kernel.module.options["block_dim"] = threads
    return ReductionKernel(kernel, threads, threads * EACH)


def _kernel(name: str, module_name: str, function: Any, **options: Any) -> Any:
    module = kernel_module(module_name)
    function.__qualname__ = name
    return wp.kernel(function, module=module, enable_backward=False, **options)


@cache
def add_kernel(dtype: Any) -> Any:
    @wp.kernel(module=kernel_module(f"add_{type_name(dtype)}"), enable_backward=False)
    def accumulate(value: wp.array(dtype=dtype), total: wp.array(dtype=dtype)):
        i = wp.tid()
        total[i] = total[i] + value[i]

    return accumulate


class TreeReduction:
    """A reduction of values (members * n,) to one value per scene, in a fixed order."""

    def __init__(self, level: ReductionKernel, dtype: Any, particles: int, device: Any, members: int = 1):
        self._level, self._device, self._particles = level, device, particles
        self._partials: list[tuple[int, wp.array]] = []
        size = particles
        while size > 1 or not self._partials:
            size = -(-size // level.most)
            self._partials.append((size, wp.zeros(members * size, dtype=dtype, device=device)))

    def __call__(self, values: wp.array) -> wp.array:
        """Return the reduced values (members,). The next call overwrites the result."""
        count, level, device = self._particles, self._level, self._device
        for size, sums in self._partials:
            arguments = {"count": count, "stride": size, "values": values, "partial": sums}
            launch(level.kernel, len(sums) * level.threads, device, block=level.threads, **arguments)
            count, values = size, sums
        return values


def sum_of(dtype: Any, particles: int, device: Any, members: int = 1) -> TreeReduction:
    return TreeReduction(sum_kernel(dtype, device.is_cpu), dtype, particles, device, members)


def sum_and_maximum(particles: int, precision: Precision, device: Any, members: int = 1) -> TreeReduction:
    """Return a reduction of pairs to the sum of first components and the maximum of second components."""
    level = sum_and_maximum_kernel(precision, device.is_cpu)
    return TreeReduction(level, precision.pair, particles, device, members)


def add(values: wp.array, total: wp.array) -> None:
    launch(add_kernel(values.dtype), len(values), values.device, value=values, total=total)
