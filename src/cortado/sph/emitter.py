"""Fluid that comes out of a nozzle: particles are prescribed until they pass its opening, and then are free.

A particle starts u upstream of the opening, o beside the axis. It is prescribed in step n = 0, 1, ..., while it is s =
u - l > 0 upstream, where l grows by w dt in each step, w = Q / A:

    x = q_n + o - s e,   v = (q_n - q_(n-1)) / dt + w e

q_n is where the opening is after step n (it rests before the first), e its direction, Q the flow rate and A its area.
Position and velocity do not jump when a particle becomes free. Particles in reserve, further upstream than the column
is long, are elsewhere, by a constant vector, until they join its end.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import bundle
from cortado.device.modules import Kernels
from cortado.device.precision import Precision
from cortado.particles.particle_kernels import particle_kernel
from cortado.particles.state import POSITIONS, VELOCITIES, Entry, Layout, Parameters, State, StateField, to_device
from cortado.scene.parameters import Axis
from cortado.sph.integration import integration_module
from cortado.sph.parts import Part, PartAdjoint, PartTangent, StepContext, Tangents


@dataclass(frozen=True)
class EmitterKernels(Kernels):
    """The kernels of an emitter at the end of a step, in scene order; ``begin`` and ``collect`` work by scene."""

    begin: Any
    """Keeps q_(n-1) of the state before a step, and l at its end, as a step may write over the state that it reads."""
    begin_tangent: Any
    collect: Any
    """Adds the adjoints left by prescribed particles to those of the parameters and of the state before."""


@cache
def nozzle_type(precision: Precision) -> Any:
    """Make the Warp struct of an emitter's constants; its arrays are of the particles of one scene from ``first``
    on."""
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
        """Distance of particles in reserve from their place in line [m]."""
        area: real
        """A [m^(d - 1)]"""

    Nozzle.__name__ = Nozzle.__qualname__ = f"Nozzle_{precision.name}"
    return wp.struct(Nozzle)


@cache
def emitter_kernels(precision: Precision, taped: bool) -> EmitterKernels:
    """Make the kernels of an emitter for a precision. Of each scene, ``outlet`` (members,) is q_(n-1) [m], ``emitted``
    (members,) l at the end of the step [m]."""
    real, vector, nozzle_of = precision.real, precision.vector, nozzle_type(precision)
    changes = bundle(outlet=vector, emitted=wp.float64, flow_rate=real, time_step=real)

    @wp.func
    def advance(flow_rate: real, area: real, time_step: real) -> wp.float64:
        """Return w dt, how far the column of fluid moves in a step [m]."""
        return wp.float64(flow_rate) / wp.float64(area) * wp.float64(time_step)

    @wp.func
    def remaining(p: int, nozzle: nozzle_of, emitted: wp.float64) -> real:
        """Return how far a particle is upstream of the opening, s [m]; 0 for one that is no part of the emitter."""
        if p < nozzle.first:
            return real(0.0)
        return real(wp.float64(nozzle.upstream[p - nozzle.first]) - emitted)

    @particle_kernel(integration_module(precision, True, taped), "outlet emitted", numbers=["nozzle"])
    def begin(
        nozzle: nozzle_of, flow_rate_i: real, time_step_i: real, outlet_in_i: vector, emitted_in_i: wp.float64
    ) -> tuple[vector, wp.float64]:
        return outlet_in_i, emitted_in_i + advance(flow_rate_i, nozzle.area, time_step_i)

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

    @particle_kernel(integration_module(precision, False), "outlet_dot emitted_dot", numbers=["nozzle"])
    def begin_tangent(
        nozzle: nozzle_of,
        flow_rate_i: real,
        flow_rate_dot_i: real,
        time_step_i: real,
        time_step_dot_i: real,
        outlet_in_dot_i: vector,
        emitted_in_dot_i: wp.float64,
    ) -> tuple[vector, wp.float64]:
        faster = advance(flow_rate_dot_i, nozzle.area, time_step_i)
        longer = advance(flow_rate_i, nozzle.area, time_step_dot_i)
        return outlet_in_dot_i, emitted_in_dot_i + faster + longer

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

    @particle_kernel(
        integration_module(precision, False),
        "x_free_bar v_free_bar x_prescribed_bar v_prescribed_bar",
        numbers=["nozzle", "particles"],
    )
    def prescribe_adjoint(
        i: int, member: int, particles: int, nozzle: nozzle_of, emitted: wp.float64, x_bar_i: vector, v_bar_i: vector
    ) -> tuple[vector, vector, vector, vector]:
        """Split the adjoints of new positions and velocities into those of free and of prescribed particles."""
        prescribed = remaining(i - member * particles, nozzle, emitted) > real(0.0)
        return (
            wp.where(prescribed, vector(), x_bar_i),
            wp.where(prescribed, vector(), v_bar_i),
            wp.where(prescribed, x_bar_i, vector()),
            wp.where(prescribed, v_bar_i, vector()),
        )

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


OUTLET = StateField("outlet", "m", Entry.VECTOR, Axis.SCALAR, first="nozzle_path")
"""The position of the nozzle's opening."""
EMITTED = StateField("emitted", "m", Entry.DOUBLE, Axis.SCALAR)
"""The length of the column of fluid that has left the nozzle."""


