"""How strongly a body and what it touches push each other: see `cortado.solvers.contact_kernels`."""

from functools import cache

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.sph.free_functions import free_module

STIFFNESS = 0.04
"""q"""


@cache
def strength_kernels(precision: Precision) -> Kernels:
    """What both get by the sums over the points of the body, with a thread for each scene."""
    real, vector, pair = precision.real, precision.vector, precision.pair
    module, stiffness = free_module(precision), wp.constant(real(STIFFNESS))
    bars = bundle(**{f"{name}_bar": vector for name in ("push", "twist", "other")})
    given = bundle(pushed=vector, twisted=vector)
    sums, sum_dots = (
        bundle(**dict.fromkeys((f"{name}_sum{end}" for name in ("push", "twist", "other")), vector))
        for end in ("", "_dot")
    )

    @wp.func
    def strength(dt: real, own: real, other: real, is_free: bool) -> real:
        """q M / dt of the masses of both, of which the other counts if it is free."""
        mass = own
        if is_free:
            mass = own * other / (own + other)
        return stiffness * mass / dt

    @wp.func
    def part(own: real, other: real, is_free: bool) -> real:
        """dM / d own"""
        found = real(1.0)
        if is_free:
            found = (other / (own + other)) * (other / (own + other))
        return found

    @wp.kernel(module=module, enable_backward=False)
    def give(
        is_free: bool,
        volumes: pair,
        time_step: wp.array(dtype=real),
        density: wp.array(dtype=real),
        other_density: wp.array(dtype=real),
        by: sums,
        # in and out
        own: given,
        pushed_other: wp.array(dtype=vector),
        twisted_other: wp.array(dtype=vector),
    ):
        b = wp.tid()
        c = strength(time_step[b], density[b] * volumes[0], other_density[b] * volumes[1], is_free)
        own.pushed[b] = own.pushed[b] + c * by.push_sum[b]
        own.twisted[b] = own.twisted[b] + c * by.twist_sum[b]
        if is_free:
            pushed_other[b] = pushed_other[b] - c * by.push_sum[b]
            twisted_other[b] = twisted_other[b] - c * by.other_sum[b]

    @wp.kernel(module=module, enable_backward=False)
    def give_tangent(
        is_free: bool,
        volumes: pair,
        time_step: wp.array(dtype=real),
        density: wp.array(dtype=real),
        other_density: wp.array(dtype=real),
        dot: bundle(time_step=real, density=real, other_density=real, pushed=vector, twisted=vector),
        by: sums,
        by_dot: sum_dots,
        # in and out, with the last two of ``dot``
        pushed_other_dot: wp.array(dtype=vector),
        twisted_other_dot: wp.array(dtype=vector),
    ):
        b = wp.tid()
        dt, m, m_other = time_step[b], density[b] * volumes[0], other_density[b] * volumes[1]
        c = strength(dt, m, m_other, is_free)
        mass_dot = part(m, m_other, is_free) * volumes[0] * dot.density[b]
        if is_free:
            mass_dot += part(m_other, m, is_free) * volumes[1] * dot.other_density[b]
        c_dot = stiffness * mass_dot / dt - c * dot.time_step[b] / dt
        dot.pushed[b] = dot.pushed[b] + c_dot * by.push_sum[b] + c * by_dot.push_sum_dot[b]
        dot.twisted[b] = dot.twisted[b] + c_dot * by.twist_sum[b] + c * by_dot.twist_sum_dot[b]
        if is_free:
            pushed_other_dot[b] = pushed_other_dot[b] - c_dot * by.push_sum[b] - c * by_dot.push_sum_dot[b]
            twisted_other_dot[b] = twisted_other_dot[b] - c_dot * by.other_sum[b] - c * by_dot.other_sum_dot[b]

    @wp.kernel(module=module, enable_backward=False)
    def give_adjoint(
        is_free: bool,
        volumes: pair,
        time_step: wp.array(dtype=real),
        density: wp.array(dtype=real),
        other_density: wp.array(dtype=real),
        by: sums,
        own_bar: bundle(pushed_bar=vector, twisted_bar=vector),
        pushed_other_bar: wp.array(dtype=vector),
        twisted_other_bar: wp.array(dtype=vector),
        # in and out
        bar: bundle(time_step=real, density=real),
        other_density_bar: wp.array(dtype=real),
        # out
        share_bar: bars,
    ):
        b = wp.tid()
        dt, m, m_other = time_step[b], density[b] * volumes[0], other_density[b] * volumes[1]
        c, twist_bar, from_other, other_bar = (
            strength(dt, m, m_other, is_free),
            own_bar.twisted_bar[b],
            vector(),
            vector(),
        )
        if is_free:
            from_other = -pushed_other_bar[b]
            other_bar = -twisted_other_bar[b]
        push_bar = own_bar.pushed_bar[b] + from_other
        c_bar = (
            wp.dot(by.push_sum[b], push_bar) + wp.dot(by.twist_sum[b], twist_bar) + wp.dot(by.other_sum[b], other_bar)
        )
        mass_bar = stiffness * c_bar / dt
        bar.density[b] = bar.density[b] + mass_bar * part(m, m_other, is_free) * volumes[0]
        bar.time_step[b] = bar.time_step[b] - c_bar * c / dt
        if is_free:
            other_density_bar[b] = other_density_bar[b] + mass_bar * part(m_other, m, is_free) * volumes[1]
        share_bar.push_bar[b] = c * push_bar
        share_bar.twist_bar[b] = c * twist_bar
        share_bar.other_bar[b] = c * other_bar

    return Kernels(give, give_tangent, give_adjoint)
