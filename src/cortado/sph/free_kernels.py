"""The rotation and the motion of free rigid bodies.

A body's rotation is R = Q R(w_0) for the rotation w_0 that it began with. A state has how far the ends of the three
unit axes of its frame have moved since, the columns of Q - I. Derivatives of these are taken by the vector w' of a
further turn: columns q change by w' x q, and an adjoint t of w' is one of columns, t x q / 2.

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

from cortado.device.launching import bundle
from cortado.device.modules import Kernels, kernel_module
from cortado.device.precision import Precision
from cortado.particles.moving_walls import matrix_of
from cortado.sph.rotations import rotations


@dataclass(frozen=True)
class FreeFunctions:
    """The bundle of a free body's state, and Warp functions of its rotation in scene b."""

    state: Any
    """position, turn_x, turn_y, turn_z, rotation, velocity and angular_velocity"""
    about: Any
    """The vector of an angle, or of an angular velocity."""
    angle_of: Any
    """The angle, or angular velocity, of a vector."""
    attitude: Any
    """The rotation Q since the start."""
    column: Any
    """A column of a matrix."""
    evened: Any
    """Q - I of a Q without round-off that would make its axes longer or let them lean."""
    twist: Any
    """From the adjoint of a state to that of a further turn of Q; for a tangent, twice the turn."""
    write_twist: Any
    """From the adjoint of a further turn of Q to that of a state."""


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


@cache
def free_functions(precision: Precision, dimension: int) -> FreeFunctions:
    """Make the Warp functions of a free body's state and rotation, in 2 or 3 dimensions."""
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


@dataclass(frozen=True)
class FreeKernels:
    """Kernels of one free body's motion in a step, with a thread for each scene."""

    predict: Kernels
    """The pose in which its walls are, and V, W and L."""
    end: Kernels
    """The state after the step."""


