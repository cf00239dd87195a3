"""Semi-implicit Euler and its derivatives, and the way of particles' entries from the scene's order to the sorted one,
and back.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from cortado.device.modules import by_name, kernel_module, kind_of
from cortado.device.precision import Precision, TypesByName
from cortado.particles.particle_kernels import particle_kernel


@cache
def order_kernels(dtype: Any, module: Any) -> SimpleNamespace:
    """Make the kernels that ``sort`` an array of entries of a Warp type from the scene's order, and ``unsort`` it."""
    typed = TypesByName(dtype, {wp.int32: "order"})

    @wp.kernel(module=module)
    @typed.arrays
    def sort(order, a_scene, a):
        i = wp.tid()
        a[i] = a_scene[order[i]]

    @wp.kernel(module=module)
    @typed.arrays
    def unsort(order, a, a_scene):
        i = wp.tid()
        a_scene[order[i]] = a[i]

    return by_name(sort, unsort)


def integration_module(precision: Precision, forward: bool, taped: bool = False) -> Any:
    """Return the Warp module of kernels without a smoothing kernel; ``taped`` forward ones get Warp's own adjoint."""
    return kernel_module(f"integration_{kind_of(forward, taped)}_{precision.name}", forward and taped)


@cache
def prediction_share(precision: Precision) -> Any:
    """Make the Warp function of the time step's adjoint by a prediction v* = v + dt a, x* = x + dt v*."""
    real, vector = precision.real, precision.vector

    @wp.func
    def adjoint(x_star_bar: vector, speed_bar: vector, v: vector, v_star: vector, dt: real) -> real:
        return wp.dot(x_star_bar, v_star) + wp.dot(speed_bar, v_star - v) / dt

    return adjoint


@cache
def new_state_adjoint(precision: Precision) -> Any:
    """Make the Warp function from the adjoints of x' = x + dt v' and of v' to those of x and of the last prediction of
    v'. It adds to the adjoint of the time step, too."""
    real, vector = precision.real, precision.vector
    adjoin_prediction = prediction_share(precision)

    @wp.func
    def adjoint(x_new_bar: vector, v_new_bar: vector, dt_bar: real, v: vector, v_star: vector, dt: real):
        speed_bar = v_new_bar + dt * x_new_bar
        return x_new_bar, speed_bar, dt_bar + adjoin_prediction(x_new_bar, speed_bar, v, v_star, dt)

    return adjoint


@cache
def integration_kernels(precision: Precision, taped: bool) -> SimpleNamespace:
    """Make kernels that ``sort`` and ``unsort`` a state and ``predict`` without pressure, with derivatives; a tape can
    differentiate ``taped`` ones."""
    real, vector = precision.real, precision.vector
    typed = TypesByName(real, {wp.int32: "order", vector: "x v acceleration"})

    @wp.kernel(module=integration_module(precision, True, taped))
    @typed.arrays
    def sort(order, x_scene, v_scene, m_scene, x, v, m):
        i = wp.tid()
        x[i] = x_scene[order[i]]
        v[i] = v_scene[order[i]]
        m[i] = m_scene[order[i]]

    @wp.kernel(module=integration_module(precision, True, taped))
    @typed.arrays
    def unsort(order, x, v, x_scene, v_scene):
        i = wp.tid()
        x_scene[order[i]] = x[i]
        v_scene[order[i]] = v[i]

    @particle_kernel(integration_module(precision, True, taped), "x_star v_star")
    def predict(time_step: real, x_i: vector, v_i: vector, acceleration_i: vector) -> tuple[vector, vector]:
        velocity = v_i + time_step * acceleration_i
        return x_i + time_step * velocity, velocity

    @particle_kernel(integration_module(precision, False), "x_star_dot v_star_dot")
    @typed
    def predict_tangent(
        time_step, time_step_dot, x_dot_i, v_dot_i, acceleration_i, acceleration_dot_i, v_star_i
    ) -> tuple[vector, vector]:
        velocity_dot = v_dot_i + time_step * acceleration_dot_i + time_step_dot * acceleration_i
        return x_dot_i + time_step * velocity_dot + time_step_dot * v_star_i, velocity_dot

    @particle_kernel(integration_module(precision, False), "acceleration_bar")
    def acceleration_adjoint(time_step: real, v_bar_i: vector) -> vector:
        """Return the adjoint of the acceleration, dt times that of v, as all predictions of a step used v + dt a."""
        return time_step * v_bar_i

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    @typed.arrays
    def collect_masses(order, m_bar, m_scene_bar):
        i = wp.tid()
        m_scene_bar[order[i]] = m_scene_bar[order[i]] + m_bar[i]

    return by_name(sort, unsort, predict, predict_tangent, acceleration_adjoint, collect_masses)


@cache
def begin_adjoint_kernel(precision: Precision) -> Any:
    """Make the kernel that turns the adjoint of the new state, in scene order, into the prediction's."""
    real, vector = precision.real, precision.vector
    adjoin_new_state = new_state_adjoint(precision)
    vectors = wp.array(dtype=vector)
    typed = TypesByName(real, {wp.int32: "order", vector: "v", vectors: "x_scene v_scene"})

    @particle_kernel(integration_module(precision, False), "x_bar v_bar n_bar m_bar rho_0_bar mu_bar time_step_bar")
    @typed
    def begin_adjoint(
        order_i, time_step, v_i, v_star_i, x_scene_bar, v_scene_bar, time_step_bar_i
    ) -> tuple[vector, vector, real, real, real, real, real]:
        x_bar, v_bar, dt_bar = adjoin_new_state(
            x_scene_bar[order_i], v_scene_bar[order_i], time_step_bar_i, v_i, v_star_i, time_step
        )
        no = real(0.0)
        return x_bar, v_bar, no, no, no, no, dt_bar

    return begin_adjoint
