"""Fluid from a nozzle: the motion of particles is prescribed until they pass the opening of the nozzle.

`docs/discretisation.md` has the equations of the motion. Position and velocity of a particle do not jump at the
opening. Particles further upstream than the length of the emitted column wait in reserve at separate places, without
derivative.

A nozzle fed by drains emits removed particles again. When the column has room for a layer at its upstream end, removed
particles form this layer, with the offsets of the first particles. The choice of removed particles has no derivative.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from cortado.device.modules import Kernels
from cortado.device.precision import Precision, TypesByName, struct_of
from cortado.particles.particle_kernels import particle_kernel
from cortado.particles.state import POSITIONS, VELOCITIES, Entry, Layout, Parameters, State, StateField, to_device
from cortado.scene.emitter_table import EmitterSample, again_name, emitted_name, outlet_name, path_name
from cortado.scene.parameters import Axis
from cortado.sph.parts import Part, PartAdjoint, PartTangent, StepContext, Tangents, integration_module


@cache
def nozzle_type(precision: Precision) -> Any:
    real, vector = precision.real, precision.vector
    particles = dict.fromkeys(("first", "count", "layer"), wp.int32)
    arrays = {"upstream": wp.array(dtype=real), "offsets": wp.array(dtype=vector)}
    sizes = {"direction": vector, "column": real, "spacing": wp.float64, "area": real}
    return struct_of("Nozzle", precision, **particles, **arrays, **sizes)


@cache
def remaining_function(precision: Precision) -> Any:
    """A particle's distance upstream of the opening [m] is at most 0 if the particle is free."""
    real, nozzle_of = precision.real, nozzle_type(precision)

    @wp.func
    def remaining(p: int, nozzle: nozzle_of, serial: wp.float64, emitted: wp.float64) -> real:
        if serial > wp.float64(0.0):
            number = wp.floor((serial - wp.float64(1.0)) / wp.float64(nozzle.layer))
            return real((number + wp.float64(0.5)) * nozzle.spacing - emitted)
        if p < nozzle.first or p >= nozzle.first + nozzle.count:
            return real(0.0)
        return real(wp.float64(nozzle.upstream[p - nozzle.first]) - emitted)

    return remaining


