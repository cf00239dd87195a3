"""Drains, which remove particles that enter them, and sinks, to which fluid flows at a given flow rate.

A drain removes each particle that is inside the drain at the start of a step. At the end of the step, a removed
particle is put at a resting position far from all other particles. The field ``drained`` of a removed particle is the
number of the drain. The removal has no derivative.

A sink draws fluid to the sink's middle c at the flow rate Q in d dimensions. A particle at x has the vector y = x - c
and the distance r = |y|. The velocity of the particle after explicit forces, with the acceleration a, is

    v* = (1 - phi) (v + dt a) + phi (u - lambda w),   u = -Q y / (S r^d),

instead of v + dt a. The constant S is the part of the unit sphere or circle that walls leave open. The weight phi of
the prescribed flow u rises smoothly from 0 at the radius r_2 to 1 at the radius r_1. The sink removes particles within
r_0 < r_1, so that a removed particle has neighbours with prescribed motion. The term lambda w, with lambda < 1, damps
the velocity change w by pressure in the previous step. Without the term lambda w, pressure would press fluid through
the shell from r_0 to r_1.

Fluid in the shell is thinner than elsewhere, so the sink uses (1 + E / M) Q instead of Q. The number M counts the
particles within r_1. The number E counts particles that the sink should have removed but has not. E is limited to the
range from -M / 4 to M / 4, and has no derivative.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import Named
from cortado.device.modules import Kernels, kernel_module
from cortado.device.precision import Precision, TypesByName, struct_of
from cortado.device.reduction import TreeReduction
from cortado.discretise.shapes import Points
from cortado.particles.particle_kernels import particle_kernel, pointwise_kernels
from cortado.particles.state import POSITIONS, VELOCITIES, Entry, Layout, Parameters, State, StateField, to_device
from cortado.scene.drain_tables import count_name
from cortado.scene.emitter_table import again_name, emitted_name
from cortado.scene.parameters import Axis
from cortado.sph.emitter import Nozzle, nozzle_type, remaining_function
from cortado.sph.parts import Adjoints, Part, PartAdjoint, PartTangent, StepContext, Tangents

MEMORY = 0.98
"""Fraction of the velocity change by pressure in the previous step that a sink subtracts [-]."""
BOX, PLANE, BALL = 0, 1, 2
MOST = 0.25
DRAINED = StateField("drained", "", Entry.NUMBER)
"""Field with the number, from 1, of the drain that removed a particle, and with 0 for all other particles."""


def behind(name: str) -> StateField:
    """Return the field for the number of particles that a sink should have removed but has not."""
    return StateField(f"{name}.behind", "", Entry.DOUBLE, Axis.SCALAR)


@dataclass(frozen=True)
class Mouth:
    name: str
    shape: int
    middle: Points
    ends: Points
    """Array of shape (2, d) with a box's corners relative to its middle [m], or twice the direction of a plane."""
    radius: float = 0.0


@dataclass(frozen=True)
class Pull:
    shell: tuple[float, float]
    """Inner and outer radius of the transition between prescribed and free flow [m]."""
    sphere: float
    """Open solid angle around the sink [sr], in 2-D angle [rad]."""
    holds: float
    """Number of particles with prescribed flow."""


@dataclass(frozen=True)
class Drained:
    mouths: Sequence[Mouth]
    pulls: Mapping[str, Pull]
    places: Points
    """Array of shape (n, d) with the resting positions of removed particles [m]."""
    nozzles: Sequence[Nozzle]
    periods: Points
    """Vector of shape (d,) with the lengths of the periodic box [m], 0 along an axis that is not periodic."""


@cache
def mouth_type(precision: Precision) -> Any:
    real, vector = precision.real, precision.vector
    ends, periods = {"lower": vector, "upper": vector}, {"period": vector, "frequency": vector}
    return struct_of("MouthOf", precision, shape=wp.int32, number=real, **ends, radius=real, **periods)


@cache
def nearest_function(precision: Precision, module: Any) -> Any:
    vector = precision.vector

    @wp.func
    def nearest(y: vector, period: vector, frequency: vector) -> vector:
        turns = wp.cw_mul(y, frequency)
        return y - wp.cw_mul(vector(wp.round(turns[0]), wp.round(turns[1]), wp.round(turns[2])), period)

    return nearest


