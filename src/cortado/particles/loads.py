"""Reading the entries of particles and of wall particles in a sum over neighbours.

They are read without the count from an array's end that Warp's own indices allow: a negative index takes a comparison
and an addition, for every neighbour and every array.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision


@dataclass(frozen=True)
class Loads:
    """Warp functions that read one element of an array, at indices that are not negative."""

    neighbour: Any
    """Reads a list [neighbour, particle]."""
    vector: Any
    """Reads an array of vectors, one after the other in memory."""
    number: Any
    """Reads an array of numbers, one after the other in memory."""
    six: Any
    """Reads an array of six numbers each, one after the other in memory: in three loads on a GPU, and not in six."""


@cache
def loads(precision: Precision, taped: bool) -> Loads:
    """Make the functions that read array elements in a precision; a tape can differentiate ``taped`` ones."""
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


@cache
def wall_functions(precision: Precision, taped: bool, neighbourhood: Any) -> dict[str, Any]:
    """Make Warp functions, by name, that read the data of a wall particle by its number b and the neighbourhood."""
    real, vector = precision.real, precision.vector
    load = loads(precision, taped)
    load_vector, load_number = load.vector, load.number

    @wp.func
    def wall_position(b: int, s: neighbourhood) -> vector:
        return load_vector(s.wall_positions, b)

    @wp.func
    def wall_weight(b: int, s: neighbourhood) -> real:
        return load_number(s.wall_weights, b)

    @wp.func
    def wall_grip(b: int, s: neighbourhood) -> real:
        return load_number(s.wall_grips, b)

    @wp.func
    def wall_foot(b: int, s: neighbourhood) -> vector:
        return load_vector(s.wall_feet, b)

    @wp.func
    def wall_velocity(b: int, s: neighbourhood) -> vector:
        return load_vector(s.wall_velocities, b)

    @wp.func
    def wall_solid(b: int, s: neighbourhood) -> int:
        return s.wall_solids[b]

    @wp.func
    def weight_in(b: int, solid: int, s: neighbourhood) -> real:
        weight = real(0.0)
        if s.wall_solids[b] == solid:
            weight = load_number(s.wall_weights, b)
        return weight

    @wp.func
    def wall_position_dot(b: int, s: neighbourhood) -> vector:
        return load_vector(s.wall_positions_dot, b)

    @wp.func
    def wall_velocity_dot(b: int, s: neighbourhood) -> vector:
        return load_vector(s.wall_velocities_dot, b)

    @wp.func
    def wall_turn_dot(b: int, s: neighbourhood) -> vector:
        return load_vector(s.wall_turns_dot, b)

    @wp.func
    def wall_growth_dot(b: int, s: neighbourhood) -> real:
        return load_number(s.wall_growths_dot, b)

    own = (wall_position, wall_weight, wall_grip, wall_foot, wall_velocity, wall_solid, weight_in)
    dots = (wall_position_dot, wall_velocity_dot, wall_turn_dot, wall_growth_dot)
    return {one.func.__name__: one for one in (*own, *dots)}
