"""The rotation and the motion of free rigid bodies.

A body's rotation is R = Q R(w_0) for the rotation w_0 that it began with. A state has how far the ends of the three
unit axes of its frame have moved since, the columns of Q - I.

A step has kernels with a thread for each scene. In it a body with the density rho is at c, turned by R. It has the
velocities V and W and the angular momentum L = rho R I R^T W, for its inertia I at a density of 1; volumes are in those
of a particle. A step begins by where it would go, c' = c + dt V and R' = R(dt W) R, where its walls are. What fluid,
gravity and contact give it leads to V_1 and L_1. It ends at c + dt V_1, turned by R(dt W_1) R, with W_1 = R' I^-1 R'^T
L_1 / rho. It turns with the angular velocity that L_1 gives it there, so that both momenta are kept.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import Kernels, kernel_module
from cortado.device.precision import Precision
from cortado.particles.moving_walls import matrix_of
from cortado.particles.particle_kernels import pointwise_kernels
from cortado.sph.rotations import rotations


def free_module(precision: Precision) -> Any:
    """Return the Warp module of kernels of free bodies that need no smoothing kernel."""
    return kernel_module(f"free_bodies_derivative_{precision.name}")


@cache
def rate_function(precision: Precision) -> Any:
    """Make the Warp function R A R^T w of matrices R and A and a vector w."""
    vector, matrix = precision.vector, matrix_of(precision)

    @wp.func
    def rate(R: matrix, A: matrix, w: vector) -> vector:
        return R * (A * (wp.transpose(R) * w))

    return rate


@dataclass(frozen=True)
class FreeKernels:
    """Kernels of one free body's motion in a step, with a thread for each scene."""

    predict: Kernels
    """The pose in which its walls are, and V, W and L."""
    end: Kernels
    """The state after the step, from V_1, W_1 and L_1; its adjoint stands where that of the state before is written."""


@cache
def free_kernels(precision: Precision, dimension: int) -> FreeKernels:
    """Make the kernels of a free body's motion, in 2 or 3 dimensions."""
    real, vector, matrix = precision.real, precision.vector, matrix_of(precision)
    flat, rotation, rate = rotations(precision, dimension), rotations(precision, 3).rotation, rate_function(precision)
    angle, begun_rotation, modules = flat.angle, flat.rotation, [free_module(precision)] * 3

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
    def column(Q: matrix, k: int) -> vector:
        return vector(Q[0, k], Q[1, k], Q[2, k])

    @wp.func
    def evened(Q: matrix) -> matrix:
        """Return Q - I of a Q without round-off that would make its axes longer or let them lean."""
        return real(0.5) * Q * (real(3.0) * unit() - wp.transpose(Q) * Q) - unit()

    def predict(
        time_step_i: real,
        position_i: vector,
        turn_x_i: vector,
        turn_y_i: vector,
        turn_z_i: vector,
        rotation_i: angle,
        velocity_i: vector,
        angular_velocity_i: angle,
        density_i: real,
        inertia: matrix,
    ) -> tuple[vector, matrix, vector, matrix, vector, vector, vector]:
        R = (unit() + wp.matrix_from_cols(turn_x_i, turn_y_i, turn_z_i)) * begun_rotation(rotation_i)
        w = about(angular_velocity_i)
        ahead, turned = position_i + time_step_i * velocity_i, rotation(time_step_i * w) * R
        return position_i, R, ahead, turned, velocity_i, w, density_i * rate(R, inertia, w)

    def end(
        time_step_i: real,
        position_i: vector,
        turn_x_i: vector,
        turn_y_i: vector,
        turn_z_i: vector,
        rotation_i: angle,
        turns_before_i: matrix,
        V_i: vector,
        W_i: vector,
        L_i: vector,
        density_i: real,
        inverse: matrix,
    ) -> tuple[vector, vector, vector, vector, angle, vector, angle]:
        turning = rotation(time_step_i * W_i)
        Q = evened(turning * (unit() + wp.matrix_from_cols(turn_x_i, turn_y_i, turn_z_i)))
        spin = angle_of(rate(turning * turns_before_i, inverse, L_i) / density_i)
        return position_i + time_step_i * V_i, column(Q, 0), column(Q, 1), column(Q, 2), rotation_i, V_i, spin

    turned = {"turns": "turned", "turns_before": "turned_before"}
    poses, kept = ["before", "turns_before", "after", "turns"], ["position", "turn_x", "turn_y", "turn_z", "rotation"]
    begins = pointwise_kernels(
        precision,
        modules,
        lambda _: predict,
        [*poses, "V", "W", "L"],
        numbers=["inertia"],
        written=["velocity", "angular_velocity"],
        turned=turned,
    )
    ends = pointwise_kernels(
        precision,
        modules,
        lambda _: end,
        [f"{name}_new" for name in (*kept, "velocity", "angular_velocity")],
        {f"{name}_new": name for name in kept},
        numbers=["inverse"],
        written=["V", "W", "L", "turns_before"],
        turned=turned,
    )
    return FreeKernels(begins, ends)
