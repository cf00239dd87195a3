"""Flat walls that mirror the fluid: an image of particle j is what one of them mirrors, or two or three that meet.

A reflection has a bit for each wall: 1, 2 and 4 for those at the lower ends of the axes, 8, 16 and 32 for the upper
ones. It is x -> R x + o, with R diagonal. Seen from particle i, the image of j is where the image of i sees j, so that
every image that i can see is one of its neighbours, or its own. In lists of neighbours (`neighbours`) the image of j by
a reflection has the number ``REFLECTIONS j + reflection``. A wall mirrors what is in front of it, for what is in front
of it, and not a column that waits behind it to come out of an opening.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision

REFLECTIONS = 64
"""More than the bits of a reflection say."""


@cache
def mirror_functions(precision: Precision, neighbourhood: Any) -> dict[str, Any]:
    """Warp functions by name: ``near_mirrors`` and ``before_mirrors`` (the bits of the walls within reach of a
    position, on either side, and of those that it is in front of), ``reflects`` (whether bits are those of a reflection
    in some of them) and ``reflection`` (the diagonal of R, and o)."""
    real, vector = precision.real, precision.vector

    @wp.func
    def near_mirrors(x: vector, s: neighbourhood) -> int:
        found = int(0)
        for axis in range(3):
            if x[axis] - s.mirror_lower[axis] < s.reach:
                found = found | (1 << axis)
            if s.mirror_upper[axis] - x[axis] < s.reach:
                found = found | (8 << axis)
        return found

    @wp.func
    def before_mirrors(x: vector, s: neighbourhood) -> int:
        found = int(0)
        for axis in range(3):
            if x[axis] >= s.mirror_lower[axis]:
                found = found | (1 << axis)
            if x[axis] <= s.mirror_upper[axis]:
                found = found | (8 << axis)
        return found

    @wp.func
    def reflects(bits: int, near: int) -> bool:
        """A wall does not mirror what the one across from it does."""
        return (bits & near) == bits and (bits & (bits >> 3)) == 0

    @wp.func
    def reflection(bits: int, s: neighbourhood):
        flip, offset = vector(real(1.0), real(1.0), real(1.0)), vector()
        for axis in range(3):
            lower, upper = (bits >> axis) & 1, (bits >> (axis + 3)) & 1
            if lower + upper == 1:
                flip[axis] = real(-1.0)
                offset[axis] = real(2.0) * wp.where(lower == 1, s.mirror_lower[axis], s.mirror_upper[axis])
        return flip, offset

    return {
        "near_mirrors": near_mirrors,
        "before_mirrors": before_mirrors,
        "reflects": reflects,
        "reflection": reflection,
    }
