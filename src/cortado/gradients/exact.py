"""Estimators that differentiate the discrete step exactly."""

from dataclasses import dataclass
from typing import Any

import warp as wp

from cortado.gradients.estimator import AdjointEstimator
from cortado.particles.state import Parameters, State
from cortado.rollout.adjoint_step import AdjointStep
from cortado.rollout.rollout import BackwardStep, Rollout
from cortado.solvers.solver import Counts


@dataclass(frozen=True)
class Exact(AdjointEstimator):
    """The exact adjoint of the discrete step, by gathers: no atomics, the same bits every time.

    Formula: the transposed derivative of the step. Bias: none; but where neighbouring trajectories diverge it grows as
    fast as they do, by a constant factor a step. Cost: every step is computed once more forward, and the backward step
    has about twice the neighbour sums of a forward one.
    """

    batches = True

    def derivative(self, rollout: Rollout) -> BackwardStep:
        return AdjointStep(rollout, rollout.solver.adjoint(rollout.steps))


@dataclass(frozen=True)
class Tape(AdjointEstimator):
    """The exact adjoint by Warp's own automatic differentiation of the forward kernels.

    It is slower than `Exact`, with atomics on a GPU, and is kept to check it. Only for scenes with the solver
    ``"pcisph"``; others say so.
    """

    batches = True

    def derivative(self, rollout: Rollout) -> BackwardStep:
        return _TapeStep(rollout)


class _TapeStep:
    capturable = False

    def __init__(self, rollout: Rollout):
        solver = rollout.solver
        self.rollout, self._given, self._parameters = rollout, solver, rollout.parameters
        self.solver = solver.differentiable()
        self._before = self.solver.new_state(requires_grad=True)
        self._after = self._before.following()
        self._own = self.solver.new_parameters(rollout.steps, requires_grad=True)

    def begin(self) -> None:
        self.solver.match(self._given)
        self._own.assign(self._parameters)
        for array in self._own.arrays():
            array.grad.zero_()

    def step(self, state: State, counts: Counts, bar: State) -> None:
        self._before.assign(state)
        self.solver.follow(self._given)
        wp.copy(self._own["time_step"], self._parameters["time_step"])  # of this step, where it is chosen
        tape = wp.Tape()
        try:
            self._back(tape, counts, bar)
        finally:
            self._forget(tape)

    def _back(self, tape: wp.Tape, counts: Counts, bar: State) -> None:
        with tape:
            self.solver.replay(self._before, self._own, counts)
            self.solver.write_state(counts, self._own, self._after)
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
        return self._own.gradients()
