"""What searches the controls of a task: gradients with Adam or a line search, CMA-ES, and a random search."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cortado import InputError, gradients, optimisers

from .descent import Descent
from .multiple_shooting import MultipleShooting
from .objective import BudgetSpent, Objective
from .staged import Easier, Staged


class Contender(Protocol):
    """Lowers an objective until its budget is spent; the objective keeps what was found."""

    def search(self, objective: Objective, seed: int) -> None:
        """Evaluates at first where searches begin. Raises `InputError` where it cannot do this task."""


@dataclass(frozen=True)
class CMAES:
    """Covariance matrix adaptation (Hansen 2016), with the settings of the package cma; a population is one launch."""

    sigma: float = 0.3

    def search(self, objective: Objective, seed: int) -> None:
        try:
            from cma import CMAEvolutionStrategy
        except ImportError:
            raise InputError("The package cma is missing; install it with pip install cma.") from None
        options = {"bounds": [-1.0, 1.0], "seed": seed + 1, "verbose": -9}
        strategy = CMAEvolutionStrategy(objective.start, self.sigma, options)
        try:
            objective.values([objective.start])
            while True:
                points = strategy.ask()
                strategy.tell(points, objective.values(points).tolist())
        except BudgetSpent:
            return


@dataclass(frozen=True)
class RandomSearch:
    """Normal changes of the best controls so far, of many widths; the best one is kept."""

    widths: tuple[float, float] = (0.01, 0.5)
    population: int = 16
    """Changes that are tried before the next best is chosen, in one launch."""

    def search(self, objective: Objective, seed: int) -> None:
        random = np.random.default_rng(seed)
        try:
            objective.values([objective.start])
            while True:
                widths = np.geomspace(*self.widths, self.population)
                changes = random.standard_normal((self.population, objective.start.size))
                objective.values(list(np.clip(objective.best + widths[:, None] * changes, -1.0, 1.0)))
        except BudgetSpent:
            return


LINE_SEARCH = Descent(gradients.AdjointViscosity(), optimisers.LineSearch())
CONTENDERS: dict[str, Contender] = {
    "exact": Descent(gradients.Exact()),
    "adjoint_viscosity": Descent(gradients.AdjointViscosity()),
    "long_updates": Descent(gradients.AdjointViscosity(), optimisers.Adam(0.25)),
    "line_search": LINE_SEARCH,
    "line_search_exact": Descent(gradients.Exact(), optimisers.LineSearch()),
    "ensemble_mean": Descent(gradients.EnsembleMean(0.05)),
    "guided": Descent(gradients.Guided(0.05)),
    "randomized_smoothing": Descent(gradients.RandomizedSmoothing(0.05, samples=2)),
    "viscosity_continuation": Staged((Easier(viscosity=16.0), Easier(viscosity=4.0)), LINE_SEARCH),
    "growing_horizon": Staged((Easier(late=0.25), Easier(late=0.5)), LINE_SEARCH),
    "multiple_shooting": MultipleShooting(),
    "cma_es": CMAES(),
    "random_search": RandomSearch(),
}
"""By name. `gradients.Tape` has the gradient of `Exact`, and is left out."""


def contender(name: str) -> Contender:
    """One of `CONTENDERS`; raises `InputError` where there is none of that name."""
    if name not in CONTENDERS:
        raise InputError(f"The contender is {name}, but must be one of {', '.join(CONTENDERS)}.")
    return CONTENDERS[name]
