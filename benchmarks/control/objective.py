"""A task as a search sees it: a function of numbers from -1 to 1, that counts the steps it simulates."""

import math
from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np

from cortado import DivergedError, Problem
from cortado.gradients import AdjointEstimator, Estimate, GradientEstimator
from cortado.optimisation.transforms import FixedParameters, Transformed
from cortado.scene.parameter_values import Arrays

from ..counting import Counted, Steps
from .task import Task

POSITION_NOISE = 0.01
"""Of the first positions of a seed [spacings]."""
GREATEST = 1e100
"""Components of a gradient are limited to it, so that Adam can square them."""
BAD = 10.0
"""A run that diverged counts as so many times the loss of the baseline."""


class BudgetSpent(Exception):
    """A search has simulated as many steps as it may; what it has evaluated beyond them does not count."""


class Objective:
    """The loss of a task from first positions of a seed's own, as a function of the numbers of its controls."""

    def __init__(self, task: Task, problem: Problem, seed: int, budget: float):
        """``budget``: simulated steps after which no further run begins."""
        self.task, self.budget, self.steps = task, budget, Steps()
        self.inner = problem
        """Whose steps are not counted."""
        self._bad = BAD * abs(problem.value(task.controls.parameters(task.baseline)))
        self._begin(task.baseline, first_positions(problem, seed))

    def _begin(self, start: np.ndarray, fixed: Arrays, late: float = 1.0) -> None:
        self.start = start
        """(numbers,) where searches begin."""
        self.fixed = fixed
        """Parameters in the place of the scene's, such as the seed's first positions."""
        shares = self.named(start).items()
        self._changed = self._flat({name: np.arange(len(u)) >= (1.0 - late) * len(u) for name, u in shares})
        counted: Any = Counted(FixedParameters(self.inner, fixed), self.inner.steps, self.steps)
        self.problem = Transformed(counted, self.task.controls.mappings)
        self.curve: list[tuple[float, float]] = []
        """Simulated steps, and the loss of the run that they end with; infinite for one that diverged."""
        self.best, self.best_loss = start, math.inf

    def easier(self, start: np.ndarray, share: float, fixed: Arrays, late: float) -> "Objective":
        """The same for a share of the budget and from another start, with a curve of its own: parameters of the scene
        are replaced by these, and only a share of the controls is changed, the last ones."""
        found = copy(self)
        found.budget = min(self.steps.cost + share * self.budget, self.budget)
        found._begin(start, {**self.fixed, **fixed}, late)
        return found

    def named(self, u: np.ndarray) -> Arrays:
        """The numbers as what `problem` is given."""
        return self.task.controls.named(u)

    def _flat(self, named: Arrays) -> np.ndarray:
        """(numbers,) of what `problem` is given."""
        return self.task.controls.flat(named)

    def values(self, points: Sequence[np.ndarray]) -> np.ndarray:
        """(points,) the losses, as many at a time in one launch as the device takes; of those that diverged a bad one.
        Raises `BudgetSpent`."""
        found: list[float] = []
        room = max(self.problem.room(), 1)
        while len(found) < len(points):
            self.require_budget()
            part = [self.named(u) for u in points[len(found) : len(found) + room]]
            before = self.steps.cost
            if room > 1:
                losses = [_loss(one) for one in self.problem.together(part)]
            else:
                losses = [self._value(one) for one in part]
            each = (self.steps.cost - before) / len(part)
            for k, (u, loss) in enumerate(zip(part, losses, strict=True), 1):
                found.append(self._noted(self._flat(u), loss, before + k * each))
        return np.array(found)

    def value_and_gradient(self, parameters: Arrays, gradient: GradientEstimator | None = None) -> tuple[float, Arrays]:
        """As `cortado.optimise` asks. Where the run diverged, the gradient leads back to the best controls so far; its
        numbers that overflowed are 0."""
        self.require_budget()
        u = self._flat(parameters)
        try:
            found = self.problem.estimate(parameters, gradient)
        except DivergedError:  # of this run, or of another one in an ensemble around it
            loss = math.inf if isinstance(gradient, AdjointEstimator) else self._value(parameters)
            return self._noted(u, loss, self.steps.cost), self.named(self._away_from_best(u))
        slopes = np.nan_to_num(self._flat(found.gradient), nan=0.0, posinf=0.0, neginf=0.0)
        slopes = np.clip(np.where(self._changed, slopes, 0.0), -GREATEST, GREATEST)
        return self._noted(u, found.loss, self.steps.cost), self.named(slopes)

    def value(self, parameters: Arrays) -> float:
        """As a line search asks."""
        return float(self.values([self._flat(parameters)])[0])

    def room(self, estimator: AdjointEstimator | None = None) -> int:
        """See `Batchable.room`."""
        return max(self.problem.room(estimator), 1)

    def together(self, points: Sequence[Arrays], estimator: None = None) -> list[Estimate]:
        """See `Batchable.together`; losses alone."""
        return [Estimate(loss, {}) for loss in self.values([self._flat(point) for point in points])]

    def score(self) -> dict[str, float]:
        """Of the best controls."""
        return self.task.score(self.inner, {**self.task.controls.parameters(self.best), **self.fixed})

    def _away_from_best(self, u: np.ndarray) -> np.ndarray:
        """(numbers,) the gradient of a loss that rises evenly from the best controls to these, which are bad."""
        away = u - self.best
        return (self._bad - min(self.best_loss, self._bad)) * away / max(float(away @ away), 1e-12)

    def _value(self, u: Arrays) -> float:
        try:
            return self.problem.value(u)
        except DivergedError:
            return math.inf

    def _noted(self, u: np.ndarray, loss: float, steps: float) -> float:
        """The loss as a search is told it, which is entered into the curve. Raises `BudgetSpent` for a run that ended
        after the budget was spent."""
        if steps > self.budget:
            raise BudgetSpent
        loss = loss if math.isfinite(loss) else math.inf
        self.curve.append((steps, loss))
        if loss < self.best_loss:
            self.best, self.best_loss = u.copy(), loss
        return min(loss, self._bad)

    def require_budget(self) -> None:
        """Raises `BudgetSpent`."""
        if self.steps.cost >= self.budget:
            raise BudgetSpent


def first_positions(problem: Problem, seed: int) -> Arrays:
    """The parameter of the first positions (n, d) [m]: those of the scene, with a little noise but in a nozzle."""
    simulation = problem.simulation
    noise = np.random.default_rng(seed).standard_normal(simulation.positions.shape)
    noise[simulation.free_particles or len(noise) :] = 0.0
    noise *= POSITION_NOISE * simulation.scene.discretisation.spacing
    return {"initial_positions": simulation.positions + noise}


def _loss(found: Estimate | DivergedError) -> float:
    return math.inf if isinstance(found, DivergedError) else float(found.loss)
