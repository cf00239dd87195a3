"""Runs of a problem, judged at several steps on the way."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from cortado.certificate.twin import Rounded
from cortado.device.state import State
from cortado.errors import DivergedError
from cortado.losses import Frames, Loss, Snapshot, SnapshotAdjoint
from cortado.losses.checked import as_loss
from cortado.losses.loss import Adjoint, adjoint_arrays
from cortado.parameters.values import Arrays
from cortado.problem import Problem

MOMENTS = 25
"""Steps at most at which a run is judged, where its loss is one of the last state."""
ROUGH = (1e-1, 1e-2, 1e-3)
"""Steps of differences of a loss in float32, in units of the direction."""
ROUND_OFF = 1e-6
"""Of such a loss, relative."""
HEARD = 30.0
"""How many times greater a difference has to be to mean something."""


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
        by_moment = {int(m): frames[m] if frames else loss for m in self.moments}
        self._losses = {m: one if isinstance(one, Rounded) else as_loss(one) for m, one in by_moment.items()}
        self._total = np.cumsum if frames else np.asarray

    def difference(self, parameters: Arrays, along: Arrays, h: float) -> np.ndarray:
        """(moments,) of the central difference of step h along a direction of all or some of the parameters; NaN where
        a run diverges."""
        changes = [
            _change(loss, before, after) if isinstance(loss, Rounded) and h < 1.0 else _values(loss, before, after)
            for loss, before, after in self._beside(parameters, along, h)
        ]
        return self._total(changes or np.full(len(self.moments), np.nan)) / (2.0 * h)

    def rough_miss(self, parameters: Arrays, along: Arrays) -> float:
        """How far the adjoints of losses that are `Rounded` are from differences of their own values, relative, at the
        step where they are nearest and in the median of moments; 0 where there is none, or round-off hides it."""
        if not any(isinstance(loss, Rounded) for loss in self._losses.values()):
            return 0.0
        found = np.full((len(ROUGH), len(self.moments)), np.inf)
        for row, h in zip(found, ROUGH, strict=True):
            for k, (loss, before, after) in enumerate(self._beside(parameters, along, h)):
                if isinstance(loss, Rounded):
                    by_adjoint, by_value = _change(loss, before, after), _values(loss, before, after)
                    size, noise = max(abs(by_adjoint), abs(by_value)), ROUND_OFF * abs(loss.value(after))
                    row[k] = abs(by_adjoint - by_value) / size if size > HEARD * noise else np.inf
        seen = found.min(axis=0)
        return float(np.median(seen[np.isfinite(seen)])) if np.isfinite(seen).any() else 0.0

    def _beside(self, parameters: Arrays, along: Arrays, h: float) -> Iterator[tuple[Loss, Snapshot, Snapshot]]:
        """At every moment its loss, and the states a step of -h and of h away; none where a run diverges."""
        try:
            behind, ahead = (
                self.problem.states(
                    {**parameters, **{name: parameters[name] + step * d for name, d in along.items()}}, self._losses
                )
                for step in (-h, h)
            )
        except DivergedError:
            return
        for step, loss in self._losses.items():
            yield loss, behind[step], ahead[step]

    def tangent(self, parameters: Arrays, along: Arrays) -> Tangent:
        """Derivatives along a direction, which names all or some of the parameters."""
        dots: dict[int, Arrays] = {}

        def observe(step: int, dot: State) -> None:
            if step in self._losses:
                dots[step] = dot.numpy(self.problem.simulation.dimension)

        ends = self.problem.tangents(parameters, along, observe, self._losses)
        slopes, strain = [], []
        for step, loss in self._losses.items():
            _, bar = loss.value_and_adjoint(ends[step])
            slopes.append(_product(bar, dots[step]) + _of_colours(bar, along))
            strain.append(_strain(ends[step].positions, dots[step]["positions"]))
        return Tangent(self._judged(ends), self._total(slopes), np.array(strain))

    def _judged(self, ends: dict[int, Snapshot]) -> np.ndarray:
        return self._total([loss.value(ends[step]) for step, loss in self._losses.items()])


def _values(loss: Loss, before: Snapshot, after: Snapshot) -> float:
    """By how much the loss of the latter state is greater."""
    return loss.value(after) - loss.value(before)


def _change(loss: Loss, before: Snapshot, after: Snapshot) -> float:
    """The same by the loss's adjoints: the mean of both times the distance of the states, which is exact to second
    order and has no round-off of the loss in it."""
    ends = (before, after)
    old, new = (end.state.numpy(end.dimension) for end in ends)
    distance, colours = {name: new[name] - old[name] for name in new}, {"colours": after.colours - before.colours}
    bars = [loss.value_and_adjoint(end)[1] for end in ends]
    return 0.5 * sum(_product(bar, distance) + _of_colours(bar, colours) for bar in bars)


def _product(bar: Adjoint, dot: Arrays) -> float:
    """The adjoint of a state times its tangent."""
    arrays = adjoint_arrays(bar, dot["positions"].shape[1])
    return float(sum((array.astype(np.float64) * dot[name]).sum() for name, array in arrays.items()))


def _of_colours(bar: object, along: Arrays) -> float:
    if isinstance(bar, SnapshotAdjoint) and "colours" in along:
        return float((bar.colours * along["colours"]).sum())
    return 0.0


def _strain(positions: np.ndarray, dot: np.ndarray) -> float:
    if len(positions) < 2:
        return 0.0
    nearest = cKDTree(positions).query(positions, k=2)[1][:, 1]
    return float(np.sqrt(((dot - dot[nearest]) ** 2).sum(axis=1).mean()))
