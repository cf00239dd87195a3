"""What pressures and gravity make of the velocities of a body, and what these add to the divergence: see
`cortado.solvers.projection.body_kernels`."""

from dataclasses import dataclass
from functools import cache

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.moving_walls import matrix_of
from cortado.particles.particle_kernels import particle_kernel
from cortado.sph.free_kernels import free_module, rate_function


@dataclass(frozen=True)
class MotionKernels:
    """Kernels that move rigid bodies by pressures and gravity, with their tangents and adjoints."""

    move: Kernels
    """V, L and W from the sums of y gamma and y r x gamma, with a thread for each scene."""
    carry: Kernels
    """The drift of walls by the velocity changes V - V_0 and W - W_0."""


@cache
def motion_kernels(precision: Precision) -> MotionKernels:
    """Make the kernels that move rigid bodies by pressures and gravity, in a precision."""
    real, vector, matrix = precision.real, precision.vector, matrix_of(precision)
    module, rate = free_module(precision), rate_function(precision)
    moving = bundle(V=vector, W=vector, L=vector)
    sums = bundle(pulled_sum=vector, twisted_sum=vector)

    constants, table, poses = ["number", "volume", "inverse"], wp.array2d(dtype=vector), wp.array2d(dtype=matrix)

    @particle_kernel(module, "V L W", numbers=constants)
    def move(
        i: int,
        number: int,
        step_i: wp.int32,
        time_step_i: real,
        gravity: table,
        density_i: real,
        volume: real,
        inverse: matrix,
        turns: poses,
        V_0_i: vector,
        L_0_i: vector,
        pulled_sum_i: vector,
        twisted_sum_i: vector,
    ) -> tuple[vector, vector, vector]:
        """Return V, L and W of a body from its momenta by pressures; a thread is a scene, also in the next two."""
        L = L_0_i + twisted_sum_i
        V = V_0_i + time_step_i * gravity[i, step_i] + pulled_sum_i / (density_i * volume)
        return V, L, rate(turns[i, number], inverse, L) / density_i

    @particle_kernel(module, "V_dot L_dot W_dot", numbers=constants)
    def move_tangent(
        i: int,
        number: int,
        step_i: wp.int32,
        time_step_i: real,
        time_step_dot_i: real,
        gravity: table,
        gravity_dot: table,
        density_i: real,
        density_dot_i: real,
        volume: real,
        inverse: matrix,
        turns: poses,
        turned_dot: table,
        V_0_dot_i: vector,
        L_0_dot_i: vector,
        pulled_sum_i: vector,
        pulled_sum_dot_i: vector,
        twisted_sum_dot_i: vector,
        W_i: vector,
        L_i: vector,
    ) -> tuple[vector, vector, vector]:
        turned, denser, R = turned_dot[i, number], density_dot_i / density_i, turns[i, number]
        L_dot = L_0_dot_i + twisted_sum_dot_i
        V_dot = V_0_dot_i + time_step_i * gravity_dot[i, step_i] + time_step_dot_i * gravity[i, step_i]
        V_dot += (pulled_sum_dot_i - denser * pulled_sum_i) / (density_i * volume)
        W_dot = rate(R, inverse, L_dot - wp.cross(turned, L_i)) / density_i
        return V_dot, L_dot, W_dot + wp.cross(turned, W_i) - denser * W_i

    @wp.kernel(module=module, enable_backward=False)
    def move_adjoint(
        number: int,
        step: wp.array(dtype=wp.int32),
        time_step: wp.array(dtype=real),
        gravity: wp.array2d(dtype=vector),
        density: wp.array(dtype=real),
        volume: real,
        inverse: matrix,
        turns: wp.array2d(dtype=matrix),
        by: sums,
        later: moving,
        later_bar: bundle(V_bar=vector, W_bar=vector, L_bar=vector),
        # in and out
        bar: bundle(
            time_step=real, density=real, V_0=vector, L_0=vector, turned=vector, pulled_sum=vector, twisted_sum=vector
        ),
        gravity_bar: wp.array2d(dtype=vector),
    ):
        """Write adjoints of the summed momenta, add to others; ``turned_bar`` is that of a further turn of R'."""
        b = wp.tid()
        k, V_bar, W_bar, rho = step[b], later_bar.V_bar[b], later_bar.W_bar[b], density[b]
        spun = rate(turns[b, number], inverse, W_bar) / rho
        L_bar = later_bar.L_bar[b] + spun
        bar.V_0[b] = bar.V_0[b] + V_bar
        bar.L_0[b] = bar.L_0[b] + L_bar
        bar.turned[b] = bar.turned[b] + wp.cross(later.W[b], W_bar) + wp.cross(spun, later.L[b])
        lighter = wp.dot(W_bar, later.W[b]) + wp.dot(V_bar, by.pulled_sum[b]) / (rho * volume)
        bar.density[b] = bar.density[b] - lighter / rho
        bar.time_step[b] = bar.time_step[b] + wp.dot(V_bar, gravity[b, k])
        gravity_bar[b, k] = gravity_bar[b, k] + time_step[b] * V_bar
        bar.pulled_sum[b] = V_bar / (rho * volume)
        bar.twisted_sum[b] = L_bar

    @particle_kernel(module, "drift:drift_in")
    def carry(V: vector, V_0: vector, W: vector, W_0: vector, gamma_of_i: vector, arm_i: vector) -> real:
        return wp.dot(gamma_of_i, V - V_0 + wp.cross(W - W_0, arm_i))

    @particle_kernel(module, "drift_dot:drift_in_dot")
    def carry_tangent(
        V: vector,
        V_dot: vector,
        V_0: vector,
        V_0_dot: vector,
        W: vector,
        W_dot: vector,
        W_0: vector,
        W_0_dot: vector,
        gamma_of_i: vector,
        gamma_of_dot_i: vector,
        arm_i: vector,
        arm_dot_i: vector,
    ) -> real:
        faster = V - V_0 + wp.cross(W - W_0, arm_i)
        turned = wp.cross(W_dot - W_0_dot, arm_i) + wp.cross(W - W_0, arm_dot_i)
        return wp.dot(gamma_of_dot_i, faster) + wp.dot(gamma_of_i, V_dot - V_0_dot + turned)

    @particle_kernel(module, "+gamma_of_bar +arm_bar pulled twisted")
    def carry_adjoint(
        V: vector, V_0: vector, W: vector, W_0: vector, gamma_of_i: vector, arm_i: vector, carried_bar_i: real
    ) -> tuple[vector, vector, vector, vector]:
        """Apply the adjoint of the drift; ``pulled`` and ``twisted`` are a particle's shares of V's and W's."""
        faster = V - V_0 + wp.cross(W - W_0, arm_i)
        by_arm = wp.cross(gamma_of_i, W - W_0)
        return (
            carried_bar_i * faster,
            carried_bar_i * by_arm,
            carried_bar_i * gamma_of_i,
            carried_bar_i * wp.cross(arm_i, gamma_of_i),
        )

    @particle_kernel(module, "+V_0_bar +W_0_bar")
    def slower(V_bar_i: vector, W_bar_i: vector) -> tuple[vector, vector]:
        """Subtract from the adjoints of V_0 and W_0 those of V and W, as the drift has V - V_0; a thread is a scene."""
        return -V_bar_i, -W_bar_i

    return MotionKernels(
        Kernels(move, move_tangent, move_adjoint), Kernels(carry, carry_tangent, (carry_adjoint, slower))
    )
