"""Fluid that comes out of a nozzle: particles are prescribed until they pass its opening, and then are free.

A particle that starts u upstream of the opening, o beside the axis, is prescribed in step n = 0, 1, ..., while it is
s = u - l > 0 upstream, where l grows by w dt in each step, w = Q / A:

    x = q_n + o - s e,   v = (q_n - q_(n-1)) / dt + w e

q_n is where the opening is after step n (it rests before the first), e its direction, Q the flow rate and A its area.
Position and velocity do not jump when a particle becomes free. Particles in reserve, further upstream than the column
is long, are elsewhere, by a constant vector, until they join its end.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.sph.integration import integration_module


@dataclass(frozen=True)
class EmitterKernels(Kernels):
    """The kernels of the end of a step, in the scene's order of particles; the others have one thread a scene."""

    begin: Any
    """Keeps q_(n-1) of the state before a step, and l at its end, as a step may write over the state that it reads."""
    begin_tangent: Any
    collect: Any
    """Adds what prescribed particles leave to the adjoints of the parameters and of the state before."""


@cache
def nozzle_type(precision: Precision) -> Any:
    """The Warp struct of what does not change of an emitter; its arrays are of the particles of one scene from
    ``first`` on."""
    real, vector = precision.real, precision.vector

    class Nozzle:
        first: wp.int32
        """Number of its first particle."""
        upstream: wp.array(dtype=real)
        """u [m]"""
        offsets: wp.array(dtype=vector)
        """o [m]"""
        direction: vector
        """e"""
        column: real
        """Particles further upstream are in reserve [m]."""
        reserve: vector
        """How far these are from their place in line [m]."""
        area: real
        """A [m^(d - 1)]"""

    Nozzle.__name__ = Nozzle.__qualname__ = f"Nozzle_{precision.name}"
    return wp.struct(Nozzle)