@dataclass(frozen=True)
class Nozzle:
    """The particles that wait in a nozzle, the last ones of a scene: how far each is behind the opening and beside the
    axis, and the direction and the area of the opening."""

    first: int
    """Number of the first of them."""
    upstream: np.ndarray
    """(m,) distance from the opening [m]"""
    offsets: np.ndarray
    """(m, d) from the axis [m]"""
    direction: np.ndarray
    """(d,) of the flow, a unit vector"""
    area: float
    """Area of the opening [m2], in 2-D [m]."""
    column: float
    """Particles further upstream are in reserve [m]."""
    reserve: np.ndarray
    """Distance (d,) of particles in reserve from their place in line [m]."""

    def part(self, layout: Layout, requires_grad: bool) -> "Emitter":
        return Emitter(self, layout, requires_grad)


class Emitter(Part):
    """The part of a step that prescribes the particles which wait in a nozzle, in one solver."""

    fields = (OUTLET, EMITTED)
    """Fields that the emitter carries from step to step."""

    def __init__(self, nozzle: Nozzle, layout: Layout, requires_grad: bool = False):
        self.nozzle, self.layout = nozzle, layout
        self.free = layout.state((POSITIONS, VELOCITIES), requires_grad)
        """Room for the end of a step if no particle were prescribed."""
        precision, device = layout.precision, layout.device
        self.kernels = emitter_kernels(precision, requires_grad)
        constants = nozzle_type(precision)()
        constants.first, constants.area = nozzle.first, nozzle.area
        constants.upstream = wp.array(nozzle.upstream, dtype=precision.real, device=device)
        constants.offsets = to_device(nozzle.offsets, precision, device)
        constants.column, padding = nozzle.column, (0, 3 - len(nozzle.direction))
        constants.direction = precision.vector(*np.pad(nozzle.direction, padding))
        constants.reserve = precision.vector(*np.pad(nozzle.reserve, padding))
        self.constants = {"nozzle": constants, **layout.state(self.fields, requires_grad).named()}
        """Of the nozzle, and of a step once it has begun, for kernels."""

    def begin(self, step: StepContext, state: State) -> None:
        """Keep the nozzle's fields of the state before the step, which the end of the step needs."""
        before = {"outlet_in": state["outlet"], "emitted_in": state["emitted"]}
        step.launch(self.kernels.begin, self.constants, **before, threads=self.layout.members)

    def target(self, moved: State) -> State:
        return self.free

    def end(self, step: StepContext, state: State, moved: State) -> None:
        free = {"x_free": self.free.positions, "v_free": self.free.velocities}
        new = {"outlet_out": state["outlet"], "emitted_out": state["emitted"]}
        step.launch(self.kernels.forward, self.constants, **free, x=moved.positions, v=moved.velocities, **new)

    def new_tangent(self) -> "EmitterTangent":
        return EmitterTangent(self)

    def new_adjoint(self) -> "EmitterAdjoint":
        return EmitterAdjoint(self)


class EmitterTangent(PartTangent):
    """The tangent of prescribed particles and of the nozzle, for forward mode."""

    def __init__(self, emitter: Emitter):
        self._emitter = emitter
        self._dot = emitter.layout.state(emitter.fields).named("_dot")

    def end(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        kernels, known = self._emitter.kernels, (self._emitter.constants, self._dot, dot.parameters.named("_dot"))
        outlet, emitted = state_dot["outlet"], state_dot["emitted"]
        before = {"outlet_in_dot": outlet, "emitted_in_dot": emitted}
        step.launch(kernels.begin_tangent, *known, **before, threads=self._emitter.layout.members)
        new = {"outlet_out_dot": outlet, "emitted_out_dot": emitted}
        moved = {"x_dot": state_dot.positions, "v_dot": state_dot.velocities}
        step.launch(kernels.tangent, *known, **moved, **new)


class EmitterAdjoint(PartAdjoint):
    """The adjoint of prescribed particles and of the nozzle, for reverse mode."""

    def __init__(self, emitter: Emitter):
        self._emitter = emitter
        self._free = emitter.free.like()
        """Adjoint of the end of a step if no particle were prescribed."""
        self._prescribed = emitter.free.like()
        layout = emitter.layout
        self._sums = [layout.sum_of(layout.precision.vector) for _ in range(2)]

    def end(self, step: StepContext, bar: Parameters, state_bar: State, moved_bar: State) -> State:
        """Return the adjoint of free particles; add that of prescribed ones to ``bar`` and to the adjoint of the
        nozzle, which becomes that before the step."""
        emitter, free, prescribed = self._emitter, self._free, self._prescribed
        step.launch(
            emitter.kernels.adjoint,
            emitter.constants,
            x_bar=moved_bar.positions,
            v_bar=moved_bar.velocities,
            x_free_bar=free.positions,
            v_free_bar=free.velocities,
            x_prescribed_bar=prescribed.positions,
            v_prescribed_bar=prescribed.velocities,
        )
        x_total, v_total = (add_up(x) for add_up, x in zip(self._sums, prescribed.arrays(), strict=True))
        own = {"outlet_bar": state_bar["outlet"], "emitted_bar": state_bar["emitted"]}
        totals = {"x_total": x_total, "v_total": v_total}
        collected = {**own, **totals, "threads": emitter.layout.members}
        step.launch(emitter.kernels.collect, emitter.constants, bar.named("_bar"), **collected)
        return free
