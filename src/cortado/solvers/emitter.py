"""A nozzle at the end of a step: the particles that have not left it yet are led, all others are free."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from cortado.launching import Launcher, add, sum_of
from cortado.particles import Parameters, State, padded, to_device
from cortado.physics.nozzle import nozzle_kernels
from cortado.precision import Precision
from cortado.restart import Elapsed


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

    def __init__(self, nozzle: Nozzle, precision: Precision, launch: Launcher, free: State):
        """``free``: room for a state in which no particle is led."""
        self.nozzle, self.launch, self.free = nozzle, launch, free
        self.kernels = nozzle_kernels(precision)
        self.upstream = wp.array(nozzle.upstream, dtype=precision.real, device=launch.device)
        self.offsets = to_device(nozzle.offsets, precision, launch.device)
        self.direction = precision.vector(*np.pad(nozzle.direction, (0, 3 - len(nozzle.direction))))
        self.before = wp.zeros(1, dtype=wp.int32, device=launch.device)
        """Steps of the run that this one goes on with."""
        self.outlet = wp.zeros(1, dtype=precision.vector, device=launch.device)
        """Where that left the opening [m]."""
        self._fixed = wp.zeros_like(self.outlet)

    def go_on(self, elapsed: Elapsed) -> None:
        """Count steps from, and move the opening from, what went before."""
        self.before.fill_(elapsed.steps)
        if elapsed.outlet is not None:
            self.outlet.assign(padded(elapsed.outlet[None]))

    def lead(self, parameters: Parameters, step: wp.array, state: State) -> None:
        """Write positions and velocities at the end of a step; ``free`` holds those without the nozzle."""
        p, nozzle = parameters, self.nozzle
        self.launch(
            self.kernels.forward,
            [nozzle.first, self.upstream, self.offsets, self.direction, nozzle.area]
            + [p.nozzle_path, p.flow_rate, p.time_step, self.before, self.outlet, step]
            + [self.free.positions, self.free.velocities],
            [state.positions, state.velocities],
        )

    def tangent(self, parameters: Parameters, dot: Parameters, step: wp.array, state_dot: State) -> None:
        """Replace the tangents of led particles."""
        p, nozzle = parameters, self.nozzle
        self.launch(
            self.kernels.tangent,
            [nozzle.first, self.upstream, self.direction, nozzle.area, p.nozzle_path, dot.nozzle_path]
            + [p.flow_rate, dot.flow_rate, p.time_step, dot.time_step, self.before, self.outlet, self._fixed, step],
            [state_dot.positions, state_dot.velocities],
        )


class EmitterAdjoint:
    """Reverse mode of `Emitter.lead`."""

    def __init__(self, emitter: Emitter):
        self._emitter = emitter
        self.free = emitter.free.like()
        """Adjoint of the state without the nozzle; its fractions are not used."""
        self._led = emitter.free.like()
        x = self._led.positions
        self._sums = [sum_of(x.dtype, len(x), x.device) for _ in range(2)]
        self._time_step_bar = wp.zeros(1, dtype=emitter.upstream.dtype, device=x.device)

    def step(self, parameters: Parameters, step: wp.array, state_bar: State, bar: Parameters) -> None:
        """Part the adjoint of a new state into that of ``free`` and what is added to ``bar``."""
        emitter, p, nozzle, launch = self._emitter, parameters, self._emitter.nozzle, self._emitter.launch
        led, free = self._led, self.free
        launch(
            emitter.kernels.adjoint,
            [nozzle.first, emitter.upstream, nozzle.area, p.flow_rate, p.time_step, emitter.before, step]
            + [state_bar.positions, state_bar.velocities],
            [free.positions, free.velocities, led.positions, led.velocities],
        )
        totals = [add_up(array) for add_up, array in zip(self._sums, (led.positions, led.velocities), strict=True)]
        launch(
            emitter.kernels.collect,
            [emitter.direction, nozzle.area, p.nozzle_path, p.flow_rate, p.time_step]
            + [emitter.before, emitter.outlet, step, *totals],
            [bar.nozzle_path, bar.flow_rate, self._time_step_bar],
            threads=1,
        )

    def clear(self) -> None:
        """Forget the time step's adjoint of the steps so far."""
        self._time_step_bar.zero_()

    def collect(self, bar: Parameters) -> None:
        """Add the adjoint of the time step of all steps since `clear`."""
        add(self._time_step_bar, bar.time_step)
