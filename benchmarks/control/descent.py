"""An optimiser of Cortado as a contender."""

from dataclasses import dataclass

from cortado import gradients, optimise, optimisers

from .objective import BudgetSpent, Objective

ADAM = optimisers.Adam(0.1)
"""For controls that go from -1 to 1."""


@dataclass(frozen=True)
class Descent:
    """An optimiser with the gradients of an estimator."""

    estimator: gradients.GradientEstimator
    optimiser: optimisers.Optimiser = ADAM

    def search(self, objective: Objective, seed: int) -> None:
        start = objective.named(objective.start)
        bounds, iterations = dict.fromkeys(start, (-1.0, 1.0)), 1 + int(objective.budget)
        try:
            optimise(objective, start, self.optimiser, iterations, bounds, gradient=self.estimator)
        except BudgetSpent:
            return
