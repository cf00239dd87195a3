"""The loss of a problem, and its derivatives, as functions of the number of steps of the run, in float64."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from cortado.device.precision import FLOAT64
from cortado.errors import DivergedError
from cortado.gradients.estimator import NO_RUN
from cortado.losses import (
    CentreOfMass,
    CentreOfMassAlong,
    FinalPositions,
    Frames,
    Image,
    Loss,
    SensorMatch,
    Snapshot,
    SnapshotAdjoint,
)
from cortado.losses.loss import Adjoint, by_field, slope
from cortado.losses.run_losses import as_loss
from cortado.particles.state import State
from cortado.problem import Problem
from cortado.render.renderer import Renderer
from cortado.scene.parameter_values import Arrays
from cortado.simulation import Simulation


def up_to(problem: Problem, steps: int) -> Problem | None:
    """The same problem of so many steps, at the end of which its loss is one, or that of its frames up to there; None
    where nothing is left of it."""
    loss: Any = problem.loss
    if isinstance(loss, Frames):
        kept = {step: one for step, one in loss.losses.items() if step <= steps}
        loss = Frames(kept) if kept else None
    return Problem(problem.simulation, steps, loss, problem.memory_budget) if loss is not None and steps > 0 else None


def first_rows(problem: Problem, values: Arrays, steps: int) -> Arrays:
    """Parameters of a problem as those of its first steps."""
    known = problem.simulation.known
    over_time = {name for name, value in values.items() if name in known.over_time and value.ndim > known[name].rank}
    return {name: value[:steps] if name in over_time else value for name, value in values.items()}


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


SAMPLE_STEPS = 25
"""Sample steps at most, where the loss is one of the last state."""
ROUGH = (1e-1, 1e-2, 1e-3)
"""Steps h of central differences of a loss in float32, in units of the direction."""
ROUND_OFF = 1e-6
"""Relative round-off of a loss in float32."""
ABOVE_ROUND_OFF = 30.0
"""A difference of such losses counts where it is this many times greater than their round-off."""


@dataclass(frozen=True)
class Tangent:
    """Derivatives along one direction, by forward mode."""

    losses: np.ndarray
    """(sample_steps,)"""
    slopes: np.ndarray
    """(sample_steps,) of the loss."""
    strain: np.ndarray
    """(sample_steps,) distance between the tangent of a particle's position and that of its nearest neighbour [m], root
    mean square over particles."""


class LossHistory:
    """A problem whose loss is also computed at earlier steps, the sample steps, as if the run ended there.

    A loss of several frames (`Frames`) is sampled at its frames; there it is the sum of those up to the sample step.
    """

    def __init__(self, problem: Problem):
        loss, steps = problem.loss, problem.steps
        frames = loss.losses if isinstance(loss, Frames) else None
        every = steps < SAMPLE_STEPS
        spread = range(steps + 1) if every else np.linspace(0, steps, SAMPLE_STEPS + 1).round().astype(int)
        self.problem = problem
        self.sample_steps = np.array(sorted(frames) if frames else list(spread)[min(1, steps) :])
        """(sample_steps,) numbers of steps after which the loss is computed; the last is the problem's own."""
        by_step = {int(m): frames[m] if frames else loss for m in self.sample_steps}
        self._losses = {m: one if isinstance(one, Rounded) else as_loss(one) for m, one in by_step.items()}
        self._total = np.cumsum if frames else np.asarray

    def difference(self, parameters: Arrays, along: Arrays, h: float) -> np.ndarray:
        """(sample_steps,) central differences of step h along a direction of all or some of the parameters; NaN from
        the step on in which a run diverges."""
        return self.sides(parameters, along, h, np.zeros(len(self.sample_steps)))[0]

    def sides(self, parameters: Arrays, along: Arrays, h: float, losses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Those, and (sample_steps,) by how much the differences of step h to one side and to the other differ, given
        the ``losses`` (sample_steps,) between them; 0 of losses in float32, whose round-off would be all of it."""
        differences, sums = [], []
        for loss, before, after in self._beside(parameters, along, h):
            rounded = isinstance(loss, Rounded)
            old, new = loss.value(before), loss.value(after)
            differences.append(_change(loss, before, after) if rounded and h < 1.0 else new - old)
            sums.append(np.nan if rounded else old + new)
        unknown = [np.nan] * (len(self.sample_steps) - len(sums))
        bends = np.abs(self._total(sums + unknown) - 2.0 * losses) / h
        return self._total(differences + unknown) / (2.0 * h), np.nan_to_num(bends)

    def rough_miss(self, parameters: Arrays, along: Arrays) -> float:
        """Relative distance of the adjoints of `Rounded` losses from finite differences of their values.

        It is the least over the steps h, and of these the median over sample steps; 0 where no loss is `Rounded`, or
        where round-off is as large as the differences.
        """
        if not any(isinstance(loss, Rounded) for loss in self._losses.values()):
            return 0.0
        found = np.full((len(ROUGH), len(self.sample_steps)), np.inf)
        for row, h in zip(found, ROUGH, strict=True):
            for k, (loss, before, after) in enumerate(self._beside(parameters, along, h)):
                if isinstance(loss, Rounded):
                    by_adjoint, by_value = _change(loss, before, after), loss.value(after) - loss.value(before)
                    size, noise = max(abs(by_adjoint), abs(by_value)), ROUND_OFF * abs(loss.value(after))
                    row[k] = abs(by_adjoint - by_value) / size if size > ABOVE_ROUND_OFF * noise else np.inf
        seen = found.min(axis=0)
        return float(np.median(seen[np.isfinite(seen)])) if np.isfinite(seen).any() else 0.0

    def _beside(self, parameters: Arrays, along: Arrays, h: float) -> Iterator[tuple[Loss, Snapshot, Snapshot]]:
        """At every sample step its loss, and the states with parameters moved by -h and by h along the direction, as
        far as both runs come."""
        behind, ahead = (
            self._reached({**parameters, **{name: parameters[name] + step * d for name, d in along.items()}})
            for step in (-h, h)
        )
        for step, loss in self._losses.items():
            if step in behind and step in ahead:
                yield loss, behind[step], ahead[step]

    def _reached(self, parameters: Arrays) -> dict[int, Snapshot]:
        """The states at those sample steps that a run comes to before it loses a particle; none where it cannot
        begin."""
        try:
            return self.problem.states(parameters, self._losses)
        except NO_RUN as error:
            first_lost = error.step if isinstance(error, DivergedError) else 0
        steps = [step for step in self._losses if step < first_lost]
        if not steps or steps[-1] == 0:
            return {}
        problem, last = self.problem, steps[-1]
        shorter = Problem(problem.simulation, last, self._losses[last], problem.memory_budget)
        return shorter.states(first_rows(problem, parameters, last), steps)

    def tangent(self, parameters: Arrays, along: Arrays) -> Tangent:
        """Derivatives along a direction, which names all or some of the parameters."""
        dots: dict[int, Arrays] = {}
        dimension = self.problem.simulation.dimension

        def observe(step: int, dot: State) -> None:
            if step in self._losses:
                dots[step] = dot.numpy(dimension)

        ends = self.problem.tangents(parameters, along, observe, self._losses)
        slopes, strain = [], []
        for step, loss in self._losses.items():
            _, bar = loss.value_and_adjoint(ends[step])
            wanted = [name for name in by_field(bar, dimension) if name not in dots[step]]
            more = self.problem.along(ends[step], wanted, dots[step], parameters, along)
            slopes.append(float(slope(bar, {**along, **dots[step], **more})))
            strain.append(_strain(ends[step].positions, dots[step]["positions"]))
        losses = self._total([loss.value(ends[step]) for step, loss in self._losses.items()])
        return Tangent(losses, self._total(slopes), np.array(strain))


def _change(loss: Loss, before: Snapshot, after: Snapshot) -> float:
    """The same from the loss's adjoints: their mean times the difference of the states.

    It is exact to second order, and free of the round-off of the loss's values.
    """
    ends = (before, after)
    old, new = (end.state.numpy(end.dimension) for end in ends)
    distance = {name: new[name] - old[name] for name in new} | {"colours": after.colours - before.colours}
    bars = [loss.value_and_adjoint(end)[1] for end in ends]
    beyond = {name for bar in bars for name in by_field(bar, before.dimension) if name not in distance}
    distance |= {name: after[name] - before[name] for name in beyond}
    return 0.5 * sum(float(slope(bar, distance)) for bar in bars)


def _strain(positions: np.ndarray, dot: np.ndarray) -> float:
    if len(positions) < 2:
        return 0.0
    nearest = cKDTree(positions).query(positions, k=2)[1][:, 1]
    return float(np.sqrt(((dot - dot[nearest]) ** 2).sum(axis=1).mean()))
