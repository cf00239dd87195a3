"""How the way back through a step begins that has nothing to differentiate but its last prediction."""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.precision import Precision
from cortado.sph.integration import integration_module, new_state_adjoint


@cache
def begin_adjoint_kernel(precision: Precision) -> Any:
    """From the adjoint of the new state, in scene order, to that of its prediction; all others begin at 0."""
    real, vector = precision.real, precision.vector
    adjoin_new_state = new_state_adjoint(precision)

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def begin_adjoint(
        particles: int,
        order: wp.array(dtype=wp.int32),
        time_step: wp.array(dtype=real),
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
    ):
        i = wp.tid()
        dt = time_step[i // particles]
        x_i_bar, v_i_bar, dt_bar = adjoin_new_state(
            x_scene_bar[order[i]], v_scene_bar[order[i]], time_step_bar[i], v[i], v_star[i], dt
        )
        x_bar[i] = x_i_bar
        v_bar[i] = v_i_bar
        n_bar[i] = real(0.0)
        m_bar[i] = real(0.0)
        rho_0_bar[i] = real(0.0)
        mu_bar[i] = real(0.0)
        time_step_bar[i] = dt_bar

    return begin_adjoint
