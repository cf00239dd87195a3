"""What a sum over neighbours reads, without the count from an array's end that Warp's own indices allow: a negative
index takes a comparison and an addition, for every neighbour and every array."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision


@dataclass(frozen=True)
class Loads:
    """Warp functions that read one element, at indices that are not negative."""

    neighbour: Any
    """Of a list [neighbour, particle]."""
    vector: Any
    """Of an array of vectors, one after the other in memory."""
    number: Any
    """Of an array of numbers, one after the other in memory."""
    six: Any
    """Of an array of six numbers each, one after the other in memory: in three loads on a GPU, and not in six."""


@cache
def loads(precision: Precision, taped: bool) -> Loads:
    """The functions of a precision; a tape can differentiate ``taped`` ones."""
    return _of_warp(precision) if taped else _direct(precision)


def _of_warp(precision: Precision) -> Loads:
    real, vector, six = precision.real, precision.vector, precision.six

    @wp.func
    def neighbour(lists: wp.array2d(dtype=wp.int32), k: int, i: int) -> int:
        return lists[k, i]

    @wp.func
    def load_vector(a: wp.array(dtype=vector), j: int) -> vector:
        return a[j]

    @wp.func
    def load_number(a: wp.array(dtype=real), j: int) -> real:
        return a[j]

    @wp.func
    def load_six(a: wp.array(dtype=six), j: int) -> six:
        return a[j]

    return Loads(neighbour, load_vector, load_number, load_six)


def _direct(precision: Precision) -> Loads:
    real, vector, six = precision.real, precision.vector, precision.six
    two = {4: "float2", 8: "double2"}[precision.bytes]
    by_two = f"const {two}* p = (const {two}*)(a.data + j); {two} u = p[0], v = p[1], w = p[2]; "
    by_two += "return {{u.x, u.y, v.x, v.y, w.x, w.y}};"
    place = "(long long)i * lists.strides[1] + (long long)k * lists.strides[0]"

    @wp.func_native(f"return *(const int*)((const char*)lists.data + {place});")
    def neighbour(lists: wp.array2d(dtype=wp.int32), k: int, i: int) -> int: ...

    @wp.func_native("return a.data[j];")
    def load_vector(a: wp.array(dtype=vector), j: int) -> vector: ...

    @wp.func_native("return a.data[j];")
    def load_number(a: wp.array(dtype=real), j: int) -> real: ...

    @wp.func_native(f"#if defined(__CUDA_ARCH__)\n{by_two}\n#else\nreturn a.data[j];\n#endif\n")
    def load_six(a: wp.array(dtype=six), j: int) -> six: ...

    return Loads(neighbour, load_vector, load_number, load_six)
