"""A problem some of whose parameters, first positions among them, replace those of its scene."""

from collections.abc import Sequence
from typing import Any

from cortado.errors import DivergedError
from cortado.gradients import AdjointEstimator, Estimate, ForwardPass
from cortado.problem import Problem
from cortado.scene.parameter_values import Arrays, Values


class FixedParameters:
    """A problem as a function of the other parameters alone. Ensembles vary the first positions around those that are
    fixed."""

    def __init__(self, problem: Problem, fixed: Arrays):
        """``fixed``: parameters by name, with ``initial_positions`` (n, d) [m]."""
        self._problem, self._fixed = problem, fixed
        self.simulation = _Simulation(problem, fixed["initial_positions"])

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled and copied as what it is made from."""
        return FixedParameters, (self._problem, self._fixed)

    @property
    def fingerprint(self) -> str:
        """A text that identifies the problem; it does not tell the fixed values apart."""
        return f"{self._problem.fingerprint}; fixed {', '.join(self._fixed)}"

    def value(self, parameters: Values) -> Any:
        """The loss, forward only."""
        return self._problem.value(self._all(parameters))

    def forward_pass(self, parameters: Values) -> ForwardPass:
        """A forward run that estimators can go back through."""
        return self._problem.forward_pass(self._all(parameters))

    def room(self, estimator: AdjointEstimator | None = None) -> int:
        """See `Batchable.room`."""
        return self._problem.room(estimator)

    def together(
        self, points: Sequence[Values], estimator: AdjointEstimator | None = None
    ) -> list[Estimate | DivergedError]:
        """See `Batchable.together`."""
        return self._problem.together([self._all(point) for point in points], estimator)

    def _all(self, parameters: Values) -> Values:
        return {**self._fixed, **parameters}


class _Simulation:
    """A simulation with other first positions, as ensembles look at it."""

    batch = None

    def __init__(self, problem: Problem, initial_positions: Any):
        self._problem = problem
        self.scene, self.positions = problem.simulation.scene, initial_positions
        self.precision, self.known = problem.simulation.precision, problem.simulation.known

    def __reduce__(self) -> tuple[Any, ...]:
        return _Simulation, (self._problem, self.positions)
