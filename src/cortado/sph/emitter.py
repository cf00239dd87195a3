"""Fluid that comes out of a nozzle: particles are prescribed until they pass its opening, and then are free.

A particle starts u upstream of the opening, o beside the axis. It is prescribed in step n = 0, 1, ..., while it is s =
u - l > 0 upstream, where l grows by w dt in each step, w = Q / A:

    x = q_n + o - s e,   v = (q_n - q_(n-1)) / dt + w e

q_n is where the opening is after step n (it rests before the first), e its direction, Q the flow rate and A its area.
Position and velocity do not jump when a particle becomes free. Particles in reserve are further upstream than the
column is long. They wait elsewhere, displaced by a constant vector, until they join its end.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from cortado.device.modules import Kernels
from cortado.device.precision import Precision, TypesByName
from cortado.particles.particle_kernels import particle_kernel
from cortado.particles.state import POSITIONS, VELOCITIES, Entry, Layout, Parameters, State, StateField, to_device
from cortado.scene.parameters import Axis
from cortado.sph.integration import integration_module
from cortado.sph.parts import Part, PartAdjoint, PartTangent, StepContext, Tangents


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
def emitter_kernels(precision: Precision, taped: bool) -> tuple[Kernels, Kernels]:
    """Make the kernels of the motion of the column of fluid in a step, with a thread for each scene, and those of
    particles at its end, in scene order. The adjoint of the motion takes sums of the adjoints of prescribed positions
    and velocities. Of each scene, (members,), ``outlet`` is q_n [m], ``drift`` the velocity of prescribed particles
    [m/s], and ``emitted`` l at the end of the step [m]."""
    real, vector, nozzle_of = precision.real, precision.vector, nozzle_type(precision)
    module, derivatives = integration_module(precision, True, taped), integration_module(precision, False)
    numbers, path = ["nozzle", "particles"], wp.array2d(dtype=vector)
    own = {nozzle_of: "nozzle", path: "nozzle_path", wp.int32: "step", wp.float64: "emitted"}
    typed = TypesByName(real, {vector: "outlet drift x v", **own})

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

    @particle_kernel(module, "outlet drift emitted", numbers=["nozzle"])
    @typed
    def begin(
        i: int, nozzle, nozzle_path, step_i, flow_rate_i, time_step_i, outlet_in_i, emitted_in_i
    ) -> tuple[vector, vector, wp.float64]:
        q = nozzle_path[i, step_i]
        drift = (q - outlet_in_i) / time_step_i + (flow_rate_i / nozzle.area) * nozzle.direction
        return q, drift, emitted_in_i + advance(flow_rate_i, nozzle.area, time_step_i)

    @particle_kernel(derivatives, "outlet_dot drift_dot emitted_dot", numbers=["nozzle"])
    @typed
    def begin_tangent(
        i: int,
        nozzle,
        nozzle_path_dot,
        step_i,
        flow_rate_i,
        flow_rate_dot_i,
        time_step_i,
        time_step_dot_i,
        drift_i,
        outlet_in_dot_i,
        emitted_in_dot_i,
    ) -> tuple[vector, vector, wp.float64]:
        q_dot, along = nozzle_path_dot[i, step_i], nozzle.direction / nozzle.area
        turn = drift_i - flow_rate_i * along
        drift_dot = (q_dot - outlet_in_dot_i - time_step_dot_i * turn) / time_step_i + flow_rate_dot_i * along
        faster = advance(flow_rate_dot_i, nozzle.area, time_step_i)
        return q_dot, drift_dot, emitted_in_dot_i + faster + advance(flow_rate_i, nozzle.area, time_step_dot_i)

    @particle_kernel(derivatives, "outlet_bar emitted_bar +flow_rate_bar +time_step_bar", numbers=["nozzle"])
    @typed
    def begin_adjoint(
        i: int,
        nozzle,
        nozzle_path_bar,
        step_i,
        flow_rate_i,
        time_step_i,
        drift_i,
        x_total_i,
        v_total_i,
        outlet_bar_i,
        emitted_bar_i,
    ) -> tuple[vector, wp.float64, real, real]:
        nozzle_path_bar[i, step_i] = nozzle_path_bar[i, step_i] + outlet_bar_i + x_total_i + v_total_i / time_step_i
        along, whole = nozzle.direction / nozzle.area, emitted_bar_i + wp.float64(wp.dot(nozzle.direction, x_total_i))
        further, turn = real(whole) / nozzle.area, drift_i - flow_rate_i * along
        faster, longer = wp.dot(along, v_total_i), -wp.dot(v_total_i, turn) / time_step_i
        return -v_total_i / time_step_i, whole, further * time_step_i + faster, further * flow_rate_i + longer

    @particle_kernel(module, "x v", numbers=numbers)
    @typed
    def prescribe(
        i: int, member: int, particles: int, nozzle, outlet, drift, emitted, x_free_i, v_free_i
    ) -> tuple[vector, vector]:
        p = i - member * particles
        s, x, v = remaining(p, nozzle, emitted), x_free_i, v_free_i
        if s > real(0.0):
            place = outlet + nozzle.offsets[p - nozzle.first] - s * nozzle.direction
            x = wp.where(s > nozzle.column, place + nozzle.reserve, place)
            v = drift
        return x, v

    @particle_kernel(derivatives, "x_dot v_dot", numbers=numbers)
    @typed
    def prescribe_tangent(
        i: int, member: int, particles: int, nozzle, emitted, outlet_dot, drift_dot, emitted_dot, x_dot_i, v_dot_i
    ) -> tuple[vector, vector]:
        if remaining(i - member * particles, nozzle, emitted) > real(0.0):
            return outlet_dot + real(emitted_dot) * nozzle.direction, drift_dot
        return x_dot_i, v_dot_i

    @particle_kernel(derivatives, "x_free_bar v_free_bar x_prescribed_bar v_prescribed_bar", numbers=numbers)
    @typed
    def prescribe_adjoint(
        i: int, member: int, particles: int, nozzle, emitted, x_bar_i, v_bar_i
    ) -> tuple[vector, vector, vector, vector]:
        """Split the adjoints of new positions and velocities into those of free and of prescribed particles."""
        led, no = remaining(i - member * particles, nozzle, emitted) > real(0.0), vector()
        x_free_bar, v_free_bar = wp.where(led, no, x_bar_i), wp.where(led, no, v_bar_i)
        return x_free_bar, v_free_bar, wp.where(led, x_bar_i, no), wp.where(led, v_bar_i, no)

    begins = Kernels(begin, begin_tangent, begin_adjoint)
    return begins, Kernels(prescribe, prescribe_tangent, prescribe_adjoint)


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
        self.begins, self.ends = emitter_kernels(precision, requires_grad)
        constants = nozzle_type(precision)()
        constants.first, constants.area = nozzle.first, nozzle.area
        constants.upstream = wp.array(nozzle.upstream, dtype=precision.real, device=device)
        constants.offsets = to_device(nozzle.offsets, precision, device)
        constants.column, padding = nozzle.column, (0, 3 - len(nozzle.direction))
        constants.direction = precision.vector(*np.pad(nozzle.direction, padding))
        constants.reserve = precision.vector(*np.pad(nozzle.reserve, padding))
        drift = wp.zeros(layout.members, dtype=precision.vector, device=device, requires_grad=requires_grad)
        self.constants = {"nozzle": constants, "drift": drift, **layout.state(self.fields, requires_grad).named()}
        """Of the nozzle, and of a step once it has begun, for kernels."""

    def begin(self, step: StepContext, state: State) -> None:
        """Compute the motion of the column in the step, from the state before it, which the end may write over."""
        before = {"outlet_in": state["outlet"], "emitted_in": state["emitted"]}
        step.launch(self.begins.forward, self.constants, **before, threads=self.layout.members)

    def target(self, moved: State) -> State:
        return self.free

    def end(self, step: StepContext, state: State, moved: State) -> None:
        free = {"x_free": self.free.positions, "v_free": self.free.velocities}
        step.launch(self.ends.forward, self.constants, **free, x=moved.positions, v=moved.velocities)
        for field in self.fields:
            wp.copy(state[field.name], self.constants[field.name])

    def new_tangent(self) -> "EmitterTangent":
        return EmitterTangent(self)

    def new_adjoint(self) -> "EmitterAdjoint":
        return EmitterAdjoint(self)


class EmitterTangent(PartTangent):
    """The tangent of prescribed particles and of the nozzle, for forward mode."""

    def __init__(self, emitter: Emitter):
        self._emitter = emitter
        drift_dot = wp.zeros_like(emitter.constants["drift"], requires_grad=False)
        self._dot = {"drift_dot": drift_dot, **emitter.layout.state(emitter.fields).named("_dot")}

    def end(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        known = self._emitter.constants, self._dot, dot.parameters.named("_dot")
        before = {f"{field.name}_in_dot": state_dot[field.name] for field in self._emitter.fields}
        step.launch(self._emitter.begins.tangent, *known, **before, threads=self._emitter.layout.members)
        step.launch(self._emitter.ends.tangent, *known, x_dot=state_dot.positions, v_dot=state_dot.velocities)
        for field in self._emitter.fields:
            wp.copy(state_dot[field.name], self._dot[f"{field.name}_dot"])


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
            emitter.ends.adjoint,
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
        step.launch(emitter.begins.adjoint, emitter.constants, bar.named("_bar"), **collected)
        return free
