"""Losses of a problem for the reference engine."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado import losses, reference
from cortado.errors import InputError
from cortado.losses import Snapshot
from cortado.losses.loss import by_field
from cortado.losses.run_losses import as_loss
from cortado.problem import Problem
from cortado_reference.digits import Digits


def reference_loss(problem: Problem) -> reference.Loss:
    """The loss of a problem's last state: final positions with all digits, any other in the problem's precision."""
    if isinstance(problem.loss, losses.Frames):
        raise InputError("loss has frames, but must be one of the last state for the reference engine.")
    if isinstance(problem.loss, losses.FinalPositions):
        return reference.FinalPositions(problem.loss.target)
    return _OnDevice(problem)


class _OnDevice:
    def __init__(self, problem: Problem):
        self._simulation, self._loss = problem.simulation, as_loss(problem.loss)

    def value(self, positions: Digits, velocities: Digits) -> float:
        return float(self._loss.value(self._end(positions, velocities)))

    def adjoint(self, positions: Digits, velocities: Digits) -> tuple[NDArray[Any], NDArray[Any]]:
        _, bar = self._loss.value_and_adjoint(self._end(positions, velocities))
        found = by_field(bar, self._simulation.dimension)
        return found["positions"].astype(np.float64), found["velocities"].astype(np.float64)

    def _end(self, positions: Digits, velocities: Digits) -> Snapshot:
        given, state = self._simulation.parameters(), self._simulation.solver.new_state()
        fractions = given["mass_fractions"]
        state.set({"positions": positions.high, "velocities": velocities.high, "mass_fractions": fractions})
        return Snapshot(state, self._simulation.dimension, given["colours"])
