"""A copy of a problem in float64: in float32 the round-off is far greater than the errors a certificate looks for."""

from dataclasses import replace
from typing import Any

from cortado.device.precision import FLOAT64
from cortado.losses import (
    CentreOfMass,
    CentreOfMassAlong,
    FinalPositions,
    Frames,
    Image,
    SensorMatch,
    Snapshot,
    SnapshotAdjoint,
)
from cortado.losses.loss import Adjoint, by_field
from cortado.losses.run_losses import as_loss
from cortado.particles.state import State
from cortado.problem import Problem
from cortado.render.renderer import Renderer
from cortado.simulation import Simulation

ANY_PRECISION = (FinalPositions, CentreOfMass, CentreOfMassAlong, SensorMatch)
"""Losses that take states of either precision."""


def in_float64(problem: Problem) -> Problem:
    """The problem itself where it is one in float64, else the same scene, device, steps and loss in float64.

    Losses of this package are computed from states in float64 then. Whether any other loss can be is not known, so it
    is still computed in float32: see `Rounded`.
    """
    single = problem.simulation
    if single.precision == FLOAT64:
        return problem
    double = single.in_precision("float64")
    loss: Any = problem.loss
    if isinstance(loss, Frames):
        loss = Frames({step: _loss_in_float64(one, single) for step, one in loss.losses.items()})
    else:
        loss = _loss_in_float64(loss, single)
    return Problem(double, problem.steps, loss, 2 * problem.memory_budget)


def _loss_in_float64(loss: Any, single: Simulation) -> Any:
    if type(loss) in ANY_PRECISION:
        return loss
    if type(loss) is Image and isinstance(loss.renderer, Renderer):
        return Image(loss.renderer.in_precision(FLOAT64), loss.target, loss.distance)
    return Rounded(loss, single)


class Rounded:
    """A loss that may work in float32 alone, given states in float64, which are rounded to float32 for it."""

    def __init__(self, loss: Any, single: Simulation):
        """``single``: the simulation in float32 that the loss was made for."""
        self._loss, self._single = as_loss(loss), single

    def value(self, end: Snapshot) -> float:
        return self._loss.value(self._rounded(end))

    def value_and_adjoint(self, end: Snapshot) -> tuple[float, Adjoint]:
        value, bar = self._loss.value_and_adjoint(self._rounded(end))
        if not isinstance(bar, (State, SnapshotAdjoint)):
            return value, bar
        state = end.state.like()
        state.set(by_field(bar, end.dimension))
        return value, SnapshotAdjoint(state, bar.colours) if isinstance(bar, SnapshotAdjoint) else state

    def _rounded(self, end: Snapshot) -> Snapshot:
        state = self._single.solver.new_state()
        state.set(end.state.numpy(end.dimension))
        if end.moment is None:
            return Snapshot(state, end.dimension, end.colours)
        single = replace(end.moment, state=state, evaluator=self._single.evaluator, _values={})
        return Snapshot(state, end.dimension, end.colours, single)
