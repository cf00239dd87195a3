"""Rotations by rotation vectors, in the plane by angles, and how they change with these.

A rotation R(w) by the vector w turns by |w| about w (Rodrigues). Where w changes by w', it turns further by J(w) w':
R(w + w') = R(J(w) w') R(w) to first order, with

    J(w) = I + (1 - cos |w|) / |w|^2 [w] + (|w| - sin |w|) / |w|^3 [w]^2,

in which [w] u is the cross product w x u; J(w)^T is J(-w).
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.particles.moving_walls import matrix_of, turn_functions

SMALL = 1e-3
"""|w|^2 below which the factors of J are series, to which three terms are enough."""


@dataclass(frozen=True)
class Rotations:
    """Warp functions of rotations by angles, which are vectors in 3-D and numbers in 2-D."""

    angle: Any
    """The type of an angle."""
    rotation: Any
    """R(w), a 3 x 3 matrix, of which Warp knows the derivative by J."""


@cache
def rotations(precision: Precision, dimension: int) -> Rotations:
    """Make the Warp functions of rotations, in 2 or 3 dimensions."""
    real, vector, matrix = precision.real, precision.vector, matrix_of(precision)

    @wp.func
    def about_z(turn: real) -> matrix:
        c, s, no, one = wp.cos(turn), wp.sin(turn), real(0.0), real(1.0)
        return matrix(c, -s, no, s, c, no, no, no, one)

    @wp.func
    def rotation(turn: vector) -> matrix:
        size, no, one = wp.length(turn), real(0.0), real(1.0)
        unit = matrix(one, no, no, no, one, no, no, no, one)
        if size == real(0.0):
            return unit
        n = turn / size
        cross = matrix(no, -n[2], n[1], n[2], no, -n[0], -n[1], n[0], no)
        return unit + wp.sin(size) * cross + (real(1.0) - wp.cos(size)) * (cross * cross)

    @wp.func
    def further(turn: vector, change: vector) -> vector:
        square = wp.dot(turn, turn)
        a = real(0.5) - square / real(24.0) + square * square / real(720.0)
        b = real(1.0 / 6.0) - square / real(120.0) + square * square / real(5040.0)
        if square > real(SMALL):
            size = wp.sqrt(square)
            half = wp.sin(real(0.5) * size)
            a = real(2.0) * half * half / square
            b = (size - wp.sin(size)) / (square * size)
        across = wp.cross(turn, change)
        return change + a * across + b * wp.cross(turn, across)

    turning = turn_functions(precision)[0]

    @wp.func_grad(rotation)
    def rotation_adjoint(turn: vector, adj_ret: matrix):
        """Apply J(w)^T, which is J(-w): Warp's own adjoint would be 0 at 0."""
        wp.adjoint[turn] += further(-turn, turning(rotation(turn), adj_ret))

    return Rotations(real, about_z) if dimension == 2 else Rotations(vector, rotation)
