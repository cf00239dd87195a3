"""How far a coarse correction of the pressure goes: alpha of `cortado.solvers.projection.coarse_pressure`."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision

SMALL = 1e-6
"""Speed, in spacings a step, of the kinetic energy that is added to the sums of alpha."""


@dataclass(frozen=True)
class LengthKernels:
    """Of alpha, given d, the thrust -D^T d / m, and as ``carried`` the G d of free bodies, see
    `cortado.solvers.projection.coarse_bodies`."""

    share: Any
    share_tangent: Any
    """What particles add to both sums of alpha."""
    apply: Any
    apply_tangent: Any
    apply_adjoint: Any
    """Of y' and u', given both sums."""
    along_adjoint: Any
    """What the adjoint of y' and u' gives to alpha."""
    every: Any
    """Whether all scenes of a batch are warm."""


@cache
def length_kernels(precision: Precision) -> LengthKernels:
    """The same in 2 and in 3 dimensions."""
    real, vector, pair_of = precision.real, precision.vector, precision.pair
    small = wp.constant(real(SMALL))
    module = kernel_module(f"coarse_length_{precision.name}")

    @wp.func
    def length(sums: pair_of) -> real:
        """alpha; NaN stays NaN, which must not be hidden."""
        found = sums[0] / sums[1]
        return wp.where(found < real(0.0), real(0.0), wp.where(found > real(1.0), real(1.0), found))

    @wp.func
    def bends(sums: pair_of) -> bool:
        """Whether alpha is between its ends, and follows the sums."""
        return sums[0] > real(0.0) and sums[0] < sums[1]

    @wp.kernel(module=module, enable_backward=False)
    def every(scenes: int, warm: wp.array(dtype=int), all_warm: wp.array(dtype=int)):
        found = int(1)
        for scene in range(scenes):
            found = wp.min(found, warm[scene])
        all_warm[0] = found

    @wp.func
    def least(m: real, spacing: real, dt: real) -> real:
        """What a particle adds to the sums in any case."""
        v = small * spacing / dt
        return m * v * v

    @wp.kernel(module=module, enable_backward=False)
    def share(
        particles: int,
        first: int,
        spacing: real,
        stays: wp.array(dtype=int),
        time_step: wp.array(dtype=real),
        m: wp.array(dtype=real),
        r: wp.array(dtype=real),
        change: wp.array(dtype=real),
        carried: wp.array(dtype=real),
        thrust: wp.array(dtype=vector),
        # out
        parts: wp.array(dtype=pair_of),
    ):
        """In a scene that ``stays`` as it is alpha is 0."""
        i = wp.tid()
        if stays[i // particles] != 0:
            parts[i] = pair_of(real(0.0), m[i])
            return
        d, own = change[i], least(m[i], spacing, time_step[i // particles])
        parts[i] = pair_of(r[i] * d + real(1 - first) * own, m[i] * wp.dot(thrust[i], thrust[i]) + d * carried[i] + own)

    @wp.kernel(module=module, enable_backward=False)
    def apply(
        particles: int,
        sums: wp.array(dtype=pair_of),
        y: wp.array(dtype=real),
        u: wp.array(dtype=vector),
        change: wp.array(dtype=real),
        thrust: wp.array(dtype=vector),
        # out
        k_out: wp.array(dtype=real),
        y_out: wp.array(dtype=real),
        u_out: wp.array(dtype=vector),
    ):
        i = wp.tid()
        alpha = length(sums[i // particles])
        new = y[i] + alpha * change[i]
        k_out[i] = new
        y_out[i] = new
        u_out[i] = u[i] + alpha * thrust[i]

    @wp.kernel(module=module, enable_backward=False)
    def share_tangent(
        particles: int,
        first: int,
        spacing: real,
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        m: wp.array(dtype=real),
        m_dot: wp.array(dtype=real),
        of: bundle(r=real, change=real, carried=real, thrust=vector),
        dot: bundle(r=real, change=real, carried=real, thrust=vector),
        # out
        parts: wp.array(dtype=pair_of),
    ):
        i = wp.tid()
        along = dot.r[i] * of.change[i] + of.r[i] * dot.change[i]
        f, f_dot = of.thrust[i], dot.thrust[i]
        energy = m_dot[i] * wp.dot(f, f) + real(2.0) * m[i] * wp.dot(f, f_dot)
        energy += dot.change[i] * of.carried[i] + of.change[i] * dot.carried[i]
        dt, dt_dot = time_step[i // particles], time_step_dot[i // particles]
        own_dot = least(m_dot[i], spacing, dt) - real(2.0) * least(m[i], spacing, dt) * dt_dot / dt
        parts[i] = pair_of(along + real(1 - first) * own_dot, energy + own_dot)

    @wp.kernel(module=module, enable_backward=False)
    def apply_tangent(
        particles: int,
        sums: wp.array(dtype=pair_of),
        sums_dot: wp.array(dtype=pair_of),
        of: bundle(change=real, change_dot=real, thrust=vector, thrust_dot=vector),
        # in and out
        k_dot: wp.array(dtype=real),
        y_dot: wp.array(dtype=real),
        u_dot: wp.array(dtype=vector),
    ):
        i = wp.tid()
        both, both_dot = sums[i // particles], sums_dot[i // particles]
        alpha, alpha_dot = length(both), real(0.0)
        if bends(both):
            alpha_dot = (both_dot[0] - alpha * both_dot[1]) / both[1]
        new = y_dot[i] + alpha_dot * of.change[i] + alpha * of.change_dot[i]
        k_dot[i] = new
        y_dot[i] = new
        u_dot[i] = u_dot[i] + alpha_dot * of.thrust[i] + alpha * of.thrust_dot[i]

    @wp.kernel(module=module, enable_backward=False)
    def along_adjoint(
        k_bar: wp.array(dtype=real),
        y_bar: wp.array(dtype=real),
        u_bar: wp.array(dtype=vector),
        change: wp.array(dtype=real),
        thrust: wp.array(dtype=vector),
        # out
        alpha_bar: wp.array(dtype=real),
    ):
        i = wp.tid()
        alpha_bar[i] = (k_bar[i] + y_bar[i]) * change[i] + wp.dot(u_bar[i], thrust[i])

    @wp.kernel(module=module, enable_backward=False)
    def apply_adjoint(
        particles: int,
        first: int,
        spacing: real,
        time_step: wp.array(dtype=real),
        sums: wp.array(dtype=pair_of),
        alpha_bar: wp.array(dtype=real),
        m: wp.array(dtype=real),
        of: bundle(r=real, change=real, carried=real, thrust=vector),
        u_bar: wp.array(dtype=vector),
        # in and out: at first those of k' and y', at last those of k and y
        k_bar: wp.array(dtype=real),
        y_bar: wp.array(dtype=real),
        bar: bundle(m=real, time_step=real),
        # out
        out: bundle(change_bar=real, carried_bar=real, thrust_bar=vector, r_bar=real),
    ):
        """``alpha_bar`` is that of each scene. The adjoint of u' is that of u, too."""
        i = wp.tid()
        both = sums[i // particles]
        alpha, along_bar, energy_bar = length(both), real(0.0), real(0.0)
        if bends(both):
            along_bar = alpha_bar[i // particles] / both[1]
            energy_bar = -alpha * along_bar
        new_bar, f = k_bar[i] + y_bar[i], of.thrust[i]
        k_bar[i] = real(0.0)
        y_bar[i] = new_bar
        dt, own_bar = time_step[i // particles], real(1 - first) * along_bar + energy_bar
        bar.m[i] = bar.m[i] + energy_bar * wp.dot(f, f) + own_bar * least(real(1.0), spacing, dt)
        bar.time_step[i] = bar.time_step[i] - real(2.0) * own_bar * least(m[i], spacing, dt) / dt
        out.change_bar[i] = alpha * new_bar + along_bar * of.r[i] + energy_bar * of.carried[i]
        out.carried_bar[i] = energy_bar * of.change[i]
        out.thrust_bar[i] = alpha * u_bar[i] + (real(2.0) * m[i] * energy_bar) * f
        out.r_bar[i] = along_bar * of.change[i]

    return LengthKernels(share, share_tangent, apply, apply_tangent, apply_adjoint, along_adjoint, every)
