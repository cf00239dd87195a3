"""Roots and reciprocals for pairs of particles: in CUDA and float32 the GPU's own, within 2 units in the last place.

Those of IEEE 754 take a GPU some ten instructions each, and a branch for numbers that are next to 0 or infinite. What
pairs hand over is not: squares of distances have a floor (`cortado.discretise.smoothing_functions`), and all else is
positive.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import FLOAT32, Precision


@dataclass(frozen=True)
class Arithmetic:
    """Warp functions of a positive number that is neither subnormal nor infinite."""

    root: Any
    inverse_root: Any
    reciprocal: Any


@cache
def arithmetic(precision: Precision, taped: bool) -> Arithmetic:
    """The functions of a precision; a tape can differentiate ``taped`` ones, which round as IEEE 754 asks for."""
    return _of_the_gpu() if precision == FLOAT32 and not taped else _plain(precision)


def _plain(precision: Precision) -> Arithmetic:
    real = precision.real

    @wp.func
    def root(x: real) -> real:
        return wp.sqrt(x)

    @wp.func
    def inverse_root(x: real) -> real:
        return real(1.0) / wp.sqrt(x)

    @wp.func
    def reciprocal(x: real) -> real:
        return real(1.0) / x

    return Arithmetic(root, inverse_root, reciprocal)


def _of_the_gpu() -> Arithmetic:
    """For the CPU these are as the plain ones."""

    def native(cuda: str, cpu: str) -> str:
        return f"\n#if defined(__CUDA_ARCH__)\n{cuda}\n#else\n{cpu}\n#endif\n"

    approximate = 'float y; asm("{}.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x)); return {};'

    @wp.func_native(native(approximate.format("rsqrt", "x * y"), "return sqrtf(x);"))
    def root(x: wp.float32) -> wp.float32: ...

    @wp.func_native(native(approximate.format("rsqrt", "y"), "return 1.0f / sqrtf(x);"))
    def inverse_root(x: wp.float32) -> wp.float32: ...

    @wp.func_native(native(approximate.format("rcp", "y"), "return 1.0f / x;"))
    def reciprocal(x: wp.float32) -> wp.float32: ...

    return Arithmetic(root, inverse_root, reciprocal)
