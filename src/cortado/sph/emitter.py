"""An emitter: the particles that have not left its nozzle yet are prescribed at the end of a step, others are free."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from cortado.particles.arrays import to_device
from cortado.particles.fields import POSITIONS, VELOCITIES, Entry, StateField
from cortado.particles.state import Layout, Parameters, State
from cortado.scene.parameters.parameter import Axis
from cortado.sph.emitter_kernels import emitter_kernels, nozzle_type
from cortado.sph.part import Part, PartAdjoint, PartTangent
from cortado.sph.parts import StepContext, Tangents

OUTLET = StateField("outlet", "m", Entry.VECTOR, Axis.SCALAR, first="nozzle_path")
"""Where the opening of the nozzle is."""
EMITTED = StateField("emitted", "m", Entry.DOUBLE, Axis.SCALAR)
"""The length of the column of fluid that has left it."""


@dataclass(frozen=True)
class Nozzle:
    """The last particles of a scene, as they wait in a nozzle."""

    first: int
    """Number of the first of them."""
    upstream: np.ndarray
    """(m,) distance from the opening [m]"""
    offsets: np.ndarray
    """(m, d) from the axis [m]"""
    direction: np.ndarray
    """(d,) of the flow, a unit vector"""
    area: float
    """Of the opening [m2], in 2-D [m]."""
    column: float
    """Particles further upstream are in reserve [m]."""
    reserve: np.ndarray
    """(d,) how far these are from their place in line [m]"""

    def part(self, layout: Layout, requires_grad: bool) -> "Emitter":
        return Emitter(self, layout, requires_grad)


class Emitter(Part):
    """The emitter of one solver."""

    fields = (OUTLET, EMITTED)
    """What it carries from step to step."""

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
        """Keep what the end of a step needs of the state before it."""
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
    """Forward mode of prescribed particles and of the nozzle."""

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
    """Reverse mode of prescribed particles and of the nozzle."""

    def __init__(self, emitter: Emitter):
        self._emitter = emitter
        self._free = emitter.free.like()
        """Adjoint of the end of a step if no particle were prescribed."""
        self._prescribed = emitter.free.like()
        layout = emitter.layout
        self._sums = [layout.sum_of(layout.precision.vector) for _ in range(2)]

    def end(self, step: StepContext, bar: Parameters, state_bar: State, moved_bar: State) -> State:
        """What reaches free particles; adds what reaches prescribed ones to ``bar`` and to the adjoint of the nozzle,
        which becomes that before the step."""
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