@cache
def emitter_kernels(precision: Precision, taped: bool) -> EmitterKernels:
    """The kernels for a precision. Of each scene b, ``outlet`` (members,) is q_(n-1) [m], ``emitted`` (members,) l at
    the end of the step [m]."""
    real, vector, nozzle_of = precision.real, precision.vector, nozzle_type(precision)
    changes = bundle(outlet=vector, emitted=wp.float64, flow_rate=real, time_step=real)

    @wp.func
    def advance(flow_rate: real, area: real, time_step: real) -> wp.float64:
        """w dt"""
        return wp.float64(flow_rate) / wp.float64(area) * wp.float64(time_step)

    @wp.func
    def remaining(p: int, nozzle: nozzle_of, emitted: wp.float64) -> real:
        """s of a particle; 0 for one that is no part of the emitter."""
        if p < nozzle.first:
            return real(0.0)
        return real(wp.float64(nozzle.upstream[p - nozzle.first]) - emitted)

    @wp.kernel(module=integration_module(precision, True, taped))
    def begin(
        nozzle: nozzle_of,
        flow_rate: wp.array(dtype=real),
        time_step: wp.array(dtype=real),
        outlet_in: wp.array(dtype=vector),
        emitted_in: wp.array(dtype=wp.float64),
        # out
        outlet: wp.array(dtype=vector),
        emitted: wp.array(dtype=wp.float64),
    ):
        b = wp.tid()
        outlet[b] = outlet_in[b]
        emitted[b] = emitted_in[b] + advance(flow_rate[b], nozzle.area, time_step[b])

    @wp.kernel(module=integration_module(precision, True, taped))
    def prescribe(
        particles: int,
        nozzle: nozzle_of,
        nozzle_path: wp.array2d(dtype=vector),
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
        b = i // particles
        p = i - b * particles
        s = remaining(p, nozzle, emitted[b])
        q = nozzle_path[b, step[b]]
        if s > real(0.0):
            place = q + nozzle.offsets[p - nozzle.first] - s * nozzle.direction
            x[i] = wp.where(s > nozzle.column, place + nozzle.reserve, place)
            v[i] = (q - outlet[b]) / time_step[b] + (flow_rate[b] / nozzle.area) * nozzle.direction
        else:
            x[i] = x_free[i]
            v[i] = v_free[i]
        if p == 0:
            outlet_out[b] = q
            emitted_out[b] = emitted[b]

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def begin_tangent(
        nozzle: nozzle_of,
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
        b = wp.tid()
        outlet_dot[b] = outlet_in_dot[b]
        faster = advance(flow_rate_dot[b], nozzle.area, time_step[b])
        longer = advance(flow_rate[b], nozzle.area, time_step_dot[b])
        emitted_dot[b] = emitted_in_dot[b] + faster + longer

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def prescribe_tangent(
        particles: int,
        nozzle: nozzle_of,
        nozzle_path: wp.array2d(dtype=vector),
        nozzle_path_dot: wp.array2d(dtype=vector),
        time_step: wp.array(dtype=real),
        step: wp.array(dtype=wp.int32),
        outlet: wp.array(dtype=vector),
        emitted: wp.array(dtype=wp.float64),
        dot: changes,
        # in and out
        x_dot: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        # out
        outlet_out_dot: wp.array(dtype=vector),
        emitted_out_dot: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        b = i // particles
        p = i - b * particles
        q = nozzle_path[b, step[b]]
        q_dot = nozzle_path_dot[b, step[b]]
        if remaining(p, nozzle, emitted[b]) > real(0.0):
            dt = time_step[b]
            turn_dot = q_dot - dot.outlet[b] - (q - outlet[b]) * (dot.time_step[b] / dt)
            x_dot[i] = q_dot + real(dot.emitted[b]) * nozzle.direction
            v_dot[i] = turn_dot / dt + (dot.flow_rate[b] / nozzle.area) * nozzle.direction
        if p == 0:
            outlet_out_dot[b] = q_dot
            emitted_out_dot[b] = dot.emitted[b]

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def prescribe_adjoint(
        particles: int,
        nozzle: nozzle_of,
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
        b = i // particles
        prescribed = remaining(i - b * particles, nozzle, emitted[b]) > real(0.0)
        x_free_bar[i] = wp.where(prescribed, vector(), x_bar[i])
        v_free_bar[i] = wp.where(prescribed, vector(), v_bar[i])
        x_prescribed_bar[i] = wp.where(prescribed, x_bar[i], vector())
        v_prescribed_bar[i] = wp.where(prescribed, v_bar[i], vector())

    @wp.kernel(module=integration_module(precision, False), enable_backward=False)
    def collect(
        nozzle: nozzle_of,
        nozzle_path: wp.array2d(dtype=vector),
        flow_rate: wp.array(dtype=real),
        time_step: wp.array(dtype=real),
        step: wp.array(dtype=wp.int32),
        outlet: wp.array(dtype=vector),
        x_total: wp.array(dtype=vector),
        v_total: wp.array(dtype=vector),
        # in and out
        outlet_bar: wp.array(dtype=vector),
        emitted_bar: wp.array(dtype=wp.float64),
        nozzle_path_bar: wp.array2d(dtype=vector),
        flow_rate_bar: wp.array(dtype=real),
        time_step_bar: wp.array(dtype=real),
    ):
        b = wp.tid()
        n = step[b]
        dt = time_step[b]
        x_bar = x_total[b]
        v_bar = v_total[b]
        nozzle_path_bar[b, n] = nozzle_path_bar[b, n] + outlet_bar[b] + x_bar + v_bar / dt
        outlet_bar[b] = -v_bar / dt
        emitted_bar[b] = emitted_bar[b] + wp.float64(wp.dot(nozzle.direction, x_bar))
        along = real(emitted_bar[b]) / nozzle.area
        flow_rate_bar[b] = flow_rate_bar[b] + along * dt + wp.dot(nozzle.direction, v_bar) / nozzle.area
        turn = wp.dot(v_bar, nozzle_path[b, n] - outlet[b]) / (dt * dt)
        time_step_bar[b] = time_step_bar[b] + along * flow_rate[b] - turn

    return EmitterKernels(prescribe, prescribe_tangent, prescribe_adjoint, begin, begin_tangent, collect)
