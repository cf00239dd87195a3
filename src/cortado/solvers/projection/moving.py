"""Where new velocities and a shift lead: x + dt v + delta, from which the repairs of density begin."""

from functools import cache

import warp as wp

from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.sph.integration import integration_module


@cache
def moving_kernels(precision: Precision) -> Kernels:
    """The kernels of the positions before the first repair; that of the adjoint leaves the adjoint of delta, which is
    that of these positions."""
    real, vector = precision.real, precision.vector

    @wp.kernel(module=integration_module(precision, True))
    def move(
        particles: int,
        time_step: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        v_new: wp.array(dtype=vector),
        delta: wp.array(dtype=vector),
        # out
        x_moved: wp.array(dtype=vector),
        x_now: wp.array(dtype=vector),
        c: wp.array(dtype=real),
    ):
        i = wp.tid()
        moved = x[i] + time_step[i // particles] * v_new[i] + delta[i]
        x_moved[i] = moved
        x_now[i] = moved
        c[i] = real(0.0)

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def move_tangent(
        particles: int,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        v_new: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v_new_dot: wp.array(dtype=vector),
        delta_dot: wp.array(dtype=vector),
        # out
        x_moved_dot: wp.array(dtype=vector),
        x_now_dot: wp.array(dtype=vector),
        c_dot: wp.array(dtype=real),
    ):
        i = wp.tid()
        member = i // particles
        moved = x_dot[i] + time_step[member] * v_new_dot[i] + time_step_dot[member] * v_new[i] + delta_dot[i]
        x_moved_dot[i] = moved
        x_now_dot[i] = moved
        c_dot[i] = real(0.0)

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def move_adjoint(
        particles: int,
        time_step: wp.array(dtype=real),
        v_new: wp.array(dtype=vector),
        x_moved_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_new_bar: wp.array(dtype=vector),
        time_step_bar: wp.array(dtype=real),
    ):
        i = wp.tid()
        moved = x_moved_bar[i]
        x_bar[i] = x_bar[i] + moved
        v_new_bar[i] = v_new_bar[i] + time_step[i // particles] * moved
        time_step_bar[i] = time_step_bar[i] + wp.dot(moved, v_new[i])

    return Kernels(move, move_tangent, move_adjoint)