@cache
def emitter_kernels(precision: Precision, taped: bool) -> tuple[Kernels, Kernels]:
    """``outlet`` (members,) is the position of the opening [m], and ``drift`` the velocity of waiting particles [m/s].
    ``emitted`` is the length of the emitted column [m]."""
    real, vector, nozzle_of = precision.real, precision.vector, nozzle_type(precision)
    module, derivatives = (integration_module(precision, *one, topic="emitter") for one in ((True, taped), (False,)))
    numbers, remaining = ["nozzle", "particles"], remaining_function(precision)
    own = {nozzle_of: "nozzle", wp.array2d(dtype=vector): "path", wp.array2d(dtype=real): "flow"}
    own |= {wp.int32: "i member particles step", wp.float64: "emitted serial", wp.array(dtype=vector): "places"}
    typed = TypesByName(real, {vector: "outlet q drift x v", **own})

    @wp.func
    def advance(flow_rate: real, area: real, time_step: real) -> wp.float64:
        return wp.float64(flow_rate) / wp.float64(area) * wp.float64(time_step)

    @particle_kernel(module, "outlet drift emitted", numbers=["nozzle"], typed=typed)
    def begin(i, nozzle, path, flow, step_i, time_step_i, q_in_i, emitted_in_i) -> tuple[vector, vector, wp.float64]:
        q, flow_rate = path[i, step_i], flow[i, step_i]
        drift = (q - q_in_i) / time_step_i + (flow_rate / nozzle.area) * nozzle.direction
        return q, drift, emitted_in_i + advance(flow_rate, nozzle.area, time_step_i)

    @particle_kernel(derivatives, "outlet_dot drift_dot emitted_dot", numbers=["nozzle"], typed=typed)
    def begin_tangent(
        i, nozzle, path_dot, flow, flow_dot, step_i, time_step_i, time_step_dot_i, drift_i, q_in_dot_i, emitted_in_dot_i
    ) -> tuple[vector, vector, wp.float64]:
        q_dot, along = path_dot[i, step_i], nozzle.direction / nozzle.area
        flow_rate, flow_rate_dot = flow[i, step_i], flow_dot[i, step_i]
        turn = drift_i - flow_rate * along
        drift_dot = (q_dot - q_in_dot_i - time_step_dot_i * turn) / time_step_i + flow_rate_dot * along
        faster = advance(flow_rate_dot, nozzle.area, time_step_i)
        return q_dot, drift_dot, emitted_in_dot_i + faster + advance(flow_rate, nozzle.area, time_step_dot_i)

    @particle_kernel(derivatives, "outlet_bar emitted_bar +time_step_bar", numbers=["nozzle"], typed=typed)
    def begin_adjoint(
        i, nozzle, path_bar, flow, flow_bar, step_i, time_step_i, drift_i, x_sum_i, v_sum_i, outlet_bar_i, emitted_bar_i
    ) -> tuple[vector, wp.float64, real]:
        path_bar[i, step_i] = path_bar[i, step_i] + outlet_bar_i + x_sum_i + v_sum_i / time_step_i
        along, whole = nozzle.direction / nozzle.area, emitted_bar_i + wp.float64(wp.dot(nozzle.direction, x_sum_i))
        flow_rate = flow[i, step_i]
        further, turn = real(whole) / nozzle.area, drift_i - flow_rate * along
        faster, longer = wp.dot(along, v_sum_i), -wp.dot(v_sum_i, turn) / time_step_i
        flow_bar[i, step_i] = flow_bar[i, step_i] + further * time_step_i + faster
        return -v_sum_i / time_step_i, whole, further * flow_rate + longer

    @particle_kernel(module, "x v", numbers=numbers, typed=typed)
    def prescribe(
        i, member, particles, nozzle, outlet, drift, emitted, places, serial_i, x_free_i, v_free_i
    ) -> tuple[vector, vector]:
        p = i - member * particles
        s, x, v = remaining(p, nozzle, serial_i, emitted), x_free_i, v_free_i
        if s > nozzle.column:
            x = places[p]
            v = vector()
        elif s > real(0.0):
            k = p - nozzle.first
            if serial_i > wp.float64(0.0):
                k = int((wp.int64(serial_i) - wp.int64(1)) % wp.int64(nozzle.count))
            x = outlet + nozzle.offsets[k] - s * nozzle.direction
            v = drift
        return x, v

    @particle_kernel(derivatives, "x_dot v_dot", numbers=numbers, typed=typed)
    def prescribe_tangent(
        i, member, particles, nozzle, emitted, outlet_dot, drift_dot, emitted_dot, serial_i, x_dot_i, v_dot_i
    ) -> tuple[vector, vector]:
        s, no = remaining(i - member * particles, nozzle, serial_i, emitted), vector()
        if s > nozzle.column:
            return no, no
        if s > real(0.0):
            return outlet_dot + real(emitted_dot) * nozzle.direction, drift_dot
        return x_dot_i, v_dot_i

    @particle_kernel(derivatives, "x_free_bar v_free_bar x_prescribed_bar v_prescribed_bar", numbers=numbers)
    @typed
    def prescribe_adjoint(
        i, member, particles, nozzle, emitted, serial_i, x_bar_i, v_bar_i
    ) -> tuple[vector, vector, vector, vector]:
        s, no = remaining(i - member * particles, nozzle, serial_i, emitted), vector()
        led, free = s > real(0.0) and s <= nozzle.column, s <= real(0.0)
        x_free_bar, v_free_bar = wp.where(free, x_bar_i, no), wp.where(free, v_bar_i, no)
        return x_free_bar, v_free_bar, wp.where(led, x_bar_i, no), wp.where(led, v_bar_i, no)

    return Kernels(begin, begin_tangent, begin_adjoint), Kernels(prescribe, prescribe_tangent, prescribe_adjoint)


