"""The least-squares problem of several experiments: residuals and Jacobian as functions of one vector."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from cortado.errors import DivergedError
from cortado.optimisation.fitting.coordinates import Coordinates
from cortado.optimisation.fitting.experiment import Experiment
from cortado.optimisation.fitting.noise import whitened
from cortado.optimisation.fitting.observation import Observation

DIFFERENCE = 0.02
"""Of the logarithm of a number, for an estimate of a derivative."""


@dataclass(frozen=True)
class Part:
    """An observation of one of the experiments."""

    experiment: int
    name: str
    label: str
    """That tells it from the parts of other experiments."""
    observation: Observation


@dataclass(frozen=True)
class Weighting:
    """By what the residuals of a part are divided, and how they are whitened in time."""

    scale: float
    """[unit of the observation]"""
    correlation_time: float = 0.0
    """[s]"""

    def of(self, values: np.ndarray, times: np.ndarray) -> np.ndarray:
        """(frames, ...)"""
        return whitened(values, times, self.correlation_time) / self.scale


@dataclass(frozen=True)
class Linearised:
    """Residuals and Jacobians of all parts at a point, in the units of what was measured."""

    u: np.ndarray
    residuals: list[np.ndarray]
    """Of each part, predicted less measured, (frames, m), 0 for what does not count."""
    jacobians: list[np.ndarray]
    """Of each part, (frames, m, free)."""


class LeastSquares:
    """Counts what it costs."""

    def __init__(
        self,
        experiments: Sequence[Experiment],
        coordinates: Coordinates,
        on_trial: Callable[[], None] | None = None,
    ):
        self.experiments, self.coordinates = tuple(experiments), coordinates
        self._on_trial = on_trial
        several = len(self.experiments) > 1
        self.parts = [
            Part(k, name, f"{name} of experiment {k + 1}" if several else name, one)
            for k, experiment in enumerate(self.experiments)
            for name, one in experiment.observations.items()
        ]
        self.runs = self.tangents = self.refused = 0
        """Forward runs, and passes along a tangent, each of one experiment, and points whose runs diverged."""

    @property
    def labels(self) -> list[str]:
        """(free,) of the numbers that are searched."""
        return self.coordinates.labels

    def residuals(self, u: np.ndarray) -> list[np.ndarray]:
        """Of each part; raises `DivergedError`."""
        found = []
        for k, experiment in enumerate(self.experiments):
            self.runs += 1
            with self._counting():
                found.append(experiment.predicted(self.values_of(k, self.coordinates.values(u))))
        if self._on_trial is not None:
            self._on_trial()
        return [self._residual(part, found[part.experiment][part.name]) for part in self.parts]

    def linearised(self, u: np.ndarray) -> Linearised:
        """At a point, by tangents."""
        return self._along(u, range(len(u)))

    def estimated(self, u: np.ndarray) -> Linearised:
        """At a point, with derivatives of positive numbers by differences: a forward run costs less than one along a
        tangent, and this is enough to search. Raises `DivergedError`."""
        positive = self.coordinates.logarithmic[self.coordinates.free]
        at = self._along(u, np.flatnonzero(~positive))
        _, upper = self.coordinates.bounds
        for k in np.flatnonzero(positive):
            change = DIFFERENCE if u[k] + DIFFERENCE <= upper[k] else -DIFFERENCE
            try:
                moved = self.residuals(u + change * np.eye(len(u))[k])
            except DivergedError:  # hard by a point that does not
                return self.linearised(u)
            for J, before, after in zip(at.jacobians, at.residuals, moved, strict=True):
                J[..., k] = (after - before) / change
        return at

    def _along(self, u: np.ndarray, columns: Iterable[int]) -> Linearised:
        """Residuals, and derivatives along some of the coordinates."""
        every, values = self.coordinates.directions(u), self.coordinates.values(u)
        directions = {number: every[number] for number in columns}
        residuals, jacobians = list[np.ndarray](), list[np.ndarray]()
        for k, experiment in enumerate(self.experiments):
            own = {number: self.values_of(k, direction) for number, direction in directions.items()}
            run = [number for number, one in own.items() if one]
            self.runs += 1
            self.tangents += len(run)
            at = self.values_of(k, values)
            along = [own[number] for number in run]
            with self._counting():
                predicted, slopes = experiment.linearised(at, along) if run else (experiment.predicted(at), {})
            for part in self.parts:
                if part.experiment == k:
                    jacobian = np.zeros((*part.observation.measured.shape, len(u)))
                    jacobian[..., run] = slopes.get(part.name, 0.0)
                    jacobian[np.isnan(part.observation.measured)] = 0.0
                    residuals.append(self._residual(part, predicted[part.name]))
                    jacobians.append(jacobian)
        return Linearised(u.copy(), residuals, jacobians)

    def stacked(self, at: Linearised, weights: Sequence[Weighting]) -> tuple[np.ndarray, np.ndarray]:
        """The Jacobian (numbers, free) and the residuals (numbers,) of all parts, weighted."""
        times = [part.observation.times for part in self.parts]
        J = [w.of(J, t).reshape(-1, len(at.u)) for w, J, t in zip(weights, at.jacobians, times, strict=True)]
        r = [w.of(r, t).ravel() for w, r, t in zip(weights, at.residuals, times, strict=True)]
        return np.concatenate(J), np.concatenate(r)

    def sum_of_squares(self, residuals: Sequence[np.ndarray], weights: Sequence[Weighting]) -> float:
        """Of weighted residuals."""
        each = zip(self.parts, residuals, weights, strict=True)
        return float(sum((weight.of(r, part.observation.times) ** 2).sum() for part, r, weight in each))

    @contextmanager
    def _counting(self) -> Iterator[None]:
        """Count a run that diverges."""
        try:
            yield
        except DivergedError:
            self.refused += 1
            raise

    def values_of(self, experiment: int, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Those that an experiment has: all but those of observations of others."""
        others = {name for one in self.experiments for name in one.start} - set(self.experiments[experiment].start)
        return {name: value for name, value in values.items() if name not in others}

    def _residual(self, part: Part, predicted: np.ndarray) -> np.ndarray:
        return np.nan_to_num(predicted - part.observation.measured, nan=0.0)
