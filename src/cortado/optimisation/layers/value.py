"""The loss of a problem as a layer: from parameters, and where wanted a state, to a number."""

from typing import Any

import numpy as np

from cortado.device.threads import Turn, in_turn
from cortado.errors import InputError, shown
from cortado.gradients import AdjointEstimator, Estimate, Exact, GradientEstimator
from cortado.gradients.estimator import checked_estimator
from cortado.optimisation.layers.layer import (
    PARAMETER,
    STATE,
    Layer,
    Named,
    OneByOne,
    Shapes,
    named,
    on_host,
    part,
    unbatched,
)
from cortado.optimisation.layers.parameters import LayerParameters
from cortado.optimisation.layers.states import LAST_STEP, check_state, named_states
from cortado.problem import Problem
from cortado.scene.parameter_values import Arrays

LOSS = "loss"
"""The name of what it returns."""


class Evaluation:
    """One forward run of a problem, of which derivatives are computed when they are asked for."""

    def __init__(self, problem: Problem, values: Arrays, estimator: GradientEstimator, with_state: bool):
        self._problem, self.values, self._estimator, self._with_state = problem, values, estimator, with_state
        self._run = problem.forward_pass(values) if isinstance(estimator, AdjointEstimator) else None
        self._found: Arrays | None = None
        if self._run is None:
            found: Estimate = problem.estimate(values, estimator)
            self._found = named(PARAMETER, found.gradient)
        self.loss: Any = found.loss if self._run is None else self._run.loss

    @property
    def gradient(self) -> Arrays:
        """The derivatives of the loss by the names of arrays of the layer, in float64, of a batch with a first axis."""
        if self._found is None:
            assert self._run is not None and isinstance(self._estimator, AdjointEstimator)
            if self._with_state:
                found, state = self._run.back_to_state(self._estimator)
                last = {LAST_STEP: np.zeros(np.shape(self.loss))}  # by which the steps were chosen: see docs/steps.md
                self._found = {**named(PARAMETER, found), **named(STATE, state | last)}
            else:
                self._found = named(PARAMETER, self._run.back(self._estimator))
            self._run = None  # and the states that it keeps
        return self._found

    def along(self, dots: Named) -> Any:
        """The derivative of the loss along tangents: by forward mode, unless an estimator was asked for."""
        if isinstance(self._estimator, Exact) and not self._with_state and self._found is None:
            return self._problem.tangent(self.values, part(dots, PARAMETER))
        terms = [self.gradient[name] * dot for name, dot in dots.items()]
        return sum(np.reshape(term, (*np.shape(self.loss), -1)).sum(axis=-1) for term in terms) + 0.0 * self.loss


class Value(Layer):
    """The loss of a problem. Its arrays are parameters, and those of a state if the problem is to begin there."""

    def __init__(self, problem: Problem, gradient: GradientEstimator | None = None, each: bool = False):
        """``gradient``: the estimator that reverse mode goes by, `gradients.Exact` by default; ``each`` as that of
        `LayerParameters`."""
        super().__init__()
        if not isinstance(problem, Problem):
            raise InputError(f"problem is {shown(problem)}, but must be a cortado.Problem.")
        self._problem, self._each = problem, each
        self._estimator = Exact() if gradient is None else checked_estimator(gradient)
        simulation = problem.simulation
        self._states = named_states(simulation)
        self._parameters = LayerParameters(simulation, problem.steps, each)
        self.real, self.device = simulation.precision.numpy, simulation.device
        own = sum(array.capacity for array in simulation.initial.arrays())
        self.kept_bytes = min(problem.steps * own, problem.memory_budget)

    @property
    def turn(self) -> Turn:
        """What a thread holds that uses it."""
        return self._problem.turn

    def check(self, given: Shapes) -> None:
        own = part(given, STATE)
        if own:
            check_state(own, self._states.shapes)
        if own and not isinstance(self._estimator, AdjointEstimator):
            kind = type(self._estimator).__name__
            raise InputError(
                f"gradient is a {kind}, but must go back through a run where a state is given: an AdjointEstimator."
            )
        self._parameters.check(given, with_state=bool(own) or self._problem.state is not None)

    def outputs(self) -> dict[str, tuple[int, ...]]:
        batch = self._problem.simulation.batch
        return {LOSS: () if batch is None else (batch,)}

    @in_turn
    def evaluate(self, given: Named, keep: bool) -> tuple[Named, Any]:
        values, own, problem = self._parameters.values(given), part(given, STATE), self._problem
        if own:
            state = self._states.state(own, values)
            problem = problem.beginning_at(problem.simulation.on_host(state))
        if not keep:
            return {LOSS: np.asarray(problem.value(values))}, None
        found = Evaluation(problem, values, self._estimator, bool(own))
        return {LOSS: np.asarray(found.loss)}, found

    @in_turn
    def pull(self, residual: Evaluation, bars: Named) -> Named:
        bar = on_host(bars[LOSS]).astype(np.float64).reshape(np.shape(residual.loss)) if LOSS in bars else 0.0
        scaled = {name: _times(found, bar) for name, found in residual.gradient.items()}
        own = self._parameters.adjoints(part(scaled, PARAMETER), residual.values)
        return {**{name: found for name, found in scaled.items() if name.startswith(STATE)}, **own}

    @in_turn
    def push(self, residual: Evaluation, dots: Named) -> Named:
        own = {name: on_host(dot).astype(np.float64) for name, dot in dots.items() if name.startswith(STATE)}
        found = np.asarray(residual.along({**own, **named(PARAMETER, self._parameters.values(dots))}))
        return {LOSS: np.where(self._moved(dots), found, 0.0)}

    def _moved(self, dots: Named) -> Any:
        """Of each scene, (batch,) or (), whether a tangent is not 0; tangents that all scenes of a batch share are of
        each."""
        found = np.zeros(self.outputs()[LOSS], dtype=bool)
        for name, dot in dots.items():
            array = on_host(dot)
            own = self._each or name.startswith(STATE)
            found |= array.reshape(*found.shape, -1).any(axis=-1) if own else bool(array.any())
        return found

    def check_mapped(self) -> None:
        if self._problem.simulation.batch is not None:
            raise unbatched(f"a problem whose simulation is a batch of {self._problem.simulation.batch}")

    def many(self, size: int) -> Layer:
        estimator = self._estimator
        if not isinstance(estimator, AdjointEstimator) or not estimator.batches:
            return OneByOne(self, size)
        return Value(self._problem.batch_of(size), estimator, each=True)


def _times(found: np.ndarray, bar: Any) -> np.ndarray:
    """A derivative, of a batch with a first axis for the scenes, times that with respect to the loss; 0 where this is
    0, also of what has no numbers."""
    factor = np.reshape(bar, (*np.shape(bar), *(1,) * (found.ndim - np.ndim(bar))))
    return np.where(factor == 0.0, 0.0, found) * factor
