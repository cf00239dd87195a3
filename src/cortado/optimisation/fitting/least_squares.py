"""The least-squares problem of several experiments, as a function of one vector, and its Jacobians.

The vector contains the values of the fitted parameters, or the logarithms of positive values. The Jacobian is computed
only at the first point of a search. At trial points the Jacobian is the slope of a Kriging interpolation of the
residuals (Sacks, Welch, Mitchell and Wynn 1989). The interpolation is a linear function plus a random function with
Matérn covariance of smoothness 7/2. The width of the covariance is chosen by maximum likelihood.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cortado.errors import DivergedError, InputError
from cortado.optimisation.fitting.experiment import Experiment
from cortado.optimisation.fitting.observations import Observation
from cortado.optimisation.optimise import Bounds, checked_bounds, checked_start
from cortado.scene.parameter_values import Arrays

MOST_NUMBERS = 100
DIFFERENCE = 0.02
WIDTHS = (0.1, 1.0, 3.0)
TINY = 1e-300


@dataclass(frozen=True)
class Coordinates:
    """The conversion between parameters and the coordinates of a search.

    Arrays of shape (all,) contain the components of all parameters. Arrays of shape (free,) contain the fitted
    components, whose lower and upper bounds differ.
    """

    names: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]
    at_start: np.ndarray
    """Initial values (all,), in the units of the parameters."""
    logarithmic: np.ndarray
    """Mask (all,) of the components that are fitted by their logarithm."""
    lower: np.ndarray
    upper: np.ndarray

    @classmethod
    def of(
        cls, start: Mapping[str, Any], positive: Iterable[str], bounds: Bounds | None, unseen: Arrays | None = None
    ) -> "Coordinates":
        """Make coordinates. ``positive`` parameters are fitted by their logarithm if all components are above 0.
        ``unseen`` has masks of components that are not fitted."""
        values = checked_start(start)
        by_logarithm = {name for name in positive if name in values and (values[name] > 0.0).all()}
        ends = checked_bounds({} if bounds is None else bounds, values)
        for name, mask in ({} if unseen is None else unseen).items():
            for each in ends:
                each[name] = np.where(mask, values[name], each[name])

        def flat(rows: Iterable[np.ndarray]) -> np.ndarray:
            return np.concatenate([np.ravel(row) for row in rows])

        lower, upper = (flat(each.values()) for each in ends)
        logarithmic = flat(np.full(np.shape(v), name in by_logarithm) for name, v in values.items())
        lower = np.where(logarithmic, np.maximum(lower, 0.0), lower)
        shapes = tuple(value.shape for value in values.values())
        found = cls(tuple(values), shapes, flat(values.values()), logarithmic, lower, upper)
        if not 0 < found.free.sum() <= MOST_NUMBERS:
            raise InputError(f"start has {found.free.sum()} free numbers, but must have 1 to {MOST_NUMBERS}.")
        return found

    @property
    def free(self) -> np.ndarray:
        """Return a mask (all,) of the fitted components."""
        return self.lower < self.upper

    @property
    def by_logarithm(self) -> np.ndarray:
        """Return a mask (free,) of the components that are fitted by their logarithm."""
        return self.logarithmic[self.free]

    @property
    def labels(self) -> list[str]:
        """Return the names of the fitted components, such as "gravity[1]"."""
        found = list[str]()
        for name, shape in zip(self.names, self.shapes, strict=True):
            found += [f"{name}[{', '.join(map(str, k))}]" if shape else name for k in np.ndindex(*shape)]
        return [label for label, is_free in zip(found, self.free, strict=True) if is_free]

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        with np.errstate(divide="ignore"):
            logs = [np.where(self.logarithmic, np.log(np.maximum(e, 0.0)), e) for e in (self.lower, self.upper)]
        return logs[0][self.free], logs[1][self.free]

    @property
    def start(self) -> np.ndarray:
        return self.vector(self.at_start)

    def vector(self, numbers: np.ndarray) -> np.ndarray:
        chosen, is_log = numbers[self.free], self.by_logarithm
        return np.where(is_log, np.log(np.where(is_log, chosen, 1.0)), chosen)

    def numbers(self, u: np.ndarray) -> np.ndarray:
        """Return the fitted components (free,) in the units of the parameters."""
        with np.errstate(over="ignore"):  # an interval may have no upper end
            return np.where(self.by_logarithm, np.exp(np.where(self.by_logarithm, u, 0.0)), u)

    def slopes(self, u: np.ndarray) -> np.ndarray:
        """Return the derivative (free,) of each fitted component with respect to its coordinate."""
        return np.where(self.by_logarithm, self.numbers(u), 1.0)

    def values(self, u: np.ndarray) -> Arrays:
        return self.spread(self.numbers(u), self.at_start)

    def named(self, whole: np.ndarray) -> Arrays:
        ends = np.cumsum([0, *(int(np.prod(shape)) for shape in self.shapes)])
        return {n: whole[ends[k] : ends[k + 1]].reshape(self.shapes[k]) for k, n in enumerate(self.names)}

    def directions(self, u: np.ndarray) -> list[Arrays]:
        """Return the derivatives of the parameters with respect to each coordinate. Zero derivatives are left out."""
        found, slopes = [], self.slopes(u)
        for k, place in enumerate(np.flatnonzero(self.free)):
            whole = np.zeros(len(self.at_start))
            whole[place] = slopes[k]
            found.append({name: value for name, value in self.named(whole).items() if value.any()})
        return found

    def spread(self, free: np.ndarray, otherwise: float | np.ndarray) -> Arrays:
        """Convert fitted components (free,) to arrays by name. Fixed components are set to ``otherwise``."""
        whole = np.full(len(self.at_start), otherwise)
        whole[self.free] = free
        return self.named(whole)


def whitened(values: np.ndarray, times: np.ndarray, correlation_time: float) -> np.ndarray:
    """Make frames of ``values`` (frames, ...) uncorrelated, without a change of their standard deviation."""
    if not correlation_time:
        return values
    kept = np.exp(-np.diff(times) / correlation_time).reshape(-1, *[1] * (values.ndim - 1))
    return np.concatenate([values[:1], (values[1:] - kept * values[:-1]) / np.sqrt(1.0 - kept**2)])


@dataclass(frozen=True)
class Part:
    experiment: int
    name: str
    label: str
    observation: Observation


@dataclass(frozen=True)
class Weighting:
    """The weighting of residuals: a scale in the unit of the observation, and a correlation time [s]."""

    scale: float
    correlation_time: float = 0.0

    def of(self, values: np.ndarray, times: np.ndarray) -> np.ndarray:
        return whitened(values, times, self.correlation_time) / self.scale


Weights = Sequence[Weighting]


@dataclass(frozen=True)
class Linearised:
    """Residuals and Jacobians at coordinates u (free,), in the units of the measurements."""

    u: np.ndarray
    residuals: list[np.ndarray]
    """Predicted minus measured values (frames, m) of each observation. The residual of an ignored measurement is 0."""
    jacobians: list[np.ndarray]
    """Jacobian of each observation (frames, m, free)."""


def weighted(parts: Sequence[Part], weights: Weights, values: Sequence[np.ndarray]) -> list[np.ndarray]:
    each = zip(parts, weights, values, strict=True)
    return [weight.of(own, part.observation.times) for part, weight, own in each]


class LeastSquares:
    def __init__(
        self, experiments: Sequence[Experiment], coordinates: Coordinates, on_trial: Callable[[], None] | None = None
    ):
        self.experiments, self.coordinates = tuple(experiments), coordinates
        self._on_trial = on_trial
        several = len(self.experiments) > 1
        self.labels = coordinates.labels
        self.parts = [
            Part(k, name, f"{name} of experiment {k + 1}" if several else name, one)
            for k, experiment in enumerate(self.experiments)
            for name, one in experiment.observations.items()
        ]
        self.runs = self.tangents = self.refused = 0

    def residuals(self, u: np.ndarray) -> list[np.ndarray]:
        found = [self._run(k, self.coordinates.values(u), ())[0] for k in range(len(self.experiments))]
        if self._on_trial is not None:
            self._on_trial()
        each = [(found[part.experiment][part.name], part.observation.measured) for part in self.parts]
        return [np.nan_to_num(predicted - measured, nan=0.0) for predicted, measured in each]

    def estimated(self, u: np.ndarray) -> Linearised:
        """Return residuals and Jacobians. Slopes along logarithms are cheap differences of forward runs."""
        positive = self.coordinates.by_logarithm
        at = self.linearised(u, np.flatnonzero(~positive))
        _, upper = self.coordinates.bounds
        for k in np.flatnonzero(positive):
            change = DIFFERENCE if u[k] + DIFFERENCE <= upper[k] else -DIFFERENCE
            try:
                moved = self.residuals(u + change * np.eye(len(u))[k])
            except DivergedError:
                return self.linearised(u)
            for J, before, after in zip(at.jacobians, at.residuals, moved, strict=True):
                J[..., k] = (after - before) / change
        return at

    def linearised(self, u: np.ndarray, columns: Iterable[int] | None = None) -> Linearised:
        """Return residuals and Jacobians. Derivatives for coordinates outside ``columns`` are 0."""
        every, values = self.coordinates.directions(u), self.coordinates.values(u)
        directions = {number: every[number] for number in (range(len(u)) if columns is None else columns)}
        residuals, jacobians = list[np.ndarray](), list[np.ndarray]()
        for k in range(len(self.experiments)):
            own = {number: self.values_of(k, direction) for number, direction in directions.items()}
            run = [number for number, one in own.items() if one]
            predicted, slopes = self._run(k, values, [own[number] for number in run])
            for part in self.parts:
                if part.experiment == k:
                    measured = part.observation.measured
                    jacobian = np.zeros((*measured.shape, len(u)))
                    jacobian[..., run] = slopes.get(part.name, 0.0)
                    jacobian[np.isnan(measured)] = 0.0
                    residuals.append(np.nan_to_num(predicted[part.name] - measured, nan=0.0))
                    jacobians.append(jacobian)
        return Linearised(u.copy(), residuals, jacobians)

    def stacked(self, at: Linearised, weights: Weights) -> tuple[np.ndarray, np.ndarray]:
        """Return the weighted Jacobian (numbers, free) and residuals (numbers,) of all observations."""
        J = [own.reshape(-1, len(at.u)) for own in weighted(self.parts, weights, at.jacobians)]
        return np.concatenate(J), np.concatenate([r.ravel() for r in weighted(self.parts, weights, at.residuals)])

    def sum_of_squares(self, residuals: Sequence[np.ndarray], weights: Weights) -> float:
        return float(sum((r**2).sum() for r in weighted(self.parts, weights, residuals)))

    def _run(self, number: int, values: Arrays, along: Sequence[Arrays]) -> tuple[Arrays, Arrays]:
        experiment, at = self.experiments[number], self.values_of(number, values)
        self.runs, self.tangents = self.runs + 1, self.tangents + len(along)
        try:
            return experiment.linearised(at, along) if along else (experiment.predicted(at), {})
        except DivergedError:
            self.refused += 1
            raise

    def values_of(self, experiment: int, values: Arrays) -> Arrays:
        """Select the values of one experiment. Other experiments may have parameters of their own."""
        others = {name for one in self.experiments for name in one.start} - set(self.experiments[experiment].start)
        return {name: value for name, value in values.items() if name not in others}


class TrialPoints:
    def __init__(self, problem: LeastSquares, weights: Weights, at: Linearised):
        J, r = problem.stacked(at, weights)
        self._metric = np.asarray(np.linalg.qr(J, mode="r"))
        self._scales = [weight.scale for weight in weights]
        self._points, self._residuals = [at.u], [at.residuals]
        changes = 1e-3 * np.linalg.norm(r) / np.maximum(np.linalg.norm(J, axis=0), TINY)
        for k, change in enumerate(changes):  # points close to the first one represent its Jacobian
            moved = [r + change * J[..., k] for r, J in zip(at.residuals, at.jacobians, strict=True)]
            self.add(at.u + change * np.eye(len(at.u))[k], moved)

    def add(self, u: np.ndarray, residuals: list[np.ndarray]) -> int:
        self._points.append(u)
        self._residuals.append(residuals)
        self.are_many = len(self._points) >= 5 * (len(u) + 1)
        """True if the points need too much memory, so that the search should start again."""
        return len(self._points) - 1

    def linearised(self, number: int) -> Linearised:
        x = np.array(self._points) @ self._metric.T  # the first Jacobian is orthonormal in these coordinates
        parts = [np.array(part) for part in zip(*self._residuals, strict=True)]
        flat = [part.reshape(len(x), -1) / scale for part, scale in zip(parts, self._scales, strict=True)]
        weights = self._metric.T @ slope_weights(x, np.sum([part @ part.T for part in flat], axis=0), number)
        jacobians = [np.tensordot(part, weights, (0, 1)) for part in parts]
        return Linearised(self._points[number], self._residuals[number], jacobians)


def slope_weights(x: np.ndarray, products: np.ndarray, number: int) -> np.ndarray:
    """Return weights (d, points) of values at the points ``x`` (points, d) for the gradient at point ``number``."""
    from scipy.linalg import null_space
    from scipy.spatial.distance import cdist

    def covariance(apart: np.ndarray) -> np.ndarray:  # Matérn, for distances in units of the width
        smooth = (1.0 + apart + 0.4 * apart**2 + apart**3 / 15.0) * np.exp(-apart)
        return smooth + 1e-12 * np.eye(len(apart))

    points, d = x.shape
    size = max(float(cdist(x, x).max()), TINY)
    x = (x - x[number]) / size
    linear, apart = np.column_stack([np.ones(points), x]), cdist(x, x)
    contrasts = null_space(linear.T)
    count, found = contrasts.shape[1], contrasts.T @ products @ contrasts

    def deviance(width: float) -> float:
        K = contrasts.T @ covariance(apart / width) @ contrasts
        variance = float(np.trace(np.linalg.solve(K, found)))
        return count * np.log(max(variance, TINY)) + float(np.linalg.slogdet(K)[1])

    width = min(WIDTHS, key=deviance) if count > 1 else 1.0
    system = np.block([[covariance(apart / width), linear], [linear.T, np.zeros((d + 1, d + 1))]])
    near = apart[:, [number]] / width
    of_noise = (3.0 + 3.0 * near + near**2) * np.exp(-near) / 15.0 * x / width**2
    slopes = np.vstack([of_noise, np.zeros(d), np.eye(d)])
    return np.asarray(np.linalg.lstsq(system, slopes)[0][:points].T / size)
