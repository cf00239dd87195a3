"""How a rollout is differentiated: objects to be given to `Problem.value_and_gradient`."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import warp as wp

from cortado.particles import Parameters, State
from cortado.rollout import Rollout, StepDerivative
from cortado.solvers.pcisph_derivatives import PcisphAdjoint


class Policy(Protocol):
    """A way to go back through a rollout."""

    def derivative(self, rollout: Rollout) -> StepDerivative:
        """The backward step for one rollout."""


@dataclass(frozen=True)
class Exact:
    """The exact adjoint of the discrete step, by gathers: no atomics, the same bits every time.

    Cost: each step once more forward, and about twice the neighbour sums of a step backward.
    """

    def derivative(self, rollout: Rollout) -> StepDerivative:
        return _ExactStep(rollout)


@dataclass(frozen=True)
class Tape:
    """The exact adjoint again, by Warp's own automatic differentiation of the forward kernels.

    The report's autograd: slower than `Exact`, with atomics on a GPU, and kept to check it.
    """

    def derivative(self, rollout: Rollout) -> StepDerivative:
        return _TapeStep(rollout)


class _ExactStep:
    capturable = True

    def __init__(self, rollout: Rollout):
        solver = rollout.solver
        self._solver, self._parameters = solver, rollout.parameters
        self._adjoint = PcisphAdjoint(solver)
        self._bar = Parameters.zeros(rollout.steps, solver.discretisation.precision, solver.search.device)

    def begin(self) -> None:
        self._adjoint.clear()

    def step(self, state: State, iterations: int, bar: State) -> None:
        self._solver.record(state, self._parameters, iterations)
        self._adjoint.step(iterations, bar, bar, self._parameters, self._bar)

    def parameters(self) -> tuple[np.ndarray, np.ndarray]:
        gravity = self._bar.gravity.numpy().astype(np.float64)
        return gravity, self._adjoint.scalars().numpy()[0].astype(np.float64)


class _TapeStep:
    capturable = False

    def __init__(self, rollout: Rollout):
        solver = rollout.solver
        precision, device = solver.discretisation.precision, solver.search.device
        particles = solver.search.particles
        self._solver = solver.differentiable()
        self._step_number = solver.step_number
        self._before = State.zeros(particles, precision, device, requires_grad=True)
        self._after = State.zeros(particles, precision, device, requires_grad=True)
        self._parameters = Parameters.zeros(rollout.steps, precision, device, requires_grad=True)
        given = rollout.parameters
        self._search = solver.search
        self._arrays: list[tuple[wp.array, wp.array]] = [
            (self._parameters.gravity, given.gravity),
            (self._parameters.rest_density, given.rest_density),
            (self._parameters.viscosity, given.viscosity),
            (self._parameters.time_step, given.time_step),
        ]

    def begin(self) -> None:
        self._solver.grow(self._search.capacity)
        for own, source in self._arrays:
            wp.copy(own, source)
            own.grad.zero_()

    def step(self, state: State, iterations: int, bar: State) -> None:
        self._before.assign(state)
        wp.copy(self._solver.step_number, self._step_number)
        tape = wp.Tape()
        try:
            self._back(tape, iterations, bar)
        finally:
            self._forget(tape)

    def _back(self, tape: wp.Tape, iterations: int, bar: State) -> None:
        with tape:
            self._solver.record(self._before, self._parameters, iterations)
            self._solver.recorded(iterations, self._after)
        tape.backward(grads={self._after.positions: bar.positions, self._after.velocities: bar.velocities})
        wp.copy(bar.positions, self._before.positions.grad)
        wp.copy(bar.velocities, self._before.velocities.grad)

    def _forget(self, tape: Any) -> None:
        """Zero every adjoint but those of the parameters, which add up over the steps."""
        kept = {own.ptr for own, _ in self._arrays}
        for array, gradient in tape.gradients.items():
            if isinstance(array, wp.array) and array.ptr not in kept:
                gradient.zero_()

    def parameters(self) -> tuple[np.ndarray, np.ndarray]:
        p = self._parameters
        scalars = [a.grad.numpy()[0] for a in (p.rest_density, p.viscosity, p.time_step)]
        return p.gravity.grad.numpy().astype(np.float64), np.array(scalars, dtype=np.float64)
