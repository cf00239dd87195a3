"""An evaluation of a rollout, put aside while others follow."""

from collections.abc import Iterable
from typing import Protocol

from numpy.typing import NDArray

from cortado.particles.state import Parameters, State
from cortado.solvers.solver import Solver, StepLog


class Evaluated(Protocol):
    """A rollout as its evaluations see it."""

    solver: Solver
    steps: int
    initial: State
    parameters: Parameters
    time_steps: NDArray
    log: StepLog


class PutAside:
    """What the next evaluation of a rollout overwrites, in arrays of its own."""

    def __init__(self, rollout: Evaluated, replaced: Iterable[str]):
        """``replaced``: attributes of the rollout that are replaced, and not overwritten."""
        self._first, self._parameters = rollout.initial.copy(), rollout.parameters.written
        self._time_steps, self._log = rollout.time_steps.copy(), rollout.solver.new_log(rollout.steps)
        self._log.assign(rollout.log)
        self._replaced = {name: getattr(rollout, name) for name in replaced}

    def bring_back(self, rollout: Evaluated) -> None:
        """Write it to the rollout again."""
        rollout.initial.assign(self._first)
        rollout.parameters.set(self._parameters)
        rollout.time_steps[:] = self._time_steps
        rollout.log.assign(self._log)
        for name, value in self._replaced.items():
            setattr(rollout, name, value)


class Pending(Protocol):
    """Who will come back to an evaluation."""

    def put_aside(self) -> None:
        """Keep what the next evaluation overwrites."""
