"""How the state of a free body says that it is turned, and the angular velocities that follow from angular momenta.

A body's rotation is R = Q R(w_0) for the rotation w_0 that it began with. A state has how far the ends of the three
unit axes of its frame have moved since, the columns of Q - I, of which derivatives are taken by the vector w' of a
further turn: columns q change by w' x q, and an adjoint t of w' is one of columns, t x q / 2.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.particles.moving_walls import matrix_of
from cortado.sph.rotations import rotations


@dataclass(frozen=True)
class FreeFunctions:
    """The bundle of a body's state, and Warp functions of scene b."""

    state: Any
    """position, turn_x, turn_y, turn_z, rotation, velocity and angular_velocity"""
    about: Any
    """The vector of an angle, or of an angular velocity."""
    angle_of: Any
    """The other way."""
    attitude: Any
    """Q"""
    column: Any
    """Of a matrix."""
    evened: Any
    """Q - I of a Q, of which round-off is taken that makes its axes longer or lets them lean."""
    twist: Any
    """The adjoint of a further turn of Q for that of a state; of a tangent twice the turn."""
    write_twist: Any
    """The adjoint of a state for that of a further turn of Q."""


def free_module(precision: Precision) -> Any:
    """The Warp module of kernels of free bodies that need no smoothing kernel."""
    return kernel_module(f"free_bodies_derivative_{precision.name}")


@cache
def rate_function(precision: Precision) -> Any:
    """The Warp function R A R^T w of matrices R and A and a vector w."""
    vector, matrix = precision.vector, matrix_of(precision)

    @wp.func
    def rate(R: matrix, A: matrix, w: vector) -> vector:
        return R * (A * (wp.transpose(R) * w))

    return rate


@cache
def free_functions(precision: Precision, dimension: int) -> FreeFunctions:
    """In 2 or 3 dimensions."""
    real, vector, matrix = precision.real, precision.vector, matrix_of(precision)
    angle = rotations(precision, dimension).angle
    axes = dict.fromkeys(("turn_x", "turn_y", "turn_z"), vector)
    state = bundle(position=vector, **axes, rotation=angle, velocity=vector, angular_velocity=angle)

    if dimension == 2:

        @wp.func
        def about(w: angle) -> vector:
            return vector(real(0.0), real(0.0), w)

        @wp.func
        def angle_of(w: vector) -> angle:
            return w[2]

    else:

        @wp.func
        def about(w: angle) -> vector:
            return w

        @wp.func
        def angle_of(w: vector) -> angle:
            return w

    @wp.func
    def unit() -> matrix:
        one, no = real(1.0), real(0.0)
        return matrix(one, no, no, no, one, no, no, no, one)

    @wp.func
    def attitude(b: int, of: state) -> matrix:
        return unit() + wp.matrix_from_cols(of.turn_x[b], of.turn_y[b], of.turn_z[b])

    @wp.func
    def column(Q: matrix, k: int) -> vector:
        return vector(Q[0, k], Q[1, k], Q[2, k])

    @wp.func
    def evened(Q: matrix) -> matrix:
        return real(0.5) * Q * (real(3.0) * unit() - wp.transpose(Q) * Q) - unit()

    @wp.func
    def twist(b: int, Q: matrix, bar: state) -> vector:
        x, y = wp.cross(column(Q, 0), bar.turn_x[b]), wp.cross(column(Q, 1), bar.turn_y[b])
        return x + y + wp.cross(column(Q, 2), bar.turn_z[b])

    @wp.func
    def write_twist(b: int, Q: matrix, t: vector, bar: state):
        bar.turn_x[b] = real(0.5) * wp.cross(t, column(Q, 0))
        bar.turn_y[b] = real(0.5) * wp.cross(t, column(Q, 1))
        bar.turn_z[b] = real(0.5) * wp.cross(t, column(Q, 2))

    return FreeFunctions(state, about, angle_of, attitude, column, evened, twist, write_twist)
