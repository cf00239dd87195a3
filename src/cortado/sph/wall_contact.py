"""A wall without slip as a neighbour of a particle: at the point of its surface below the particle, and at rest.

With the normal n of the wall, the distance d of particle i from its surface, and a particle b of the wall at x_b,

    y_ib = d n,   s_w = w_b s_ib (n . x_ib) / max(d, e),

for the weight s_ib of two particles of the fluid (`cortado.sph.stress_kernels`), as if velocities went on behind the
wall with their sign turned (Morris, Fox and Zhu 1997). d is 0 behind the surface, and e is a distance, ``least``,
closer than which a wall pulls no harder; at both the derivative has a corner. Functions know n by the ``foot``, the
vector from x_b to the surface.
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
    def height(x_ib: vector, foot: vector) -> real:
        """d, negative behind the surface."""
        depth = wp.length(foot)
        return wp.dot(x_ib, foot) / depth - depth

    @wp.func
    def fall(x_ib: vector, foot: vector) -> vector:
        return (wp.max(height(x_ib, foot), real(0.0)) / wp.length(foot)) * foot

    @wp.func
    def hold(x_ib: vector, foot: vector, least: real, s: neighbourhood) -> real:
        d = height(x_ib, foot)
        return weight(x_ib, s) * (d + wp.length(foot)) / wp.max(d, least)

    @wp.func
    def fall_change(x_ib: vector, u: vector, foot: vector) -> vector:
        square = wp.dot(foot, foot)
        return wp.where(height(x_ib, foot) > real(0.0), wp.dot(u, foot) / square, real(0.0)) * foot

    @wp.func
    def hold_gradient(x_ib: vector, foot: vector, least: real, s: neighbourhood) -> vector:
        depth, d = wp.length(foot), height(x_ib, foot)
        per = real(1.0) / wp.max(d, least)
        along = weight(x_ib, s) * per * (real(1.0) - wp.where(d > least, (d + depth) * per, real(0.0)))
        return (-s.volume * (d + depth) * per) * slope_gradient(x_ib, s) + (along / depth) * foot

    return ContactFunctions(weight, fall, fall_change, hold, hold_gradient)
