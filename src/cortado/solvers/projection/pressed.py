"""Pressures of the projection as a quantity of particles, p = k / dt."""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.sph.integration import integration_module


@cache
def pressed_adjoint_kernel(precision: Precision) -> Any:
    """From the adjoint of p to those of k and dt."""
    real = precision.real

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def pressed_adjoint(
        particles: int,
        time_step: wp.array(dtype=real),
        k: wp.array(dtype=real),
        p_bar: wp.array(dtype=real),
        # in and out
        k_bar: wp.array(dtype=real),
        time_step_bar: wp.array(dtype=real),
    ):
        i = wp.tid()
        dt = time_step[i // particles]
        k_bar[i] = k_bar[i] + p_bar[i] / dt
        time_step_bar[i] = time_step_bar[i] - k[i] / (dt * dt) * p_bar[i]

    return pressed_adjoint