@cache
def free_kernels(precision: Precision, dimension: int) -> FreeKernels:
    """Make the kernels of a free body's motion, in 2 or 3 dimensions."""
    real, vector, matrix = precision.real, precision.vector, matrix_of(precision)
    flat, space, of_body = (
        rotations(precision, dimension),
        rotations(precision, 3),
        free_functions(precision, dimension),
    )
    angle, begun_rotation, begun_further, begun_back = flat.angle, flat.rotation, flat.further, flat.back
    rotation, further, back = space.rotation, space.further, space.back
    state, about, angle_of, attitude = of_body.state, of_body.about, of_body.angle_of, of_body.attitude
    column, evened, rate = of_body.column, of_body.evened, rate_function(precision)
    twist, write_twist = of_body.twist, of_body.write_twist
    module = free_module(precision)
    moving, bars = bundle(V=vector, W=vector, L=vector), bundle(V_bar=vector, W_bar=vector, L_bar=vector)
    moving_dots = bundle(V_dot=vector, W_dot=vector, L_dot=vector)
    axes = dict.fromkeys(("turn_x_new", "turn_y_new", "turn_z_new"), vector)
    after = bundle(**axes, position_new=vector, rotation_new=angle, velocity_new=vector, angular_velocity_new=angle)

    @wp.kernel(module=module, enable_backward=False)
    def predict(
        number: int,
        time_step: wp.array(dtype=real),
        of: state,
        density: wp.array(dtype=real),
        inertia: matrix,
        # out
        before: wp.array2d(dtype=vector),
        turns_before: wp.array2d(dtype=matrix),
        after: wp.array2d(dtype=vector),
        turns: wp.array2d(dtype=matrix),
        V: wp.array(dtype=vector),
        W: wp.array(dtype=vector),
        L: wp.array(dtype=vector),
    ):
        b = wp.tid()
        R, w, dt = attitude(b, of) * begun_rotation(of.rotation[b]), about(of.angular_velocity[b]), time_step[b]
        before[b, number] = of.position[b]
        turns_before[b, number] = R
        after[b, number] = of.position[b] + dt * of.velocity[b]
        turns[b, number] = rotation(dt * w) * R
        V[b] = of.velocity[b]
        W[b] = w
        L[b] = density[b] * rate(R, inertia, w)

    @wp.kernel(module=module, enable_backward=False)
    def predict_tangent(
        number: int,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        of: state,
        dot: state,
        density: wp.array(dtype=real),
        density_dot: wp.array(dtype=real),
        inertia: matrix,
        # out
        before_dot: wp.array2d(dtype=vector),
        turned_before_dot: wp.array2d(dtype=vector),
        after_dot: wp.array2d(dtype=vector),
        turned_dot: wp.array2d(dtype=vector),
        moved_dot: moving_dots,
    ):
        b = wp.tid()
        Q, dt, dt_dot = attitude(b, of), time_step[b], time_step_dot[b]
        R, w, w_dot = Q * begun_rotation(of.rotation[b]), about(of.angular_velocity[b]), about(dot.angular_velocity[b])
        turned = real(0.5) * twist(b, Q, dot) + Q * begun_further(of.rotation[b], dot.rotation[b])
        before_dot[b, number] = dot.position[b]
        turned_before_dot[b, number] = turned
        after_dot[b, number] = dot.position[b] + dt * dot.velocity[b] + dt_dot * of.velocity[b]
        turned_dot[b, number] = further(dt * w, dt * w_dot + dt_dot * w) + rotation(dt * w) * turned
        moved_dot.V_dot[b] = dot.velocity[b]
        moved_dot.W_dot[b] = w_dot
        whole = rate(R, inertia, w)
        change = wp.cross(turned, whole) + rate(R, inertia, w_dot - wp.cross(turned, w))
        moved_dot.L_dot[b] = density_dot[b] * whole + density[b] * change

    @wp.kernel(module=module, enable_backward=False)
    def predict_adjoint(
        time_step: wp.array(dtype=real),
        of: state,
        density: wp.array(dtype=real),
        inertia: matrix,
        force: wp.array(dtype=vector),
        torque: wp.array(dtype=vector),
        force_before: wp.array(dtype=vector),
        torque_before: wp.array(dtype=vector),
        turned_end: wp.array(dtype=vector),
        moved: bars,
        # in and out
        bar: state,
        time_step_bar: wp.array(dtype=real),
        density_bar: wp.array(dtype=real),
    ):
        """Apply the adjoint of a body's predicted pose. ``bar`` has the adjoints of c and Q, ``turned_end`` that of a
        further turn of R; force and torque are the adjoints of poses, and ``moved`` those of V, W and L."""
        b = wp.tid()
        Q, dt = attitude(b, of), time_step[b]
        R, w = Q * begun_rotation(of.rotation[b]), about(of.angular_velocity[b])
        whole = rate(R, inertia, w)
        turned_bar = wp.transpose(rotation(dt * w)) * torque[b] + torque_before[b] + turned_end[b]
        by_angle = back(dt * w, torque[b])
        spun = density[b] * rate(R, inertia, moved.L_bar[b])
        turned_bar += density[b] * wp.cross(whole, moved.L_bar[b]) + wp.cross(spun, w)
        density_bar[b] = density_bar[b] + wp.dot(whole, moved.L_bar[b])
        time_step_bar[b] = time_step_bar[b] + wp.dot(force[b], of.velocity[b]) + wp.dot(by_angle, w)
        bar.position[b] = bar.position[b] + force[b] + force_before[b]
        bar.velocity[b] = moved.V_bar[b] + dt * force[b]
        bar.angular_velocity[b] = angle_of(moved.W_bar[b] + dt * by_angle + spun)
        bar.rotation[b] = bar.rotation[b] + begun_back(of.rotation[b], wp.transpose(Q) * turned_bar)
        write_twist(b, Q, twist(b, Q, bar) + turned_bar, bar)

    @wp.kernel(module=module, enable_backward=False)
    def end(
        number: int,
        time_step: wp.array(dtype=real),
        of: state,
        turns_before: wp.array2d(dtype=matrix),
        density: wp.array(dtype=real),
        inverse: matrix,
        moved: moving,
        # out
        later: after,
    ):
        """Write the pose and the velocities of each body at the end of the step; ``moved`` has V_1, W_1 and L_1."""
        b = wp.tid()
        dt = time_step[b]
        turning = rotation(dt * moved.W[b])
        axes_moved = evened(turning * attitude(b, of))
        later.turn_x_new[b] = column(axes_moved, 0)
        later.turn_y_new[b] = column(axes_moved, 1)
        later.turn_z_new[b] = column(axes_moved, 2)
        later.position_new[b] = of.position[b] + dt * moved.V[b]
        later.rotation_new[b] = of.rotation[b]
        later.velocity_new[b] = moved.V[b]
        later.angular_velocity_new[b] = angle_of(
            rate(turning * turns_before[b, number], inverse, moved.L[b]) / density[b]
        )

    @wp.kernel(module=module, enable_backward=False)
    def end_tangent(
        number: int,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        of: state,
        turns_before: wp.array2d(dtype=matrix),
        turned_before_dot: wp.array2d(dtype=vector),
        density: wp.array(dtype=real),
        density_dot: wp.array(dtype=real),
        inverse: matrix,
        moved: moving,
        moved_dot: moving_dots,
        # in and out: at first of the state before, at last of that after the step
        dot: state,
    ):
        b = wp.tid()
        dt, dt_dot, w, L = time_step[b], time_step_dot[b], moved.W[b], moved.L[b]
        before, turning = attitude(b, of), rotation(dt * w)
        turn = further(dt * w, dt * moved_dot.W_dot[b] + dt_dot * w)
        turned = turn + turning * turned_before_dot[b, number]
        axes_turned = turn + turning * (real(0.5) * twist(b, before, dot))
        R = turning * turns_before[b, number]
        spin = rate(R, inverse, L) / density[b]
        spin_dot = wp.cross(turned, spin) + rate(R, inverse, moved_dot.L_dot[b] - wp.cross(turned, L)) / density[b]
        write_twist(b, turning * before, real(2.0) * axes_turned, dot)
        dot.position[b] = dot.position[b] + dt * moved_dot.V_dot[b] + dt_dot * moved.V[b]
        dot.velocity[b] = moved_dot.V_dot[b]
        dot.angular_velocity[b] = angle_of(spin_dot - (density_dot[b] / density[b]) * spin)

    @wp.kernel(module=module, enable_backward=False)
    def end_adjoint(
        number: int,
        time_step: wp.array(dtype=real),
        of: state,
        turns_before: wp.array2d(dtype=matrix),
        density: wp.array(dtype=real),
        inverse: matrix,
        moved: moving,
        # in and out: at first of the state after the step, at last what that gives to c and Q before it
        bar: state,
        time_step_bar: wp.array(dtype=real),
        density_bar: wp.array(dtype=real),
        # out
        bars_of: bars,
        turned_end: wp.array(dtype=vector),
    ):
        """Turn the adjoint of a body's state into those of V_1, W_1, L_1, and of a further turn of R."""
        b = wp.tid()
        dt, w, L, turning, before = (
            time_step[b],
            moved.W[b],
            moved.L[b],
            rotation(time_step[b] * moved.W[b]),
            attitude(b, of),
        )
        R = turning * turns_before[b, number]
        spin, spin_bar = rate(R, inverse, L) / density[b], about(bar.angular_velocity[b])
        spun = rate(R, inverse, spin_bar) / density[b]
        turned_bar = wp.cross(spin, spin_bar) + wp.cross(spun, L)
        axes_bar = twist(b, turning * before, bar)
        by_angle = back(dt * w, axes_bar + turned_bar)
        bars_of.V_bar[b] = bar.velocity[b] + dt * bar.position[b]
        bars_of.W_bar[b] = dt * by_angle
        bars_of.L_bar[b] = spun
        turned_end[b] = wp.transpose(turning) * turned_bar
        time_step_bar[b] = time_step_bar[b] + wp.dot(by_angle, w) + wp.dot(bar.position[b], moved.V[b])
        density_bar[b] = density_bar[b] - wp.dot(spin_bar, spin) / density[b]
        write_twist(b, before, wp.transpose(turning) * axes_bar, bar)

    return FreeKernels(Kernels(predict, predict_tangent, predict_adjoint), Kernels(end, end_tangent, end_adjoint))
