"""An emitter: the particles that have not left its nozzle yet are prescribed at the end of a step, others are free."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from cortado.device.arrays import to_device
from cortado.device.fields import POSITIONS, VELOCITIES, Entry, StateField
from cortado.device.state import Layout, Parameters, State
from cortado.parameters.registry import Axis
from cortado.sph.emitter_kernels import emitter_kernels, nozzle_type
from cortado.sph.parts import StepContext

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


class Emitter:
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
        constants.direction = precision.vector(*np.pad(nozzle.direction, (0, 3 - len(nozzle.direction))))
        self.constants = {"nozzle": constants, **layout.state(self.fields, requires_grad).named()}
        """Of the nozzle, and of a step once it has begun, for kernels."""
        self._dot = layout.state(self.fields).named("_dot")

    def begin(self, step: StepContext, state: State) -> None:
        """Keep what the end of a step needs of the state before it."""
        before = {"outlet_in": state["outlet"], "emitted_in": state["emitted"]}
        step.launch(self.kernels.begin, self.constants, **before, threads=self.layout.members)

    def prescribe(self, step: StepContext, state: State) -> None:
        """Write the state at the end of a step; ``free`` holds positions and velocities without the nozzle."""
        free = {"x_free": self.free.positions, "v_free": self.free.velocities}
        new = {"outlet_out": state["outlet"], "emitted_out": state["emitted"]}
        step.launch(self.kernels.forward, self.constants, **free, x=state.positions, v=state.velocities, **new)

    def tangent(self, step: StepContext, dot: Parameters, state_dot: State) -> None:
        """From the tangent of the state before to that of the state after, of prescribed particles and the nozzle."""
        rates, outlet, emitted = dot.named("_dot"), state_dot["outlet"], state_dot["emitted"]
        before = {"outlet_in_dot": outlet, "emitted_in_dot": emitted}
        step.launch(self.kernels.begin_tangent, self.constants, self._dot, rates, **before, threads=self.layout.members)
        new = {"outlet_out_dot": outlet, "emitted_out_dot": emitted}
        moved = {"x_dot": state_dot.positions, "v_dot": state_dot.velocities}
        step.launch(self.kernels.tangent, self.constants, self._dot, rates, **moved, **new)


class EmitterAdjoint:
    """Reverse mode of `Emitter.prescribe`."""

    def __init__(self, emitter: Emitter):
        self._emitter = emitter
        self.free = emitter.free.like()
        """Adjoint of the end of a step if no particle were prescribed."""
        self._prescribed = emitter.free.like()
        layout = emitter.layout
        self._sums = [layout.sum_of(layout.precision.vector) for _ in range(2)]

    def step(self, step: StepContext, state_bar: State, bar: Parameters) -> None:
        """Write what reaches ``free``, and add what reaches prescribed particles to ``bar`` and to the adjoint of the
        nozzle, which becomes that before the step."""
        emitter, free, prescribed = self._emitter, self.free, self._prescribed
        step.launch(
            emitter.kernels.adjoint,
            emitter.constants,
            x_bar=state_bar.positions,
            v_bar=state_bar.velocities,
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
