"""A forward run of a problem with its loss, and the ways back through it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cortado.device.memory import require
from cortado.device.threads import Turn, in_turn
from cortado.errors import InputError
from cortado.fixed import Staying
from cortado.gradients import AdjointEstimator
from cortado.losses import SnapshotAdjoint
from cortado.losses.loss import StepBar
from cortado.particles.state import Parameters, State
from cortado.rollout.device_states import OfLost, without_lost
from cortado.rollout.parameter_space import ParameterSpace
from cortado.rollout.rollout import BackwardStep, Observer, Residual, Rollout
from cortado.runs.quantities.moment import add_to_row
from cortado.scene.parameter_values import Arrays


@dataclass(frozen=True)
class ProblemForwardPass(Staying):
    """A forward run of a problem with its loss, and the ways back through it."""

    loss: Any
    """Of a batch (batch,)."""
    instead = "but the problem can, and the parameters, with which it is run again"
    _residual: Residual
    _values: Arrays
    _bars: Mapping[int, SnapshotAdjoint]
    _space: ParameterSpace
    _derivatives: dict[AdjointEstimator, BackwardStep]

    @property
    def rollout(self) -> Rollout:
        """The run."""
        return self._residual.rollout

    @property
    def turn(self) -> Turn:
        """What a thread holds that uses the rollout."""
        return self.rollout.turn

    def _derivative(self, estimator: AdjointEstimator) -> BackwardStep:
        """The estimator's backward step, made once for each problem."""
        if self.rollout.solver.layout.batch is not None and not estimator.batches:
            raise InputError(
                f"{type(estimator).__name__} is given a batch, but has no `batches = True`, which says that it treats "
                "each scene by itself."
            )
        try:
            is_new = estimator not in self._derivatives
        except TypeError as error:
            raise InputError(f"estimator has an {error}, but must be a dataclass(frozen=True) of numbers.") from None
        if is_new:
            solver = self.rollout.solver
            parts = solver.gradient_memory(self.rollout.log)
            require(parts, "take a larger spacing or fewer pressure iterations", solver.device)
            self._derivatives[estimator] = estimator.derivative(self.rollout)
        return self._derivatives[estimator]

    @in_turn
    def back(self, estimator: AdjointEstimator, observe: Observer | None = None) -> Arrays:
        """The gradient by an estimator; ``observe`` is given the number and the adjoint of every state, from the last
        to the first.

        Other evaluations of the problem may be in between: the bits are the same. Raises `InputError` for an estimator
        whose settings may change, as its backward step would keep the first ones, and for one that may mix up the
        scenes of a batch.
        """
        derivative = self._derivative(estimator)
        return self._gradient(derivative, self._first_adjoint(derivative, observe))

    @in_turn
    def back_to_state(self, estimator: AdjointEstimator) -> tuple[Arrays, Arrays]:
        """As `back`, and the derivatives with respect to the fields of the first state, by name, and to its
        ``time``."""
        derivative = self._derivative(estimator)
        first = self._first_adjoint(derivative)
        initial_state = self._space.state_adjoint(self.rollout, self._values, first, derivative.parameters())
        return self._gradient(derivative, first), without_lost(self._lost, initial_state)

    @property
    def _lost(self) -> OfLost:
        """Their losses have no numbers, and so no derivatives."""
        return dict.fromkeys(self.rollout.lost, np.nan)

    def _first_adjoint(self, derivative: BackwardStep, observe: Observer | None = None) -> State:
        self._residual.bring_back()
        first = self.rollout.backward(derivative, {step: bar.state for step, bar in self._bars.items()}, observe)
        for own in (bar.step for bar in self._bars.values()):
            if own is not None:
                self._add(own, derivative.parameters())
        return first

    def _add(self, own: StepBar, total: Parameters) -> None:
        """Add adjoints of the parameters of one step to those of all steps."""
        for name, bar in own.parameters.items():
            whole = total[name].numpy()
            add_to_row(self.rollout, name, bar, own.row, whole)
            total[name].assign(whole)

    def _gradient(self, derivative: BackwardStep, first: State) -> Arrays:
        bars, values = self._bars, self._values
        gradient = self._space.gradient(self.rollout, values, first, derivative.parameters())
        if "colours" in values:
            gradient["colours"] = np.sum([bar.colours for bar in bars.values()], axis=0)
        gradient = without_lost(self._lost, gradient)
        return {name: gradient[name] for name in values}
