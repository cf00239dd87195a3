"""An evaluation of a rollout, put aside while others follow."""

from typing import Protocol

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.particles.state import Parameters, State
from cortado.rollout.step_sizes import StepSizes
from cortado.solvers.solver import Solver, StepLog

OF_AN_EVALUATION = (
    "clocks",
    "origins",
    "substeps",
    "advice",
    "lost",
    "goes_on",
    "evaluation",
    "_checkpoints",
    "_kept",
    "_run",
)
"""Attributes of a rollout that are replaced, and not overwritten, from one evaluation to the next."""


class Evaluated(Protocol):
    """A rollout as its evaluations see it."""

    solver: Solver
    steps: int
    initial: State
    parameters: Parameters
    time_steps: NDArray
    log: StepLog
    step_sizes: StepSizes


class PutAside:
    """What the next evaluation of a rollout overwrites, in arrays of its own."""

    def __init__(self, rollout: Evaluated):
        self._first = rollout.initial.copy()
        self._parameters = {name: _copied(value) for name, value in rollout.parameters.written.items()}
        self._sizes = rollout.step_sizes.recorded()
        self._time_steps, self._log = rollout.time_steps.copy(), rollout.solver.new_log(rollout.steps)
        self._log.assign(rollout.log)
        self._replaced = {name: getattr(rollout, name) for name in OF_AN_EVALUATION}

    def bring_back(self, rollout: Evaluated) -> None:
        """Write it to the rollout again."""
        rollout.initial.assign(self._first)
        rollout.parameters.set(self._parameters)
        rollout.time_steps[:] = self._time_steps
        rollout.log.assign(self._log)
        rollout.step_sizes.assign(self._sizes)
        for name, value in self._replaced.items():
            setattr(rollout, name, value)


def _copied(value: np.ndarray | wp.array) -> np.ndarray | wp.array:
    return wp.clone(value) if isinstance(value, wp.array) else value.copy()


class Pending(Protocol):
    """Who will come back to an evaluation."""

    def put_aside(self) -> None:
        """Keep what the next evaluation overwrites."""
