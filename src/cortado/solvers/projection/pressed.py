"""Pressures of the projection are impulses, k or `cortado.solvers.projection.mean_stress`, over dt."""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.sph.integration import integration_module


@cache
def pressed_adjoint_kernel(precision: Precision) -> Any:
    """From the adjoint of a pressure to those of its impulse and of dt."""
    real = precision.real

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def pressed_adjoint(
        particles: int,
        time_step: wp.array(dtype=real),
        impulse: wp.array(dtype=real),
        p_bar: wp.array(dtype=real),
        # in and out
        impulse_bar: wp.array(dtype=real),
        time_step_bar: wp.array(dtype=real),
    ):
        i = wp.tid()
        dt = time_step[i // particles]
        impulse_bar[i] = impulse_bar[i] + p_bar[i] / dt
        time_step_bar[i] = time_step_bar[i] - impulse[i] / (dt * dt) * p_bar[i]

    return pressed_adjoint