@cache
def drain_kernels(precision: Precision, taped: bool) -> tuple[Any, Any, Kernels]:
    real, vector, mouth_of = precision.real, precision.vector, mouth_type(precision)
    module = kernel_module(f"drains_{'taped_' * taped}{precision.name}", taped)
    derivatives = kernel_module(f"drains_derivative_{precision.name}")
    nearest = nearest_function(precision, module)
    remaining, nozzle_of = remaining_function(precision), nozzle_type(precision)
    doubles = {wp.float64: "emitted serial", nozzle_of: "nozzle"}
    typed = TypesByName(real, {mouth_of: "mouth", vector: "middle x v", **doubles})

    @wp.func
    def contains(x: vector, middle: vector, m: mouth_of) -> bool:
        y = nearest(x - middle, m.period, m.frequency)
        if m.shape == wp.static(PLANE):
            return wp.dot(y, m.lower) >= real(0.0)
        if m.shape == wp.static(BALL):
            return wp.length(y) < m.radius
        below = y[0] < m.lower[0] or y[1] < m.lower[1] or y[2] < m.lower[2]
        return not below and y[0] <= m.upper[0] and y[1] <= m.upper[1] and y[2] <= m.upper[2]

    @particle_kernel(module, "waits", numbers=["nozzle", "particles"], typed=typed)
    def wait(i: int, member: int, particles: int, nozzle, emitted, serial_i, waits_i) -> real:
        return wp.where(remaining(i - member * particles, nozzle, serial_i, emitted) > real(0.0), real(1.0), waits_i)

    @particle_kernel(module, "taken fresh", numbers=["mouth"], typed=typed)
    def take(i: int, mouth, middle, waits_i, x_i, taken_i) -> tuple[real, real]:
        found, fresh = wp.where(waits_i > real(0.0), real(0.0), taken_i), real(0.0)
        if found == real(0.0) and waits_i == real(0.0) and contains(x_i, middle, mouth):
            found = mouth.number
            fresh = real(1.0)
        return found, fresh

    @particle_kernel(module, "x v", numbers=["particles"], typed=typed)
    def park(
        i: int, member: int, particles: int, places: wp.array(dtype=vector), taken_i, x_free_i, v_free_i
    ) -> tuple[vector, vector]:
        place, at_rest = places[i - member * particles], vector()
        return wp.where(taken_i > real(0.0), place, x_free_i), wp.where(taken_i > real(0.0), at_rest, v_free_i)

    def held(results: str) -> Any:
        @particle_kernel(derivatives, results, name=f"park_{results.split('_')[-1]}", typed=typed)
        def hold(taken_i, x_of_i, v_of_i) -> tuple[vector, vector]:
            no = vector()
            return wp.where(taken_i > real(0.0), no, x_of_i), wp.where(taken_i > real(0.0), no, v_of_i)

        return hold

    return wait, take, Kernels(park, held("x_dot v_dot"), held("x_free_bar v_free_bar"))


@cache
def pull_kernels(precision: Precision, taped: bool) -> tuple[Any, Any, Kernels, Kernels]:
    real, vector = precision.real, precision.vector
    modules = [kernel_module(f"sinks_{'taped_' * taped}{precision.name}", taped)]
    modules += [kernel_module(f"sinks_derivative_{precision.name}")] * 2
    memory, tiny, no, one = (wp.constant(real(value)) for value in (MEMORY, precision.tiny, 0.0, 1.0))
    typed = TypesByName(real, {vector: "position x v kick acceleration_in period frequency"})

    def make(module: Any) -> Any:
        nearest = nearest_function(precision, module)

        @typed
        def drive(
            time_step, flow, position, x_i, v_i, kick_i, acceleration_in_i, inner, outer, area, power, period, frequency
        ) -> vector:
            y = nearest(x_i - position, period, frequency)
            r = wp.sqrt(wp.dot(y, y) + tiny)
            t = wp.clamp((outer - r) / (outer - inner), no, one)
            phi = t * t * t * (real(10.0) - t * (real(15.0) - real(6.0) * t))
            goal = -flow / (area * wp.pow(wp.max(r, real(0.1) * inner), power)) * y - memory * kick_i
            return acceleration_in_i + phi * ((goal - v_i) / time_step - acceleration_in_i)

        return drive

    numbers = ["inner", "outer", "area", "power", "period", "frequency"]
    drives = pointwise_kernels(
        precision, modules, make, ["acceleration"], {"acceleration": "acceleration_in"}, numbers=numbers
    )
    rows = wp.array2d(dtype=real)
    of_scene = TypesByName(real, {wp.int32: "step", rows: "table", wp.float64: "behind count"})
    most = wp.constant(wp.float64(MOST))

    @of_scene.kernel(modules[0], enable_backward=False)
    def tally(taken_sum, count):
        count[wp.tid()] = count[wp.tid()] + wp.float64(taken_sum[wp.tid()])

    @of_scene.kernel(modules[0], enable_backward=False)
    def fall_behind(step, table: rows, time_step, taken_sum, cell: real, holds: real, behind, gain):
        m = wp.tid()
        held = wp.float64(holds)
        gain[m] = real(wp.float64(1.0) + wp.round(behind[m]) / held)
        due = behind[m] + wp.float64(table[m, step[m]]) * wp.float64(time_step[m]) / wp.float64(cell)
        behind[m] = wp.clamp(due - wp.float64(taken_sum[m]), -most * held, most * held)

    @of_scene.kernel(modules[0])
    def read(step, table: rows, gain, flow):
        flow[wp.tid()] = gain[wp.tid()] * table[wp.tid(), step[wp.tid()]]

    @of_scene.kernel(modules[1], enable_backward=False)
    def add_to(step, table: rows, gain, total):
        table[wp.tid(), step[wp.tid()]] = table[wp.tid(), step[wp.tid()]] + gain[wp.tid()] * total[wp.tid()]

    return tally, fall_behind, drives, Kernels(read, read, add_to)


