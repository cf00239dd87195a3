"""A wall without slip as a neighbour of a particle: at the point of its surface below the particle, and at rest.

With the normal n of the wall, the distance d of particle i from its surface, and a particle b of the wall at x_b,

    y_ib = d n,   s_w = w_b s_ib max(n . x_ib, 0) / max(d, e),

for the weight s_ib of two particles of the fluid (`cortado.sph.stress_kernels`), as if velocities went on behind the
wall with their sign turned (Morris, Fox and Zhu 1997). d is 0 behind the surface, and e is a distance, ``least``,
closer than which a wall pulls no harder. n . x_ib is below 0 where b belongs to the other side of a thin wall, or to
another face of an edge, and then b does not count: with a weight below 0 it would drive the particle on. At all three
the derivative has a corner. Functions know n by the ``foot``, the vector from x_b to the surface.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions


@dataclass(frozen=True)
class ContactFunctions:
    """Warp functions of x_ib and of a foot."""

    weight: Any
    """s of a separation of two particles, -V a of grad W = a x."""
    fall: Any
    """y"""
    fall_change: Any
    """The derivative of y along a change of x, which is symmetric."""
    hold: Any
    """s_w / w_b"""
    hold_gradient: Any
    """The gradient of s_w / w_b."""


@cache
def contact_functions(discretisation: Discretisation) -> ContactFunctions:
    """Of a discretisation."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    slope, slope_gradient = pair.slope, pair.slope_gradient

    @wp.func
    def weight(x: vector, s: neighbourhood) -> real:
        return -s.volume * slope(x, s)

    @wp.func
    def rise(x_ib: vector, foot: vector) -> real:
        """n . x_ib"""
        return wp.dot(x_ib, foot) / wp.length(foot)

    @wp.func
    def height(x_ib: vector, foot: vector) -> real:
        """d, negative behind the surface."""
        return rise(x_ib, foot) - wp.length(foot)

    @wp.func
    def fall(x_ib: vector, foot: vector) -> vector:
        return (wp.max(height(x_ib, foot), real(0.0)) / wp.length(foot)) * foot

    @wp.func
    def hold(x_ib: vector, foot: vector, least: real, s: neighbourhood) -> real:
        return weight(x_ib, s) * wp.max(rise(x_ib, foot), real(0.0)) / wp.max(height(x_ib, foot), least)

    @wp.func
    def fall_change(x_ib: vector, u: vector, foot: vector) -> vector:
        square = wp.dot(foot, foot)
        return wp.where(height(x_ib, foot) > real(0.0), wp.dot(u, foot) / square, real(0.0)) * foot

    @wp.func
    def hold_gradient(x_ib: vector, foot: vector, least: real, s: neighbourhood) -> vector:
        above, d = rise(x_ib, foot), height(x_ib, foot)
        if above <= real(0.0):
            return vector()
        per = real(1.0) / wp.max(d, least)
        along = weight(x_ib, s) * per * (real(1.0) - wp.where(d > least, above * per, real(0.0)))
        return (-s.volume * above * per) * slope_gradient(x_ib, s) + (along / wp.length(foot)) * foot

    return ContactFunctions(weight, fall, fall_change, hold, hold_gradient)
