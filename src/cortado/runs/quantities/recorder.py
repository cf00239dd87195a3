"""Quantities of the states of a run, recorded while it runs."""

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from cortado.arrays import require_names
from cortado.errors import DivergedError
from cortado.particles.state import State
from cortado.rollout.rollout import Rollout
from cortado.runs.quantities.moment import Evaluates, Moment
from cortado.scene.parameters.values import Arrays
from cortado.scene.quantities import QUANTITIES, check_quantity


class Recorder:
    """Computes quantities of the states of a rollout in the arrays of another solver of the same scene, as the
    rollout's own are at work."""

    def __init__(self, rollout: Rollout, names: Iterable[str], evaluator: Callable[[], Evaluates], dimension: int):
        """``evaluator`` makes what computes them, and is asked for it where there are ``names``. Raises `InputError`
        for a name that is none."""
        self.names = tuple(dict.fromkeys(check_quantity(name, "record") for name in require_names("record", names)))
        self._rollout, self._evaluator = rollout, evaluator() if self.names else None
        self._dimension = dimension

    def __call__(self, step: int, state: State) -> Arrays:
        """By name those of the state after so many steps, in the precision of the run."""
        made = self._evaluator
        if made is None:
            return {}
        real = self._rollout.solver.discretisation.precision.numpy
        moment = Moment.of(self._rollout, step, state, lambda: made)
        return {name: self._value(name, moment).astype(real) for name in self.names}

    def _value(self, name: str, moment: Moment) -> NDArray:
        """NaN where the step after the state loses a particle: the run says so where it takes it."""
        try:
            return moment.value(name)
        except DivergedError:
            positions = moment.state.positions
            return np.full(QUANTITIES[name].shape(len(positions), self._dimension), np.nan)
