"""How the way back through a PCISPH step begins: with the adjoints of its last prediction and of the pressure."""

from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.particles.neighbourhood import Discretisation
from cortado.sph.integration import new_state_adjoint


@cache
def begin_adjoint_kernel(discretisation: Discretisation) -> Any:
    """Does in one launch what that of `cortado.sph.begin_adjoint` does, and begins the adjoints of PCISPH's own."""
    real, vector = discretisation.precision.real, discretisation.precision.vector
    from_zero = bundle(n=real, m=real, rho_0=real, mu=real, y=real, p=real)
    adjoin_new_state = new_state_adjoint(discretisation.precision)

    @wp.kernel(module=discretisation.module(False, "pcisph"), enable_backward=False)
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
        scaled_bar: wp.array(dtype=vector),
        bar: from_zero,
    ):
        i = wp.tid()
        dt = time_step[i // particles]
        x_i_bar, v_i_bar, dt_bar = adjoin_new_state(
            x_scene_bar[order[i]], v_scene_bar[order[i]], time_step_bar[i], v[i], v_star[i], dt
        )
        x_bar[i] = x_i_bar
        v_bar[i] = v_i_bar
        scaled_bar[i] = (dt / m[i]) * v_i_bar
        bar.n[i] = real(0.0)
        bar.m[i] = real(0.0)
        bar.rho_0[i] = real(0.0)
        bar.mu[i] = real(0.0)
        bar.y[i] = real(0.0)
        bar.p[i] = real(0.0)
        time_step_bar[i] = dt_bar

    return begin_adjoint
