"""Quantities of the states of a run, recorded while it runs."""

from collections.abc import Callable, Iterable

from cortado.arrays import require_names
from cortado.device.state import State
from cortado.parameters.values import Arrays
from cortado.quantities.known import check_quantity
from cortado.quantities.moment import Evaluates, Moment
from cortado.rollout import Rollout


class Recorder:
    """Computes quantities of the states of a rollout in the arrays of another solver of the same scene, as the
    rollout's own are at work."""

    def __init__(self, rollout: Rollout, names: Iterable[str], evaluator: Callable[[], Evaluates]):
        """``evaluator`` makes what computes them, and is asked for it where there are ``names``. Raises `InputError`
        for a name that is none."""
        self.names = tuple(dict.fromkeys(check_quantity(name, "record") for name in require_names("record", names)))
        self._rollout, self._evaluator = rollout, evaluator() if self.names else None

    def __call__(self, step: int, state: State) -> Arrays:
        """By name those of the state after so many steps, in the precision of the run."""
        made = self._evaluator
        if made is None:
            return {}
        real = self._rollout.solver.discretisation.precision.numpy
        found = made.values(self.names, Moment.of(self._rollout, step, state, lambda: made))
        return {name: value.astype(real) for name, value in found.items()}
