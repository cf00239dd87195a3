"""What Python's operators mean that Warp has another meaning for, as functions of Warp, in a precision."""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision

REMAINDER, QUOTIENT, NEAREST, WHOLE = "cortado_remainder", "cortado_quotient", "cortado_nearest", "cortado_whole"
"""What compiled texts call a % b, a // b, round(a) and int(a)."""


@cache
def meanings(precision: Precision) -> dict[str, Any]:
    """By these names. Of a % b, which has the sign of b, and of a // b the bits are those of CPython."""
    real, module = precision.real, kernel_module(f"python_{precision.name}")
    none, one, half = (wp.constant(real(value)) for value in (0.0, 1.0, 0.5))

    @wp.func(module=module)
    def quotient(a: real, b: real) -> real:
        left = wp.mod(a, b)
        ratio = (a - left) / b
        if left != none and (left < none) != (b < none):
            ratio = ratio - one
        whole = wp.floor(ratio)
        if ratio - whole > half:
            whole = whole + one
        return whole

    @wp.func(module=module)
    def remainder(a: real, b: real) -> real:
        left = wp.mod(a, b)
        if left != none and (left < none) != (b < none):
            left = left + b
        return left

    @wp.func_grad(remainder)
    def adjoint_of_remainder(a: real, b: real, left_bar: real):
        wp.adjoint[a] += left_bar
        wp.adjoint[b] -= quotient(a, b) * left_bar

    return {REMAINDER: remainder, QUOTIENT: quotient, NEAREST: wp.rint, WHOLE: wp.trunc}