@cache
def feeding_kernels(precision: Precision, taped: bool) -> tuple[Any, Any]:
    real, nozzle_of, remaining = precision.real, nozzle_type(precision), remaining_function(precision)
    module = integration_module(precision, True, taped, "emitter")
    numbers = {nozzle_of: "nozzle", wp.float64: "serial emitted", wp.int32: "i member particles"}
    typed = TypesByName(real, {**numbers, wp.array(dtype=wp.int32): "held before", wp.array(dtype=wp.bool): "drains"})

    @particle_kernel(module, "held", numbers=["nozzle", "particles"], typed=typed)
    def hold(i, member, particles, nozzle, emitted_in, drains, drained_i, serial_i) -> wp.int32:
        in_line = remaining(i - member * particles, nozzle, serial_i, emitted_in) > real(0.0)
        return wp.where(drains[int(drained_i)] and not in_line, 1, 0)

    @wp.func
    def layers(nozzle: nozzle_of, emitted: wp.float64) -> wp.float64:
        return wp.floor((emitted + wp.float64(nozzle.column)) / nozzle.spacing + wp.float64(0.5))

    @particle_kernel(module, "serial", numbers=["nozzle", "particles"], typed=typed)
    def join(i, member, particles, nozzle, emitted_in, emitted, held, before, serial_in_i) -> wp.float64:
        layer = wp.float64(nozzle.layer)
        first = wp.max(layers(nozzle, emitted_in), wp.float64(nozzle.count) / layer)
        rank = wp.float64(before[i] - before[member * particles])
        if held[i] == 1 and rank < (layers(nozzle, emitted) - first) * layer:
            return first * layer + rank + wp.float64(1.0)
        return serial_in_i

    return hold, join


@dataclass(frozen=True)
class Nozzle:
    name: str
    first: int
    sample: EmitterSample
    direction: np.ndarray
    """Vector of shape (d,) and length 1 along the flow."""
    area: float
    """Area of the opening [m2], or in 2-D the width of the opening [m]."""
    places: np.ndarray
    """Array of shape (n, d) with the resting positions of particles in reserve [m]."""
    feeding: np.ndarray
    """Array of shape (drains + 1,) with True for each drain that feeds the emitter."""

    def part(self, layout: Layout, requires_grad: bool) -> "Emitter":
        return Emitter(self, layout, requires_grad)

    def constants(self, layout: Layout) -> Any:
        precision, device, sample = layout.precision, layout.device, self.sample
        constants = nozzle_type(precision)()
        constants.first, constants.area, constants.layer = self.first, self.area, sample.layer
        constants.count, constants.spacing = len(sample.upstream), 2.0 * sample.upstream[0]
        constants.upstream = wp.array(sample.upstream, dtype=precision.real, device=device)
        constants.offsets = to_device(sample.offsets, precision, device)
        constants.column = sample.column
        constants.direction = precision.vector_of(self.direction)
        return constants


