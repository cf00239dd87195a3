"""Where a descent stands, and its steps, which are shortened where there can be no run."""

from cortado.optimisation.replay_log import Vector
from cortado.optimisation.search import Outcome, Search

HALVINGS = 10
"""How often one step is halved before the search ends."""


class Iterate:
    """A point that has been evaluated, and moves."""

    def __init__(self, search: Search):
        self._search, self.x = search, search.start
        self.loss, self.gradient = search.evaluate(search.start)

    def move(self, target: Vector) -> float:
        """Go to a vector (size,), or, where it has no run, half of the way there, or a quarter, and so on, which is one
        update. Returns which part of the way it was; raises the error of the last part where that has no run either."""
        self._search.updated()
        part, tried = 1.0, target
        found = self._search.attempt(tried)
        while found is None:
            part /= 2.0
            tried = self._search.project(self.x + part * (target - self.x))
            found = self._search.attempt(tried) if part > 0.5**HALVINGS else self._search.evaluate(tried)
        self.x, (self.loss, self.gradient) = tried, found
        return part

    def outcome(self, name: str) -> Outcome:
        """That of an optimiser without a test of convergence."""
        return Outcome(self.x, False, f"{name} made all its {self._search.iterations} updates.")
