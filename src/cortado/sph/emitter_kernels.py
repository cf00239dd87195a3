"""Fluid that comes out of a nozzle: particles are prescribed until they pass its opening, and then are free.

A particle that starts u upstream of the opening, o beside the axis, is prescribed in step n = 0, 1, ..., while it is
s = u - l > 0 upstream, where l grows by w dt in each step, w = Q / A:

    x = q_n + o - s e,   v = (q_n - q_(n-1)) / dt + w e

q_n is where the opening is after step n (it rests before the first), e its direction, Q the flow rate and A its area.
Position and velocity do not jump when a particle becomes free.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.kernels import Kernels
from cortado.device.precision import Precision
from cortado.sph.integration import integration_module


@dataclass(frozen=True)
class EmitterKernels(Kernels):
    """The kernels of the end of a step, in the scene's order of particles; the others have one thread."""

    begin: Any
    """Keeps q_(n-1) of the state before a step, and l at its end, as a step may write over the state that it reads."""
    begin_tangent: Any
    collect: Any
    """Adds what prescribed particles leave to the adjoints of the parameters and of the state before."""


@cache
def emitter_kernels(precision: Precision, taped: bool) -> EmitterKernels:
    """The kernels for a precision. ``outlet`` (1,) is q_(n-1) [m], ``emitted`` (1,) l at the end of the step [m]."""
    real, vector = precision.real, precision.vector

    @wp.func
    def advance(flow_rate: real, area: real, time_step: real) -> wp.float64:
        """w dt"""
        return wp.float64(flow_rate) / wp.float64(area) * wp.float64(time_step)

    @wp.func
    def remaining(i: int, first: int, upstream: wp.array(dtype=real), emitted: wp.array(dtype=wp.float64)) -> real:
        """s of a particle; 0 for one that is no part of the emitter."""
        if i < first:
            return real(0.0)
        return real(wp.float64(upstream[i - first]) - emitted[0])

    @wp.kernel(module=integration_module(precision, True, taped))
    def begin(
        area: real,
        flow_rate: wp.array(dtype=real),
        time_step: wp.array(dtype=real),
        outlet_in: wp.array(dtype=vector),
        emitted_in: wp.array(dtype=wp.float64),
        # out
        outlet: wp.array(dtype=vector),
        emitted: wp.array(dtype=wp.float64),
    ):
        outlet[0] = outlet_in[0]
        emitted[0] = emitted_in[0] + advance(flow_rate[0], area, time_step[0])

    @wp.kernel(module=integration_module(precision, True, taped))
    def prescribe(
        first: int,
        upstream: wp.array(dtype=real),
        offsets: wp.array(dtype=vector),
        direction: vector,
        area: real,
        nozzle_path: wp.array(dtype=vector),
        flow_rate: wp.array(dtype=real),
        time_step: wp.array(dtype=real),
        step: wp.array(dtype=wp.int32),
        outlet: wp.array(dtype=vector),
        emitted: wp.array(dtype=wp.float64),
        x_free: wp.array(dtype=vector),
        v_free: wp.array(dtype=vector),
        # out
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        outlet_out: wp.array(dtype=vector),
        emitted_out: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        s = remaining(i, first, upstream, emitted)
        q = nozzle_path[step[0]]
        if s > real(0.0):
            x[i] = q + offsets[i - first] - s * direction
            v[i] = (q - outlet[0]) / time_step[0] + (flow_rate[0] / area) * direction
        else:
            x[i] = x_free[i]
            v[i] = v_free[i]
        if i == 0:
            outlet_out[0] = q
            emitted_out[0] = emitted[0]

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def begin_tangent(
        area: real,
        flow_rate: wp.array(dtype=real),
        flow_rate_dot: wp.array(dtype=real),
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        outlet_in_dot: wp.array(dtype=vector),
        emitted_in_dot: wp.array(dtype=wp.float64),
        # out
        outlet_dot: wp.array(dtype=vector),
        emitted_dot: wp.array(dtype=wp.float64),
    ):
        outlet_dot[0] = outlet_in_dot[0]
        faster = advance(flow_rate_dot[0], area, time_step[0])
        longer = advance(flow_rate[0], area, time_step_dot[0])
        emitted_dot[0] = emitted_in_dot[0] + faster + longer

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def prescribe_tangent(
        first: int,
        upstream: wp.array(dtype=real),
        direction: vector,
        area: real,
        nozzle_path: wp.array(dtype=vector),
        nozzle_path_dot: wp.array(dtype=vector),
        flow_rate_dot: wp.array(dtype=real),
        time_step: wp.array(dtype=real),
        time_step_dot: wp.array(dtype=real),
        step: wp.array(dtype=wp.int32),
        outlet: wp.array(dtype=vector),
        outlet_dot: wp.array(dtype=vector),
        emitted: wp.array(dtype=wp.float64),
        emitted_dot: wp.array(dtype=wp.float64),
        # in and out
        x_dot: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        # out
        outlet_out_dot: wp.array(dtype=vector),
        emitted_out_dot: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        n = step[0]
        if remaining(i, first, upstream, emitted) > real(0.0):
            dt = time_step[0]
            turn_dot = nozzle_path_dot[n] - outlet_dot[0] - (nozzle_path[n] - outlet[0]) * (time_step_dot[0] / dt)
            x_dot[i] = nozzle_path_dot[n] + real(emitted_dot[0]) * direction
            v_dot[i] = turn_dot / dt + (flow_rate_dot[0] / area) * direction
        if i == 0:
            outlet_out_dot[0] = nozzle_path_dot[n]
            emitted_out_dot[0] = emitted_dot[0]

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def prescribe_adjoint(
        first: int,
        upstream: wp.array(dtype=real),
        emitted: wp.array(dtype=wp.float64),
        x_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
        # out
        x_free_bar: wp.array(dtype=vector),
        v_free_bar: wp.array(dtype=vector),
        x_prescribed_bar: wp.array(dtype=vector),
        v_prescribed_bar: wp.array(dtype=vector),
    ):
        """What reaches free particles, and what reaches prescribed ones."""
        i = wp.tid()
        prescribed = remaining(i, first, upstream, emitted) > real(0.0)
        x_free_bar[i] = wp.where(prescribed, vector(), x_bar[i])
        v_free_bar[i] = wp.where(prescribed, vector(), v_bar[i])
        x_prescribed_bar[i] = wp.where(prescribed, x_bar[i], vector())
        v_prescribed_bar[i] = wp.where(prescribed, v_bar[i], vector())

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def collect(
        direction: vector,
        area: real,
        nozzle_path: wp.array(dtype=vector),
        flow_rate: wp.array(dtype=real),
        time_step: wp.array(dtype=real),
        step: wp.array(dtype=wp.int32),
        outlet: wp.array(dtype=vector),
        x_total: wp.array(dtype=vector),
        v_total: wp.array(dtype=vector),
        # in and out
        outlet_bar: wp.array(dtype=vector),
        emitted_bar: wp.array(dtype=wp.float64),
        nozzle_path_bar: wp.array(dtype=vector),
        flow_rate_bar: wp.array(dtype=real),
        time_step_bar: wp.array(dtype=real),
    ):
        n = step[0]
        dt = time_step[0]
        x_bar = x_total[0]
        v_bar = v_total[0]
        nozzle_path_bar[n] = nozzle_path_bar[n] + outlet_bar[0] + x_bar + v_bar / dt
        outlet_bar[0] = -v_bar / dt
        emitted_bar[0] = emitted_bar[0] + wp.float64(wp.dot(direction, x_bar))
        along = real(emitted_bar[0]) / area
        flow_rate_bar[0] = flow_rate_bar[0] + along * dt + wp.dot(direction, v_bar) / area
        turn = wp.dot(v_bar, nozzle_path[n] - outlet[0]) / (dt * dt)
        time_step_bar[0] = time_step_bar[0] + along * flow_rate[0] - turn

    return EmitterKernels(prescribe, prescribe_tangent, prescribe_adjoint, begin, begin_tangent, collect)
