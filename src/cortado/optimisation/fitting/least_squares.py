"""The least-squares problem of several experiments: residuals and Jacobian as functions of one vector."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cortado.errors import DivergedError
from cortado.optimisation.fitting.coordinates import Coordinates
from cortado.optimisation.fitting.experiment import Experiment
from cortado.optimisation.fitting.noise import whitened
from cortado.optimisation.fitting.observation import Observation

ENOUGH = 1e-6
"""A search ends where the sum of squares changes by less, relative to itself: by far less than an error bar."""
ROUGHLY = 1e-3
"""The same of a search whose end only tells the weights of the next."""
NEAR = 1e-6
"""Or where a step is shorter than this, relative to the size of the coordinates."""


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
        self.runs = self.tangents = 0
        """Forward runs, and runs along a tangent, each of one experiment."""
        self._last: Linearised | None = None

    def residuals(self, u: np.ndarray) -> list[np.ndarray]:
        """Of each part; raises `DivergedError`."""
        found = []
        for k, experiment in enumerate(self.experiments):
            self.runs += 1
            found.append(experiment.predicted(self._values(k, self.coordinates.values(u))))
        if self._on_trial is not None:
            self._on_trial()
        return [self._residual(part, found[part.experiment][part.name]) for part in self.parts]

    def linearised(self, u: np.ndarray) -> Linearised:
        """At a point; the last one is kept."""
        if self._last is not None and np.array_equal(self._last.u, u):
            return self._last
        directions, values = self.coordinates.directions(u), self.coordinates.values(u)
        residuals, jacobians = list[np.ndarray](), list[np.ndarray]()
        for k, experiment in enumerate(self.experiments):
            own = [self._values(k, direction) for direction in directions]
            run = [number for number, one in enumerate(own) if one]
            self.runs += len(run)
            self.tangents += len(run)
            predicted, slopes = experiment.linearised(self._values(k, values), [own[number] for number in run])
            for part in self.parts:
                if part.experiment == k:
                    jacobian = np.zeros((*part.observation.measured.shape, len(directions)))
                    jacobian[..., run] = slopes[part.name]
                    jacobian[np.isnan(part.observation.measured)] = 0.0
                    residuals.append(self._residual(part, predicted[part.name]))
                    jacobians.append(jacobian)
        self._last = Linearised(u.copy(), residuals, jacobians)
        return self._last

    def solve(
        self,
        u: np.ndarray,
        weights: Sequence[Weighting],
        iterations: int,
        fixed: Sequence[int] = (),
        enough: float = ENOUGH,
    ) -> tuple[np.ndarray, Any]:
        """Lower the sum of the squared residuals by the trust-region method of Branch, Coleman and Li (1999), from a
        point, with the coordinates of some numbers ``fixed``: where it ended, and what SciPy says of it. A step to
        where the run diverges is made shorter."""
        from scipy.optimize import least_squares

        free = np.setdiff1d(np.arange(len(u)), fixed)

        def whole(x: np.ndarray) -> np.ndarray:
            point = u.copy()
            point[free] = x
            return point

        def together(arrays: Sequence[np.ndarray], width: tuple[int, ...]) -> np.ndarray:
            times = (part.observation.times for part in self.parts)
            each = (w.of(a, t).reshape(-1, *width) for w, a, t in zip(weights, arrays, times, strict=True))
            return np.concatenate(list(each))

        def residuals(x: np.ndarray) -> np.ndarray:
            try:
                return together(self.residuals(whole(x)), ())
            except DivergedError:
                return np.full(sum(part.observation.measured.size for part in self.parts), np.inf)

        def jacobian(x: np.ndarray) -> np.ndarray:
            return together(self.linearised(whole(x)).jacobians, (len(u),))[:, free]

        if not len(free):
            return u, None
        lower, upper = (ends[free] for ends in self.coordinates.bounds)
        settings: dict[str, Any] = {"ftol": enough, "xtol": NEAR, "gtol": None, "x_scale": "jac"}
        settings |= {"bounds": (lower, upper), "max_nfev": iterations}
        found = least_squares(residuals, u[free], jacobian, **settings)
        return whole(found.x), found

    def sum_of_squares(self, residuals: Sequence[np.ndarray], weights: Sequence[Weighting]) -> float:
        """Of weighted residuals."""
        each = zip(self.parts, residuals, weights, strict=True)
        return float(sum((weight.of(r, part.observation.times) ** 2).sum() for part, r, weight in each))

    def _values(self, experiment: int, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Those that an experiment has: all but those of observations of others."""
        others = {name for one in self.experiments for name in one.start} - set(self.experiments[experiment].start)
        return {name: value for name, value in values.items() if name not in others}

    def _residual(self, part: Part, predicted: np.ndarray) -> np.ndarray:
        return np.nan_to_num(predicted - part.observation.measured, nan=0.0)
