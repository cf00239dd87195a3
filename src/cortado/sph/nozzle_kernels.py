"""Fluid that comes out of a nozzle: particles are led along it until they pass its opening, and then are free.

A particle that starts u upstream of the opening, o beside the axis, is led after step n = 0, 1, ..., at t = (n + 1)
dt, while s = u - w t > 0, w = Q / A:

    x = q_n + o - s e,   v = (q_n - q_(n-1)) / dt + w e

q_n is where the opening is after step n (it rests before the first), e its direction, Q the flow rate and A its area.
Position and velocity do not jump when a particle becomes free. A run that goes on with another one counts its steps
from where that began, and the opening moves from where that left it.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.kernels import Kernels
from cortado.device.precision import Precision
from cortado.sph.integration import integration_module


@dataclass(frozen=True)
class NozzleKernels(Kernels):
    """The kernels of the end of a step, in the scene's order of particles."""

    collect: Any
    """Adds up what led particles leave to the adjoints of the parameters, in one thread."""


@cache
def nozzle_kernels(precision: Precision) -> NozzleKernels:
    """The kernels for a precision. ``nozzle_path`` (steps,) is that of the opening, ``before`` (1,) how
    many steps an earlier run took, and ``outlet`` (1,) where it left the opening."""
    real, vector = precision.real, precision.vector

    @wp.func
    def taken(n: int, before: wp.array(dtype=wp.int32)) -> real:
        """Steps that have been taken at the end of step n."""
        return real(before[0] + n + 1)

    @wp.func
    def left(
        i: int,
        first: int,
        upstream: wp.array(dtype=real),
        area: real,
        flow_rate: wp.array(dtype=real),
        time_step: wp.array(dtype=real),
        before: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int32),
    ) -> real:
        """s of a particle; 0 for one that is no part of the emitter."""
        if i < first:
            return real(0.0)
        return upstream[i - first] - flow_rate[0] / area * (taken(step[0], before) * time_step[0])

    @wp.func
    def advance(
        nozzle_path: wp.array(dtype=vector), n: int, before: wp.array(dtype=wp.int32), outlet: wp.array(dtype=vector)
    ) -> vector:
        """q_n - q_(n-1)"""
        if n == 0 and before[0] > 0:
            return nozzle_path[0] - outlet[0]
        return nozzle_path[n] - nozzle_path[wp.max(n - 1, 0)]

    @wp.kernel(module=integration_module(precision, True))
    def lead(
        first: int,
        upstream: wp.array(dtype=real),
        offsets: wp.array(dtype=vector),
        direction: vector,
        area: real,
        nozzle_path: wp.array(dtype=vector),
        flow_rate: wp.array(dtype=real),
        time_step: wp.array(dtype=real),
        before: wp.array(dtype=wp.int32),
        outlet: wp.array(dtype=vector),
        step: wp.array(dtype=wp.int32),
        x_free: wp.array(dtype=vector),
        v_free: wp.array(dtype=vector),
        # out
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
    ):
        i = wp.tid()
        s = left(i, first, upstream, area, flow_rate, time_step, before, step)
        if s > real(0.0):
            n = step[0]
            x[i] = nozzle_path[n] + offsets[i - first] - s * direction
            v[i] = advance(nozzle_path, n, before, outlet) / time_step[0] + (flow_rate[0] / area) * direction
        else:
            x[i] = x_free[i]
            v[i] = v_free[i]

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def lead_tangent(
        first: int,
        upstream: wp.array(dtype=real),
        direction: vector,
        area: real,
        nozzle_path: wp.array(dtype=vector),
        nozzle_path_dot: wp.array(dtype=vector),
        flow_rate: wp.array(dtype=real),
        flow_rate_dot: wp.array(dtype=real),
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        before: wp.array(dtype=wp.int32),
        outlet: wp.array(dtype=vector),
        outlet_dot: wp.array(dtype=vector),
        step: wp.array(dtype=wp.int32),
        # in and out
        x_dot: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
    ):
        i = wp.tid()
        if left(i, first, upstream, area, flow_rate, time_step, before, step) > real(0.0):
            n = step[0]
            dt = time_step[0]
            way = flow_rate_dot[0] * dt + flow_rate[0] * time_step_dot[0]
            turn_dot = advance(nozzle_path_dot, n, before, outlet_dot)
            turn = turn_dot - advance(nozzle_path, n, before, outlet) * (time_step_dot[0] / dt)
            x_dot[i] = nozzle_path_dot[n] + (taken(n, before) * way / area) * direction
            v_dot[i] = turn / dt + (flow_rate_dot[0] / area) * direction

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def lead_adjoint(
        first: int,
        upstream: wp.array(dtype=real),
        area: real,
        flow_rate: wp.array(dtype=real),
        time_step: wp.array(dtype=real),
        before: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int32),
        x_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
        # out
        x_free_bar: wp.array(dtype=vector),
        v_free_bar: wp.array(dtype=vector),
        x_led_bar: wp.array(dtype=vector),
        v_led_bar: wp.array(dtype=vector),
    ):
        """What reaches free particles, and what reaches led ones."""
        i = wp.tid()
        led = left(i, first, upstream, area, flow_rate, time_step, before, step) > real(0.0)
        x_free_bar[i] = wp.where(led, vector(), x_bar[i])
        v_free_bar[i] = wp.where(led, vector(), v_bar[i])
        x_led_bar[i] = wp.where(led, x_bar[i], vector())
        v_led_bar[i] = wp.where(led, v_bar[i], vector())

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def collect(
        direction: vector,
        area: real,
        nozzle_path: wp.array(dtype=vector),
        flow_rate: wp.array(dtype=real),
        time_step: wp.array(dtype=real),
        before: wp.array(dtype=wp.int32),
        outlet: wp.array(dtype=vector),
        step: wp.array(dtype=wp.int32),
        x_total: wp.array(dtype=vector),
        v_total: wp.array(dtype=vector),
        # in and out
        nozzle_path_bar: wp.array(dtype=vector),
        flow_rate_bar: wp.array(dtype=real),
        time_step_bar: wp.array(dtype=real),
    ):
        n = step[0]
        dt = time_step[0]
        x_bar = x_total[0]
        v_bar = v_total[0]
        last = wp.max(n - 1, 0)
        nozzle_path_bar[n] = nozzle_path_bar[n] + x_bar + v_bar / dt
        if n > 0 or before[0] == 0:
            nozzle_path_bar[last] = nozzle_path_bar[last] - v_bar / dt
        along = taken(n, before) * wp.dot(direction, x_bar) / area
        flow_rate_bar[0] = flow_rate_bar[0] + along * dt + wp.dot(direction, v_bar) / area
        turn = wp.dot(v_bar, advance(nozzle_path, n, before, outlet)) / (dt * dt)
        time_step_bar[0] = time_step_bar[0] + along * flow_rate[0] - turn

    return NozzleKernels(lead, lead_tangent, lead_adjoint, collect)
