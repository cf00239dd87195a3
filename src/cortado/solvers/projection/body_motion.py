"""What pressures and gravity make of the velocities of a body, and what these add to the divergence: see
`cortado.solvers.projection.body_kernels`."""

from dataclasses import dataclass
from functools import cache

import warp as wp

from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.moving_walls import matrix_of
from cortado.particles.particle_kernels import pointwise_kernels
from cortado.sph.free_kernels import free_module, rate_function


@dataclass(frozen=True)
class MotionKernels:
    """Kernels that move rigid bodies by pressures and gravity, with their tangents and adjoints."""

    move: Kernels
    """V, L and W from the sums of y gamma and y r x gamma, with a thread for each scene, and the velocity changes
    V - V_0 and W - W_0, ``faster`` and ``turned_faster``. Adjoints of the sums are written."""
    carry: Kernels
    """The drift of walls by the velocity changes, particles' shares of whose adjoints are written."""


@cache
def motion_kernels(precision: Precision) -> MotionKernels:
    """Make the kernels that move rigid bodies by pressures and gravity, in a precision."""
    real, vector, matrix, rate = precision.real, precision.vector, matrix_of(precision), rate_function(precision)

    def move(
        time_step_i: real,
        gravity_i: vector,
        density_i: real,
        volume: real,
        inverse: matrix,
        turns_i: matrix,
        V_0_i: vector,
        W_0_i: vector,
        L_0_i: vector,
        pulled_sum_i: vector,
        twisted_sum_i: vector,
    ) -> tuple[vector, vector, vector, vector, vector]:
        L = L_0_i + twisted_sum_i
        V = V_0_i + time_step_i * gravity_i + pulled_sum_i / (density_i * volume)
        W = rate(turns_i, inverse, L) / density_i
        return V, L, W, V - V_0_i, W - W_0_i

    def carry(faster: vector, turned_faster: vector, gamma_of_i: vector, arm_i: vector) -> real:
        return wp.dot(gamma_of_i, faster + wp.cross(turned_faster, arm_i))

    modules = [free_module(precision)] * 3
    moves = pointwise_kernels(
        precision,
        modules,
        lambda _: move,
        ["V", "L", "W", "faster", "turned_faster"],
        numbers=["volume", "inverse"],
        written=["pulled_sum", "twisted_sum"],
        told=["gravity"],
        turned={"turns": "turned"},
    )
    written = ["faster", "turned_faster"]
    return MotionKernels(
        moves, pointwise_kernels(precision, modules, lambda _: carry, ["drift:drift_in"], written=written)
    )
