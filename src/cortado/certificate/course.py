"""Runs of a problem, judged at several steps on the way."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cortado.checked_loss import as_loss
from cortado.controls import Controls
from cortado.errors import DivergedError
from cortado.losses import EndAdjoint, Frames, TrajectoryEnd
from cortado.parameter_values import Arrays, Values
from cortado.particles import State
from cortado.problem import Problem
from cortado.rollout import Rollout

MOMENTS = 25
"""Steps at most at which a run is judged, where its loss is one of the last state."""


@dataclass(frozen=True)
class Tangent:
    """Derivatives along one direction, by forward mode."""

    losses: np.ndarray
    """(moments,)"""
    slopes: np.ndarray
    """(moments,) of the loss."""
    strain: np.ndarray
    """(moments,) root mean square over particles of how far the tangents of a particle and of its nearest neighbour
    part [m]."""


class Course:
    """A problem whose loss is also asked at earlier steps: what it would be if the run ended there, or, where it is one
    of several frames, of those so far."""

    def __init__(self, problem: Problem):
        loss, steps = problem.loss, problem.steps
        frames = loss.losses if isinstance(loss, Frames) else None
        moments = range(steps + 1) if steps < MOMENTS else np.linspace(0, steps, MOMENTS + 1).round().astype(int)
        self.problem = problem
        self.moments = np.array(sorted(frames) if frames else list(moments)[min(1, steps) :])
        """Steps at which the loss is asked, the last is that of the problem's own loss."""
        self._losses = {int(m): as_loss(frames[m] if frames else loss) for m in self.moments}
        self._total = np.cumsum if frames else np.asarray

    def losses(self, parameters: Values) -> np.ndarray:
        """(moments,) of the loss; NaN where the run diverges."""
        try:
            ends = self.problem.states(parameters, self._losses)
        except DivergedError:
            return np.full(len(self.moments), np.nan)
        return self._judged(ends)

    def difference(self, parameters: Arrays, along: Arrays, h: float) -> np.ndarray:
        """(moments,) of the central difference of step h along a direction of all or some of the parameters."""
        ahead, behind = (
            self.losses({**parameters, **{name: parameters[name] + sign * h * d for name, d in along.items()}})
            for sign in (1.0, -1.0)
        )
        return (ahead - behind) / (2.0 * h)

    def tangent(self, parameters: Arrays, along: Arrays) -> Tangent:
        """Derivatives along a direction, which names all or some of the parameters."""
        simulation, controls = self.problem.simulation, Controls(self.problem.simulation, self.problem.steps)
        values, directions = controls.checked(parameters), controls.checked(along, "direction")
        rollout, colours = Rollout(simulation.solver, self.problem.steps), controls.colours(values)
        ends: dict[int, TrajectoryEnd] = {}
        slopes, strain = [], []

        def keep(step: int, state: State) -> None:
            if step in self._losses:
                ends[step] = TrajectoryEnd(state, simulation.dimension, colours)

        def project(step: int, dot: State) -> None:
            if step in self._losses:
                bar, arrays = self._losses[step].adjoint(ends[step]), dot.numpy(simulation.dimension)
                slopes.append(_product(bar, arrays) + _of_colours(bar, directions))
                strain.append(_strain(ends[step].positions, arrays[0]))

        controls.begin(rollout, values, directions)
        keep(0, rollout.initial)
        rollout.forward(keep, keep=False)
        rollout.tangent(*controls.direction(rollout, values, directions), project)
        return Tangent(self._judged(ends), self._total(slopes), np.array(strain))

    def _judged(self, ends: dict[int, TrajectoryEnd]) -> np.ndarray:
        return self._total([loss.value(ends[step]) for step, loss in self._losses.items()])


def _product(bar: State | EndAdjoint | tuple[np.ndarray, ...], dot: tuple[np.ndarray, ...]) -> float:
    """The adjoint of a state times its tangent."""
    if isinstance(bar, EndAdjoint):
        return _product(bar.state, dot)
    arrays = bar.numpy(dot[0].shape[1]) if isinstance(bar, State) else bar
    return float(sum((a.astype(np.float64) * b).sum() for a, b in zip(arrays, dot, strict=False)))


def _of_colours(bar: object, along: Arrays) -> float:
    if isinstance(bar, EndAdjoint) and "colours" in along:
        return float((bar.colours * along["colours"]).sum())
    return 0.0


def _strain(positions: np.ndarray, dot: np.ndarray) -> float:
    if len(positions) < 2:
        return 0.0
    nearest = cKDTree(positions).query(positions, k=2)[1][:, 1]
    return float(np.sqrt(((dot - dot[nearest]) ** 2).sum(axis=1).mean()))
