"""A nozzle at the end of a step: the particles that have not left it yet are led, all others are free."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import sum_of
from cortado.device.precision import Precision
from cortado.device.state import Parameters, State, padded, to_device
from cortado.restart import Elapsed
from cortado.sph.nozzle_kernels import nozzle_kernels
from cortado.sph.parts import StepContext


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
    """The nozzle of one solver."""

    def __init__(self, nozzle: Nozzle, precision: Precision, device: Any, free: State):
        """``free``: room for a state in which no particle is led."""
        self.nozzle, self.free = nozzle, free
        self.kernels = nozzle_kernels(precision)
        self._before = wp.zeros(1, dtype=wp.int32, device=device)
        self._outlet = wp.zeros(1, dtype=precision.vector, device=device)
        self._constants = {
            "first": nozzle.first,
            "upstream": wp.array(nozzle.upstream, dtype=precision.real, device=device),
            "offsets": to_device(nozzle.offsets, precision, device),
            "direction": precision.vector(*np.pad(nozzle.direction, (0, 3 - len(nozzle.direction)))),
            "area": nozzle.area,
            "before": self._before,  # steps of the run that this one goes on with
            "outlet": self._outlet,  # where that left the opening [m]
            "outlet_dot": wp.zeros_like(self._outlet),
        }

    def go_on(self, elapsed: Elapsed) -> None:
        """Count steps from, and move the opening from, what went before."""
        self._before.fill_(elapsed.steps)
        if elapsed.outlet is not None:
            self._outlet.assign(padded(elapsed.outlet[None]))

    def lead(self, step: StepContext, state: State) -> None:
        """Write positions and velocities at the end of a step; ``free`` holds those without the nozzle."""
        free = {"x_free": self.free.positions, "v_free": self.free.velocities}
        step.launch(self.kernels.forward, self._constants, **free, x=state.positions, v=state.velocities)

    def tangent(self, step: StepContext, dot: Parameters, state_dot: State) -> None:
        """Replace the tangents of led particles."""
        rates, x_dot, v_dot = dot.named("_dot"), state_dot.positions, state_dot.velocities
        step.launch(self.kernels.tangent, self._constants, rates, x_dot=x_dot, v_dot=v_dot)


class EmitterAdjoint:
    """Reverse mode of `Emitter.lead`."""

    def __init__(self, emitter: Emitter):
        self._emitter = emitter
        self.free = emitter.free.like()
        """Adjoint of the state without the nozzle; its fractions are not used."""
        self._led = emitter.free.like()
        x = self._led.positions
        self._sums = [sum_of(x.dtype, len(x), x.device) for _ in range(2)]

    def step(self, step: StepContext, state_bar: State, bar: Parameters) -> None:
        """Part the adjoint of a new state into that of ``free`` and what is added to ``bar``."""
        emitter, constants, led, free = self._emitter, self._emitter._constants, self._led, self.free
        step.launch(
            emitter.kernels.adjoint,
            constants,
            x_bar=state_bar.positions,
            v_bar=state_bar.velocities,
            x_free_bar=free.positions,
            v_free_bar=free.velocities,
            x_led_bar=led.positions,
            v_led_bar=led.velocities,
        )
        x_total, v_total = (add_up(x) for add_up, x in zip(self._sums, (led.positions, led.velocities), strict=True))
        totals = {"x_total": x_total, "v_total": v_total}
        step.launch(emitter.kernels.collect, constants, bar.named("_bar"), **totals, threads=1)