class EmitterTangent(PartTangent):
    def __init__(self, part: Any):
        super().__init__(part)
        known = {f"{name}_dot": part.constants[name] for name in ("outlet", "drift", "emitted")}
        self._dot = {name: wp.zeros_like(array, requires_grad=False) for name, array in known.items()}

    def end(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        emitter, name = self.part, self.part.nozzle.name
        known = emitter.constants, self._dot, emitter.parameters(step.parameters)
        before = {"q_in_dot": state_dot[outlet_name(name)], "emitted_in_dot": state_dot[emitted_name(name)]}
        before |= emitter.parameters(dot.parameters, "_dot") | {"time_step_dot": dot.parameters["time_step"]}
        step.launch(emitter.begins.tangent, *known, **before, threads=emitter.layout.members)
        step.launch(emitter.ends.tangent, *known, x_dot=state_dot.positions, v_dot=state_dot.velocities)
        wp.copy(state_dot[outlet_name(name)], self._dot["outlet_dot"])
        wp.copy(state_dot[emitted_name(name)], self._dot["emitted_dot"])


class EmitterAdjoint(PartAdjoint):
    def __init__(self, part: Any):
        super().__init__(part)
        self._free, self._prescribed = part.free.like(), part.free.like()
        self._sums = [part.layout.sum_of(part.layout.precision.vector) for _ in range(2)]

    def end(self, step: StepContext, bar: Parameters, state_bar: State, moved_bar: State) -> State:
        emitter, free, prescribed = self.part, self._free, self._prescribed
        parts = {"x_free_bar": free.positions, "v_free_bar": free.velocities}
        parts |= {"x_prescribed_bar": prescribed.positions, "v_prescribed_bar": prescribed.velocities}
        bars = {"x_bar": moved_bar.positions, "v_bar": moved_bar.velocities}
        step.launch(emitter.ends.adjoint, emitter.constants, bars, parts)
        x_sum, v_sum = (add_up(x) for add_up, x in zip(self._sums, prescribed.arrays(), strict=True))
        name, known = emitter.nozzle.name, (emitter.constants, emitter.parameters(step.parameters))
        own = {"outlet_bar": state_bar[outlet_name(name)], "emitted_bar": state_bar[emitted_name(name)]}
        collected = {**own, "x_sum": x_sum, "v_sum": v_sum, "time_step_bar": bar["time_step"]}
        collected |= emitter.parameters(bar, "_bar")
        step.launch(emitter.begins.adjoint, *known, **collected, threads=emitter.layout.members)
        return free


class Emitter(Part):
    derivatives = EmitterTangent, EmitterAdjoint

    def __init__(self, nozzle: Nozzle, layout: Layout, requires_grad: bool = False):
        self.nozzle, self.layout, name = nozzle, layout, nozzle.name
        self.fields: tuple[StateField, ...] = (
            StateField(outlet_name(name), "m", Entry.VECTOR, Axis.SCALAR, first=path_name(name)),
            StateField(emitted_name(name), "m", Entry.DOUBLE, Axis.SCALAR),
        )
        is_fed = nozzle.feeding.any()
        if is_fed:
            self.fields += (StateField(again_name(name), "", Entry.DOUBLE),)
        self.free = layout.state((POSITIONS, VELOCITIES), requires_grad)
        precision, device = layout.precision, layout.device
        self.begins, self.ends = emitter_kernels(precision, requires_grad)
        self.feeds = feeding_kernels(precision, requires_grad)
        drift = wp.zeros(layout.members, dtype=precision.vector, device=device, requires_grad=requires_grad)
        places = to_device(nozzle.places, precision, device)
        self.own = layout.state(self.fields, requires_grad)
        serial = wp.zeros(layout.all_particles, dtype=wp.float64, device=device)
        self.constants = {"nozzle": nozzle.constants(layout), "drift": drift, "places": places, "serial": serial}
        self.constants |= {"outlet": self.own[outlet_name(name)], "emitted": self.own[emitted_name(name)]}
        if is_fed:
            self.constants["serial"] = self.own[again_name(name)]
            drains = {"drains": wp.array(nozzle.feeding, dtype=wp.bool, device=device)}
            self._pool = {**drains, **layout.arrays(held=wp.int32, before=wp.int32)}

    def parameters(self, parameters: Parameters, suffix: str = "") -> dict[str, wp.array]:
        name = self.nozzle.name
        return {f"path{suffix}": parameters[path_name(name)], f"flow{suffix}": parameters[f"{name}.flow_rate"]}

    def begin(self, step: StepContext, state: State) -> None:
        name = self.nozzle.name
        before = {"q_in": state[outlet_name(name)], "emitted_in": state[emitted_name(name)]}
        known = self.constants, self.parameters(step.parameters)
        step.launch(self.begins.forward, *known, **before, threads=self.layout.members)
        if self.nozzle.feeding.any():
            held, joined = self.feeds
            feeding = {**self.constants, **before, **self._pool, "serial_in": state[again_name(name)]}
            step.launch(held, {**feeding, "serial": feeding["serial_in"]}, drained=state["drained"])
            wp.utils.array_scan(self._pool["held"], self._pool["before"], inclusive=False)
            step.launch(joined, feeding)

    def target(self, moved: State) -> State:
        return self.free

    def end(self, step: StepContext, state: State, moved: State) -> None:
        free = {"x_free": self.free.positions, "v_free": self.free.velocities}
        step.launch(self.ends.forward, self.constants, **free, x=moved.positions, v=moved.velocities)
        for field in self.fields:
            wp.copy(state[field.name], self.own[field.name])
