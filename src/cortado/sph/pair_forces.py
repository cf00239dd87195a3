"""The viscous force of a pair, phi(x, v) = B G with B = v . x / (|x|^2 + 0.01 h^2) (Monaghan 2005), as functions of
Warp."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.particles.neighbourhood import Discretisation, neighbourhood_type, pair_functions


@dataclass(frozen=True)
class PairForce:
    """phi(x, v) with its derivatives, functions of Warp."""

    force: Any
    tangent: Any
    adjoint_x: Any
    """The transposed derivative with respect to x, applied to a vector."""
    adjoint_v: Any
    """The same with respect to v."""


@cache
def pairwise(discretisation: Discretisation) -> PairForce:
    """phi: ``force``, ``tangent``, and the transposed derivatives ``adjoint_x``, ``adjoint_v``."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    neighbourhood = neighbourhood_type(discretisation.precision)
    pair = pair_functions(discretisation)
    slope, slope_change, per_size = pair.slope, pair.slope_change, pair.per_size

    @wp.func
    def force(x: vector, v: vector, s: neighbourhood) -> vector:
        return (wp.dot(v, x) * per_size(x, s) * slope(x, s)) * x

    @wp.func
    def tangent(x: vector, v: vector, x_dot: vector, v_dot: vector, s: neighbourhood) -> vector:
        per_d = per_size(x, s)
        a = slope(x, s)
        b = wp.dot(v, x) * per_d
        b_dot = (wp.dot(v_dot, x) + wp.dot(v, x_dot) - real(2.0) * b * wp.dot(x, x_dot)) * per_d
        return (b_dot * a + b * slope_change(x, x_dot, s)) * x + (b * a) * x_dot

    @wp.func
    def adjoint_x(x: vector, v: vector, w: vector, s: neighbourhood) -> vector:
        a = slope(x, s)
        b = wp.dot(v, x) * per_size(x, s)
        t = a * per_size(x, s) * wp.dot(x, w)
        return (b * a) * w + t * v + (b * (slope_change(x, w, s) - real(2.0) * t)) * x

    @wp.func
    def adjoint_v(x: vector, v: vector, w: vector, s: neighbourhood) -> vector:
        return (slope(x, s) * per_size(x, s) * wp.dot(x, w)) * x

    return PairForce(force, tangent, adjoint_x, adjoint_v)
