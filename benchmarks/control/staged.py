"""Easier problems first: a thicker fluid, or the last controls alone."""

from dataclasses import dataclass

import numpy as np

from .descent import Descent
from .objective import BudgetSpent, Objective


@dataclass(frozen=True)
class Easier:
    """A problem that is searched for a share of the budget, so that the next search begins where it ends."""

    viscosity: float = 1.0
    """That of the fluids, over that of the task."""
    late: float = 1.0
    """The share of the controls that are changed, the last ones."""
    share: float = 0.15
    """Of the budget."""

    def of(self, objective: Objective, start: np.ndarray) -> Objective:
        """With a curve of its own, as its losses are not those of the task."""
        viscosities = [phase.viscosity for phase in objective.task.scene.phase]
        thicker = self.viscosity * np.array(viscosities if len(viscosities) > 1 else viscosities[0])
        return objective.easier(start, self.share, {} if self.viscosity == 1.0 else {"viscosity": thicker}, self.late)


@dataclass(frozen=True)
class Staged:
    """A descent in easier problems, one after the other, and then in that of the task."""

    stages: tuple[Easier, ...]
    descent: Descent

    def search(self, objective: Objective, seed: int) -> None:
        start = objective.start
        try:
            objective.values([start])
            for stage in self.stages:
                easier = stage.of(objective, start)
                self.descent.search(easier, seed)
                start = easier.best
                objective.values([start])
        except BudgetSpent:
            return
        objective.start = start
        self.descent.search(objective, seed)
