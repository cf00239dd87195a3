"""Flat walls that mirror the fluid: an image of particle j is what one of them mirrors, or two or three that meet.

A reflection has a bit for each wall: 1, 2 and 4 for those at the lower ends of the axes, 8, 16 and 32 for the upper
ones. It is x -> R x + o, with R diagonal. Seen from particle i, the image of j is where the image of i sees j, so that
every image that i can see is one of its neighbours, or its own.
"""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision


@cache
def mirror_functions(precision: Precision, neighbourhood: Any) -> dict[str, Any]:
    """Warp functions by name: ``near_mirrors`` (the bits of the walls within the support of a position), ``reflects``
    (whether bits are those of a reflection in some of them), ``flip_of`` (the diagonal of R), ``flip_of_six`` (what R
    does to a symmetric matrix) and ``mirrored`` (R x + o)."""
    real, vector, six = precision.real, precision.vector, precision.six

    @wp.func
    def near_mirrors(x: vector, s: neighbourhood) -> int:
        found = int(0)
        for axis in range(3):
            if x[axis] - s.mirror_lower[axis] < s.support:
                found = found | (1 << axis)
            if s.mirror_upper[axis] - x[axis] < s.support:
                found = found | (8 << axis)
        return found

    @wp.func
    def reflects(code: int, near: int) -> bool:
        """A wall does not mirror what the one across from it does."""
        return (code & near) == code and (code & (code >> 3)) == 0

    @wp.func
    def flip_of(code: int) -> vector:
        flip = vector(real(1.0), real(1.0), real(1.0))
        for axis in range(3):
            if (((code | (code >> 3)) >> axis) & 1) == 1:
                flip[axis] = real(-1.0)
        return flip

    @wp.func
    def flip_of_six(flip: vector) -> six:
        one = real(1.0)
        return six(one, one, one, flip[1] * flip[2], flip[0] * flip[2], flip[0] * flip[1])

    @wp.func
    def mirrored(x: vector, code: int, s: neighbourhood) -> vector:
        found = vector(x[0], x[1], x[2])
        for axis in range(3):
            if ((code >> axis) & 1) == 1:
                found[axis] = real(2.0) * s.mirror_lower[axis] - x[axis]
            if ((code >> (axis + 3)) & 1) == 1:
                found[axis] = real(2.0) * s.mirror_upper[axis] - x[axis]
        return found

    return {
        "near_mirrors": near_mirrors,
        "reflects": reflects,
        "flip_of": flip_of,
        "flip_of_six": flip_of_six,
        "mirrored": mirrored,
    }
