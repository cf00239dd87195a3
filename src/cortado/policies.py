"""How a rollout is differentiated: objects to be given to `Problem.value_and_gradient`."""

from dataclasses import dataclass
from typing import Any, Protocol

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
        self._bar = solver.new_parameters(rollout.steps)

    def begin(self) -> None:
        self._adjoint.clear()
        self._bar.clear()

    def step(self, state: State, iterations: int, bar: State) -> None:
        self._solver.record(state, self._parameters, iterations)
        self._adjoint.step(iterations, bar, bar, self._parameters, self._bar)

    def parameters(self) -> Parameters:
        self._adjoint.collect(self._bar)
        return self._bar


class _TapeStep:
    capturable = False

    def __init__(self, rollout: Rollout):
        solver = rollout.solver
        self._given, self._parameters = solver, rollout.parameters
        self._solver = solver.differentiable()
        self._before, self._after = (self._solver.new_state(requires_grad=True) for _ in range(2))
        self._own = self._solver.new_parameters(rollout.steps, requires_grad=True)

    def begin(self) -> None:
        self._solver.grow(self._given.search.capacity)
        self._solver.diffuse(self._given.mixture.substeps)
        self._own.assign(self._parameters)
        for array in self._own.arrays():
            array.grad.zero_()

    def step(self, state: State, iterations: int, bar: State) -> None:
        self._before.assign(state)
        wp.copy(self._solver.step_number, self._given.step_number)
        tape = wp.Tape()
        try:
            self._back(tape, iterations, bar)
        finally:
            self._forget(tape)

    def _back(self, tape: wp.Tape, iterations: int, bar: State) -> None:
        with tape:
            self._solver.record(self._before, self._own, iterations)
            self._solver.recorded(iterations, self._own, self._after)
        tape.backward(grads=dict(zip(self._after.arrays(), bar.arrays(), strict=True)))
        for own, total in zip(self._before.arrays(), bar.arrays(), strict=True):
            wp.copy(total, own.grad)

    def _forget(self, tape: Any) -> None:
        """Zero every adjoint but those of the parameters, which add up over the steps."""
        kept = {own.ptr for own in self._own.arrays()}
        for array, gradient in tape.gradients.items():
            if isinstance(array, wp.array) and array.ptr not in kept:
                gradient.zero_()

    def parameters(self) -> Parameters:
        return Parameters(*(array.grad for array in self._own.arrays()))
