"""Semi-implicit Euler, and the way between scene order and sorted order."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.kernels import kind_of
from cortado.device.precision import Precision


def integration_module(precision: Precision, forward: bool, taped: bool = False) -> Any:
    """The Warp module of kernels that need no smoothing kernel; ``taped`` forward kernels get Warp's own adjoint."""
    module = wp.get_module(f"cortado_integration_{kind_of(forward, taped)}_{precision.name}")
    module.options["enable_backward"] = forward and taped
    return module


@cache
def prediction_share(precision: Precision) -> Any:
    """The Warp function of what one prediction v* = v + dt a, x* = x + dt v* adds to the adjoint of the time step."""
    real, vector = precision.real, precision.vector

    @wp.func
    def adjoint(x_star_bar: vector, speed_bar: vector, v: vector, v_star: vector, dt: real) -> real:
        return wp.dot(x_star_bar, v_star) + wp.dot(speed_bar, v_star - v) / dt

    return adjoint


@dataclass(frozen=True)
class IntegrationKernels:
    """The kernels of the time step."""

    sort: Any
    unsort: Any
    predict: Any
    predict_tangent: Any
    begin_adjoint: Any
    acceleration_adjoint: Any
    collect_masses: Any


@cache
def integration_kernels(precision: Precision, taped: bool) -> IntegrationKernels:
    """Kernels of the time step: ``sort`` and ``unsort`` a state, ``predict`` without pressure, and derivatives; a tape
    can differentiate ``taped`` ones."""
    real, vector = precision.real, precision.vector
    adjoin_prediction = prediction_share(precision)

    @wp.kernel(module=integration_module(precision, True, taped))
    def sort(
        order: wp.array(dtype=wp.int32),
        x_scene: wp.array(dtype=vector),
        v_scene: wp.array(dtype=vector),
        m_scene: wp.array(dtype=real),
        # out
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        m: wp.array(dtype=real),
    ):
        i = wp.tid()
        x[i] = x_scene[order[i]]
        v[i] = v_scene[order[i]]
        m[i] = m_scene[order[i]]

    @wp.kernel(module=integration_module(precision, True, taped))
    def unsort(
        order: wp.array(dtype=wp.int32),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        # out
        x_scene: wp.array(dtype=vector),
        v_scene: wp.array(dtype=vector),
    ):
        i = wp.tid()
        x_scene[order[i]] = x[i]
        v_scene[order[i]] = v[i]

    @wp.kernel(module=integration_module(precision, True, taped))
    def predict(
        particles: int,
        time_step: wp.array(dtype=real),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        acceleration: wp.array(dtype=vector),
        # out
        x_star: wp.array(dtype=vector),
        v_star: wp.array(dtype=vector),
    ):
        i = wp.tid()
        member = i // particles
        velocity = v[i] + time_step[member] * acceleration[i]
        v_star[i] = velocity
        x_star[i] = x[i] + time_step[member] * velocity

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def predict_tangent(
        particles: int,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        x_dot: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        acceleration: wp.array(dtype=vector),
        acceleration_dot: wp.array(dtype=vector),
        v_star: wp.array(dtype=vector),
        # out
        x_star_dot: wp.array(dtype=vector),
        v_star_dot: wp.array(dtype=vector),
    ):
        i = wp.tid()
        member = i // particles
        dt = time_step[member]
        velocity_dot = v_dot[i] + dt * acceleration_dot[i] + time_step_dot[member] * acceleration[i]
        v_star_dot[i] = velocity_dot
        x_star_dot[i] = x_dot[i] + dt * velocity_dot + time_step_dot[member] * v_star[i]

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def begin_adjoint(
        particles: int,
        order: wp.array(dtype=wp.int32),
        time_step: wp.array(dtype=real),
        m: wp.array(dtype=real),
        v: wp.array(dtype=vector),
        v_star: wp.array(dtype=vector),
        x_scene_bar: wp.array(dtype=vector),
        v_scene_bar: wp.array(dtype=vector),
        # in and out
        time_step_bar: wp.array(dtype=real),
        # out
        x_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
        n_bar: wp.array(dtype=real),
        m_bar: wp.array(dtype=real),
        rho_0_bar: wp.array(dtype=real),
        mu_bar: wp.array(dtype=real),
        push_bar: wp.array(dtype=vector),
        y_bar: wp.array(dtype=real),
        p_bar: wp.array(dtype=real),
    ):
        """From the adjoint of the new state, in scene order, to that of the last prediction; others begin at 0."""
        i = wp.tid()
        member = i // particles
        dt = time_step[member]
        x_star_bar = x_scene_bar[order[i]]
        speed_bar = v_scene_bar[order[i]] + dt * x_star_bar
        x_bar[i] = x_star_bar
        v_bar[i] = speed_bar
        push_bar[i] = (dt / m[i]) * speed_bar
        n_bar[i] = real(0.0)
        m_bar[i] = real(0.0)
        rho_0_bar[i] = real(0.0)
        mu_bar[i] = real(0.0)
        y_bar[i] = real(0.0)
        p_bar[i] = real(0.0)
        time_step_bar[i] = time_step_bar[i] + adjoin_prediction(x_star_bar, speed_bar, v[i], v_star[i], dt)

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def acceleration_adjoint(
        particles: int,
        time_step: wp.array(dtype=real),
        v_bar: wp.array(dtype=vector),
        # out
        acceleration_bar: wp.array(dtype=vector),
    ):
        """Every prediction of the step used v + dt a, so that one adjoint is dt times the other."""
        i = wp.tid()
        member = i // particles
        acceleration_bar[i] = time_step[member] * v_bar[i]

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def collect_masses(
        order: wp.array(dtype=wp.int32),
        m_bar: wp.array(dtype=real),
        # in and out
        m_scene_bar: wp.array(dtype=real),
    ):
        i = wp.tid()
        m_scene_bar[order[i]] = m_scene_bar[order[i]] + m_bar[i]

    return IntegrationKernels(
        sort=sort,
        unsort=unsort,
        predict=predict,
        predict_tangent=predict_tangent,
        begin_adjoint=begin_adjoint,
        acceleration_adjoint=acceleration_adjoint,
        collect_masses=collect_masses,
    )
