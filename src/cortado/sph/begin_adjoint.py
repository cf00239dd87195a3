"""How the way back through a step begins that has nothing to differentiate but its last prediction."""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.particles.particle_kernels import particle_kernel
from cortado.sph.integration import integration_module, new_state_adjoint


@cache
def begin_adjoint_kernel(precision: Precision) -> Any:
    """Make the kernel from the adjoint of the new state, in scene order, to that of its prediction."""
    real, vector = precision.real, precision.vector
    adjoin_new_state = new_state_adjoint(precision)

    vectors = wp.array(dtype=vector)

    @particle_kernel(integration_module(precision, False), "x_bar v_bar n_bar m_bar rho_0_bar mu_bar time_step_bar")
    def begin_adjoint(
        order_i: wp.int32,
        time_step: real,
        v_i: vector,
        v_star_i: vector,
        x_scene_bar: vectors,
        v_scene_bar: vectors,
        time_step_bar_i: real,
    ) -> tuple[vector, vector, real, real, real, real, real]:
        x_bar, v_bar, dt_bar = adjoin_new_state(
            x_scene_bar[order_i], v_scene_bar[order_i], time_step_bar_i, v_i, v_star_i, time_step
        )
        no = real(0.0)
        return x_bar, v_bar, no, no, no, no, dt_bar

    return begin_adjoint