class DrainsTangent(PartTangent):
    def end(self, step: StepContext, dot: Tangents, state_dot: State) -> None:
        both = {"x_dot": state_dot.positions, "v_dot": state_dot.velocities}
        step.launch(self.part.parks.tangent, both, self.part.taken, x_of=both["x_dot"], v_of=both["v_dot"])


class DrainsAdjoint(PartAdjoint):
    def __init__(self, part: Any):
        super().__init__(part)
        self._free = part.free.like()

    def end(self, step: StepContext, bar: Parameters, state_bar: State, moved_bar: State) -> State:
        free = {"x_free_bar": self._free.positions, "v_free_bar": self._free.velocities}
        moved = {"x_of": moved_bar.positions, "v_of": moved_bar.velocities}
        step.launch(self.part.parks.adjoint, free, moved, self.part.taken)
        return self._free


class Drains(Part):
    batches = is_last = True
    derivatives = DrainsTangent, DrainsAdjoint

    def __init__(self, of: Drained, layout: Layout, taped: bool):
        self.layout, precision, device, real = layout, layout.precision, layout.device, layout.precision.real
        self.free = layout.state((POSITIONS, VELOCITIES), taped)
        self.wait, self.take, self.parks = drain_kernels(precision, taped)
        self.tally, self.fall_behind, self.drive, self.flows = pull_kernels(precision, taped)
        self.shares = tuple(f"{name}.position" for name in of.pulls)
        counts = (StateField(count_name(one.name), "", Entry.DOUBLE, Axis.SCALAR) for one in of.mouths)
        self.fields = (DRAINED, *map(behind, of.pulls), *counts)
        self.taken = layout.arrays(taken=real, fresh=real, waits=real)
        """Arrays of shape (n,): a particle's drain, 1 if removed by the last drain, and 1 if waiting in an emitter."""
        self.places = to_device(of.places, precision, device)
        self._nozzles = [(one, one.constants(layout)) for one in of.nozzles]
        self._never = layout.arrays(serial=wp.float64)["serial"]
        frequency = np.divide(1.0, of.periods, out=np.zeros(len(of.periods)), where=of.periods > 0.0)
        box = {"period": precision.vector_of(of.periods), "frequency": precision.vector_of(frequency)}
        self._mouths = [(one, *self._mouth(one, k, box)) for k, one in enumerate(of.mouths)]
        self._pulls = {}
        for name, pull in of.pulls.items():
            own = {"inner": pull.shell[0], "outer": pull.shell[1], "area": pull.sphere, "holds": pull.holds}
            self._pulls[name] = {**own, "power": float(len(of.periods)), **box}
        self._flow = {end: wp.zeros(layout.members, dtype=real, device=device) for end in ("flow", "flow_dot")}
        self._gains = {name: wp.zeros(layout.members, dtype=real, device=device) for name in of.pulls}
        counted = [behind(name).name for name in of.pulls] + [count_name(one.name) for one in of.mouths]
        self._counts = {name: wp.zeros(layout.members, dtype=wp.float64, device=device) for name in counted}
        self._between = [layout.arrays(a=precision.vector)["a"] for _ in of.pulls][1:]
        self._still = layout.arrays(kick=precision.vector)["kick"]
        self._found: list[tuple[str, wp.array, wp.array]] = []

    @cached_property
    def _bars(self) -> dict[str, wp.array]:
        vector, real = self.layout.precision.vector, self.layout.precision.real
        return self.layout.arrays("_bar", acceleration_in=vector, kick=vector, flow=real)

    @cached_property
    def _sum(self) -> TreeReduction:
        return self.layout.sum_of(self.layout.precision.real)

    def _mouth(self, one: Mouth, number: int, box: Named) -> tuple[Any, Any]:
        layout, found = self.layout, mouth_type(self.layout.precision)()
        found.shape, found.number, found.radius = one.shape, float(number + 1), one.radius
        found.lower, found.upper = map(layout.precision.vector_of, one.ends)
        found.period, found.frequency = box["period"], box["frequency"]
        if one.shape == BALL:
            return found, f"{one.name}.position"
        return found, to_device(np.tile(one.middle, (layout.members, 1)), layout.precision, layout.device)

    def begin(self, step: StepContext, state: State) -> None:
        wp.copy(self.taken["taken"], state["drained"])
        self.taken["waits"].zero_()
        for nozzle, constants in self._nozzles:
            serial = state[again_name(nozzle.name)] if nozzle.feeding.any() else self._never
            own = {"nozzle": constants, "emitted": state[emitted_name(nozzle.name)], "serial": serial}
            step.launch(self.wait, own, self.taken)
        for name, count in self._counts.items():
            wp.copy(count, state[name])
        for one, mouth, middle in self._mouths:
            place = step.parameters[middle] if isinstance(middle, str) else middle
            step.launch(self.take, self.taken, x=state.positions, mouth=mouth, middle=place)
            counted = {"taken_sum": self._sum(self.taken["fresh"]), "count": self._counts[count_name(one.name)]}
            step.launch(self.tally, counted, threads=self.layout.members)
            if one.name in self._pulls:
                counted["behind"] = self._counts[behind(one.name).name]
                step.launch(self.fall_behind, counted, self._of(step.parameters, one.name), threads=self.layout.members)

    def _of(self, parameters: Parameters, name: str) -> dict[str, Any]:
        return {**self._pulls[name], "gain": self._gains[name], "table": parameters[f"{name}.flow_rate"]}

    def target(self, moved: State) -> State:
        return self.free

    def end(self, step: StepContext, state: State, moved: State) -> None:
        free = {"x_free": self.free.positions, "v_free": self.free.velocities, "places": self.places}
        step.launch(self.parks.forward, self.taken, free, x=moved.positions, v=moved.velocities)
        wp.copy(state["drained"], self.taken["taken"])
        for name, count in self._counts.items():
            wp.copy(state[name], count)

    def _known(self, step: StepContext, name: str) -> tuple[Named, ...]:
        of = self._of(step.parameters, name)
        step.launch(self.flows.forward, of, flow=self._flow["flow"], threads=self.layout.members)
        kick = self._still if step.kick is None else step.kick
        return of, self._flow, {"kick": kick, "position": step.parameters[f"{name}.position"]}

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        if not self._pulls:
            wp.copy(after, before)
            return
        ends = [before, *self._between, after]
        self._found = list(zip(self._pulls, ends[:-1], ends[1:], strict=True))
        for name, start, end in self._found:
            step.launch(self.drive.forward, *self._known(step, name), acceleration_in=start, acceleration=end)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        if not self._pulls:
            wp.copy(after, before)
            return
        dots = [before, *self._dots, after]
        for (name, start, _), start_dot, end_dot in zip(self._found, dots[:-1], dots[1:], strict=True):
            known, rates = self._known(step, name), self._of(dot.parameters, name)
            step.launch(self.flows.tangent, rates, flow=self._flow["flow_dot"], threads=self.layout.members)
            along = {"kick_dot": self._still if dot.kick is None else dot.kick}
            along["position_dot"] = dot.parameters[f"{name}.position"]
            ends = {"acceleration_in": start, "acceleration_in_dot": start_dot, "acceleration_dot": end_dot}
            step.launch(self.drive.tangent, ends, along, *known, *dot.named)

    @cached_property
    def _dots(self) -> list[wp.array]:
        return [wp.zeros_like(a) for a in self._between]

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> wp.array:
        passed, flow_bar = self._bars["acceleration_in_bar"], self._bars["flow_bar"]
        wp.copy(passed, acceleration_bar)
        own = {**self._bars, "kick_bar": self._bars["kick_bar"] if bar.kick is None else bar.kick}
        for name, start, _ in reversed(self._found):
            known = self._known(step, name)
            flow_bar.zero_()
            ends = {"acceleration_in": start, "position_bar": bar.shares[f"{name}.position"]}
            step.launch(self.drive.adjoint, ends, own, *known, *bar.named)
            rates = self._of(bar.parameters, name)
            step.launch(self.flows.adjoint, rates, total=self._sum(flow_bar), threads=self.layout.members)
        return passed
