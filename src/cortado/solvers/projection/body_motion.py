"""What pressures and gravity make of the velocities of a body, and what these add to the divergence: see
`cortado.solvers.projection.body_kernels`."""

from dataclasses import dataclass
from functools import cache

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.moving_walls import matrix_of
from cortado.sph.free_kernels import free_module, rate_function


@dataclass(frozen=True)
class MotionKernels:
    """With their tangents and adjoints."""

    move: Kernels
    """V, L and W from the sums of y gamma and y r x gamma, with a thread for each scene."""
    carry: Kernels
    """The drift that V - V_0 and W - W_0 are."""


@cache
def motion_kernels(precision: Precision) -> MotionKernels:
    """In a precision."""
    real, vector, matrix = precision.real, precision.vector, matrix_of(precision)
    module, rate = free_module(precision), rate_function(precision)
    held, moving = bundle(gamma_of=vector, arm=vector), bundle(V=vector, W=vector, L=vector)
    begun, sums = bundle(V_0=vector, W_0=vector, L_0=vector), bundle(pulled_sum=vector, twisted_sum=vector)

    @wp.kernel(module=module, enable_backward=False)
    def move(
        number: int,
        step: wp.array(dtype=wp.int32),
        time_step: wp.array(dtype=real),
        gravity: wp.array2d(dtype=vector),
        density: wp.array(dtype=real),
        volume: real,
        inverse: matrix,
        turns: wp.array2d(dtype=matrix),
        at: begun,
        by: sums,
        # out
        later: moving,
    ):
        b = wp.tid()
        L = at.L_0[b] + by.twisted_sum[b]
        later.V[b] = at.V_0[b] + time_step[b] * gravity[b, step[b]] + by.pulled_sum[b] / (density[b] * volume)
        later.L[b] = L
        later.W[b] = rate(turns[b, number], inverse, L) / density[b]

    @wp.kernel(module=module, enable_backward=False)
    def move_tangent(
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
        given_dot: bundle(time_step_dot=real, density_dot=real),
        gravity_dot: wp.array2d(dtype=vector),
        turned_dot: wp.array2d(dtype=vector),
        dot: bundle(V_0=vector, L_0=vector, pulled_sum=vector, twisted_sum=vector, V=vector, W=vector, L=vector),
    ):
        """The last three of ``dot`` are written."""
        b = wp.tid()
        k, turned, rho = step[b], turned_dot[b, number], density[b]
        rho_dot, R = given_dot.density_dot[b] / rho, turns[b, number]
        L_dot = dot.L_0[b] + dot.twisted_sum[b]
        V_dot = dot.V_0[b] + time_step[b] * gravity_dot[b, k] + given_dot.time_step_dot[b] * gravity[b, k]
        dot.V[b] = V_dot + (dot.pulled_sum[b] - rho_dot * by.pulled_sum[b]) / (rho * volume)
        dot.L[b] = L_dot
        W_dot = rate(R, inverse, L_dot - wp.cross(turned, later.L[b])) / rho
        dot.W[b] = W_dot + wp.cross(turned, later.W[b]) - rho_dot * later.W[b]

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
        """The adjoints of the sums are written, others added to; ``turned_bar`` is that of a further turn of R'."""
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

    @wp.kernel(module=module, enable_backward=False)
    def carry(
        particles: int,
        of: held,
        at: begun,
        later: moving,
        drift_in: wp.array(dtype=real),
        # out
        drift: wp.array(dtype=real),
    ):
        i = wp.tid()
        b = i // particles
        faster = later.V[b] - at.V_0[b] + wp.cross(later.W[b] - at.W_0[b], of.arm[i])
        drift[i] = drift_in[i] + wp.dot(of.gamma_of[i], faster)

    @wp.kernel(module=module, enable_backward=False)
    def carry_tangent(
        particles: int,
        of: held,
        at: begun,
        later: moving,
        dot: bundle(gamma_of=vector, arm=vector, V=vector, W=vector, V_0=vector, W_0=vector, drift_in=real, drift=real),
    ):
        """The last of ``dot`` is written."""
        i = wp.tid()
        b = i // particles
        turning, turning_dot, r = later.W[b] - at.W_0[b], dot.W[b] - dot.W_0[b], of.arm[i]
        faster = later.V[b] - at.V_0[b] + wp.cross(turning, r)
        faster_dot = dot.V[b] - dot.V_0[b] + wp.cross(turning_dot, r) + wp.cross(turning, dot.arm[i])
        dot.drift[i] = dot.drift_in[i] + wp.dot(dot.gamma_of[i], faster) + wp.dot(of.gamma_of[i], faster_dot)

    @wp.kernel(module=module, enable_backward=False)
    def carry_adjoint(
        particles: int,
        of: held,
        at: begun,
        later: moving,
        carried_bar: wp.array(dtype=real),
        # in and out
        bar: held,
        # out
        pulled: wp.array(dtype=vector),
        twisted: wp.array(dtype=vector),
    ):
        """For the adjoint of the drift; ``pulled`` and ``twisted`` are the shares of those of V and W."""
        i = wp.tid()
        b = i // particles
        d, turning, r, gamma = carried_bar[i], later.W[b] - at.W_0[b], of.arm[i], of.gamma_of[i]
        bar.gamma_of[i] = bar.gamma_of[i] + d * (later.V[b] - at.V_0[b] + wp.cross(turning, r))
        bar.arm[i] = bar.arm[i] + d * wp.cross(gamma, turning)
        pulled[i] = d * gamma
        twisted[i] = d * wp.cross(r, gamma)

    @wp.kernel(module=module, enable_backward=False)
    def slower(
        V_bar: wp.array(dtype=vector),
        W_bar: wp.array(dtype=vector),
        # in and out
        V_0_bar: wp.array(dtype=vector),
        W_0_bar: wp.array(dtype=vector),
    ):
        """Of the velocities that walls have, which the drift does without."""
        b = wp.tid()
        V_0_bar[b] = V_0_bar[b] - V_bar[b]
        W_0_bar[b] = W_0_bar[b] - W_bar[b]

    return MotionKernels(
        Kernels(move, move_tangent, move_adjoint), Kernels(carry, carry_tangent, (carry_adjoint, slower))
    )
