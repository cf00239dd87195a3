"""The function `cortado.fit`, which fits parameters to measured experiments, with error bars and doubts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np

from cortado.arrays import as_numbers, as_one_number, require_function, require_table, whole_number
from cortado.calls import counted, public
from cortado.errors import ComputationError, DivergedError, InputError, shown
from cortado.lazy import on_top
from cortado.optimisation.fitting.certainty import Certainty, FittedPart, hessian, inverse, noise_of, spread
from cortado.optimisation.fitting.doubts import dear_causes, doubts_of
from cortado.optimisation.fitting.experiment import Experiment
from cortado.optimisation.fitting.gauss_newton import TINY, least, misfit, other_starts, over_the_bars, search
from cortado.optimisation.fitting.least_squares import Coordinates, LeastSquares, Linearised, Weighting
from cortado.scene.parameter_values import UNITS
from cortado.scene.parameters import Range

NOISE_ALONE = (
    "The error bars include noise only, and no errors of the spacing and the time step: a fit with another "
    "discretisation.spacing shows the size of these errors."
)
OF_VIEWS = {"translation": "m", "rotation": "rad", "field_of_view": "degrees", "width": "m", "extinction": "1/m"}
OF_VIEWS["start"] = "s"
FAR, SAME = 3.0, 1e-3
"""Least distance [standard errors] and least relative difference between two distinct local minima."""


@dataclass(frozen=True)
class Profile:
    """The least sum of squares as a function of one fitted number. All remaining numbers are fitted at each value."""

    label: str
    values: np.ndarray
    """Values of the fitted number (points,), in its unit."""
    deviance: np.ndarray
    """Sum of squares minus its minimum (points,), in squared standard errors."""
    expected: np.ndarray
    """Deviance of the linear model (points,), from which confidence intervals are computed."""


@dataclass(frozen=True)
class FittedNumber:
    """A fitted number with its standard error and its confidence interval from ``lower`` to ``upper``."""

    label: str
    start: float
    value: float
    error: float
    lower: float
    upper: float

    @property
    def words(self) -> str:
        """Return the number with its error and unit, such as "viscosity 2.63 ± 0.05 Pa s"."""
        return f"{self.label.replace('_', ' ')} {with_error(self.value, self.error)} {unit_of(self.label)}".rstrip()


@dataclass(frozen=True)
class Tried:
    """The start and the end of a search, as coordinates (free,)."""

    start: np.ndarray
    end: np.ndarray
    misfit: float
    """Mean logarithm of the residuals' size at the end of the search."""


@public
@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted parameters of experiments, with error bars.

    Example::

        fit = cortado.fit(experiment, {"viscosity": 0.1})
        print(fit.intervals(0.95)["viscosity"])
    """

    coordinates: Coordinates = field(repr=False)
    u: np.ndarray = field(repr=False)
    """Fitted coordinates (free,). A coordinate is a fitted number, or its logarithm for a positive parameter."""
    coordinate_covariance: np.ndarray = field(repr=False)
    """Covariance of the coordinates (free, free)."""
    naive_covariance: np.ndarray = field(repr=False)
    """Covariance (free, free) if all measured numbers were independent. The values serve only for comparison."""
    degrees_of_freedom: np.ndarray = field(repr=False)
    """Degrees of freedom of Student's t-distribution (free,)."""
    parts: tuple[FittedPart, ...] = field(repr=False)
    """Residuals of each observation and their statistics."""
    doubts: tuple[str, ...] = field(repr=False)
    """Sentences on residuals that do not look like noise, and so show model errors above the error bars."""
    converged: bool = True
    """True if the search ended at a minimum of the sum of squares, and False if the search used up its iterations."""
    tried: tuple[Tried, ...] = field(default=(), repr=False)
    """Starts and ends of all searches, including the search of this fit."""
    runs: int = 0
    """Number of forward runs."""
    tangents: int = 0
    """Number of forward-mode runs, each along one direction."""
    refused: int = 0
    """Number of trial points that were rejected because their runs diverged."""
    sum_of_squares: float = field(default=0.0, repr=False)
    hessian: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    problem: LeastSquares | None = field(default=None, repr=False)
    at: Linearised | None = field(default=None, repr=False)
    """Point at the end of the search, with the Jacobian for the error bars. The value is None in pickled fits."""

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "problem": None, "at": None}

    @property
    def values(self) -> dict[str, Any]:
        """Return the fitted parameters by name, as arrays or numbers."""
        return _plain(self.coordinates.values(self.u))

    @property
    def labels(self) -> list[str]:
        """Return the labels of the fitted numbers, in the order of the covariance."""
        return self.coordinates.labels

    @cached_property
    def covariance(self) -> np.ndarray:
        """Return the covariance of the fitted numbers (free, free), in their units, valid for small errors."""
        slopes = self.coordinates.slopes(self.u)
        return self.coordinate_covariance * np.outer(slopes, slopes)

    @property
    def standard_errors(self) -> dict[str, Any]:
        """Return standard errors in the shapes of the parameters. The error of a fixed number is 0."""
        return _plain(self.coordinates.spread(np.sqrt(np.diag(self.covariance)), 0.0))

    @property
    def correlation(self) -> np.ndarray:
        """Return the correlation matrix (free, free) of the fitted coordinates."""
        size = np.sqrt(np.diag(self.coordinate_covariance))
        return self.coordinate_covariance / np.maximum(np.outer(size, size), 1e-300)

    @property
    def not_told_apart(self) -> tuple[tuple[str, str, float], ...]:
        """Return pairs of labels whose correlation is above 0.9 in absolute value, with the correlation."""
        found, labels = self.correlation, self.labels
        pairs = combinations(range(len(labels)), 2)
        return tuple((labels[i], labels[j], float(found[i, j])) for i, j in pairs if abs(found[i, j]) > 0.9)

    def intervals(self, confidence: float = 0.95) -> dict[str, tuple[Any, Any]]:
        """Return the lower and upper ends of confidence intervals by parameter name. If the model is right, an interval
        contains the true value with the probability ``confidence``. Intervals of positive numbers are computed for
        their logarithms. Raises `InputError` for an unsuitable confidence."""
        if not 0.0 < as_one_number("confidence", confidence) < 1.0:
            raise InputError(f"confidence is {shown(confidence)}, but must be between 0 and 1.")
        from scipy.stats import t as student

        reach = student.ppf(0.5 + 0.5 * confidence, self.degrees_of_freedom)
        reach = reach * np.sqrt(np.diag(self.coordinate_covariance))
        lower, upper = (_plain(self.coordinates.values(self.u + way * reach)) for way in (-1.0, 1.0))
        return {name: (lower[name], upper[name]) for name in lower}

    def profile(self, label: str, points: int = 7, reach: float = 2.5) -> Profile:
        """Compute the least sum of squares at ``points`` values of the fitted number with this ``label``. All remaining
        numbers are fitted at each value. The values range from -``reach`` to +``reach`` standard errors around the
        estimate. The confidence intervals are rough if the profile is not a parabola. Raises `InputError` for an
        unknown label, or if the fit was loaded from a pickle."""
        if label not in self.labels or self.problem is None or self.at is None:
            raise InputError(f"label is {shown(label)}, but must be one of {', '.join(self.labels)}.")
        k, weights = self.labels.index(label), [part.weighting for part in self.parts]
        V, counted = self.coordinate_covariance, np.linalg.inv(self.hessian)[k, k]
        deviance, shifts = [], np.linspace(-reach, reach, points) * np.sqrt(V[k, k])
        lower, upper = self.coordinates.bounds
        for shift in shifts:
            begun = np.clip(self.u + V[:, k] / V[k, k] * shift, lower, upper)
            begun[k] = self.u[k] + shift
            at = Linearised(begun, self.problem.residuals(begun), self.at.jacobians)
            ended = search(self.problem, at, weights, 2, 0.01 / max(self.sum_of_squares, TINY), fixed=[k])
            squares = self.problem.sum_of_squares(ended.at.residuals, weights) - ended.gain
            deviance.append((squares - self.sum_of_squares) * counted / V[k, k])
        values = np.array([self.coordinates.numbers(self.u + shift * np.eye(len(self.u))[k])[k] for shift in shifts])
        return Profile(label, values, np.array(deviance), shifts**2 / V[k, k])

    def log_posterior(self, u: Any) -> float:
        """Return the logarithm of the posterior density, up to a constant, at coordinates ``u`` (free,), by one run.

        The prior is flat in the coordinates within the bounds. Coordinates of positive numbers are logarithms. The
        result is -inf outside the bounds, and if the run diverges. `Fit.coordinates.values` converts coordinates to
        parameters. Raises `InputError` for a wrong shape, or if the fit was loaded from a pickle.

        The result is minus half of the weighted sum of squares, relative to the minimum. If noise is correlated, the
        sum of squares alone gives too short error bars. Distances from the estimate are therefore multiplied by a
        matrix W with W^T N W = V^-1, where V is the covariance of the estimate, and N the Hessian of the sum of
        squares. The method is the curvature adjustment of Ribatet, Cooley and Davison (2012).
        """
        point = as_numbers("u", u)
        if point.shape != self.u.shape:
            raise InputError(f"u has shape {point.shape}, but must be {self.u.shape}, one for each fitted number.")
        if self.problem is None:
            said = "The fit was pickled without its experiments"
            raise InputError(f"{said}, but log_posterior needs the experiments.")
        lower, upper = self.coordinates.bounds
        wanted = np.linalg.cholesky(np.linalg.inv(self.coordinate_covariance))
        shortened = self.u + np.linalg.solve(np.linalg.cholesky(self.hessian).T, wanted.T @ (point - self.u))
        if not (np.isfinite(point) & (lower <= point) & (point <= upper)).all():
            return -np.inf
        try:
            residuals = self.problem.residuals(np.clip(shortened, lower, upper))
        except DivergedError:
            return -np.inf
        squares = self.problem.sum_of_squares(residuals, [part.weighting for part in self.parts])
        return -0.5 * (squares - self.sum_of_squares)

    def numbers(self, confidence: float = 0.95) -> list["FittedNumber"]:
        """Return the fitted numbers with their confidence intervals."""
        ends, free = self.intervals(confidence), self.coordinates.free
        lower, upper = (np.concatenate([np.ravel(pair[k]) for pair in ends.values()])[free] for k in range(2))
        values, errors = self.coordinates.numbers(self.u), np.sqrt(np.diag(self.covariance))
        each = zip(self.labels, self.coordinates.at_start[free], values, errors, lower, upper, strict=True)
        return [FittedNumber(label, *map(float, rest)) for label, *rest in each]

    def lines(self, confidence: float = 0.95) -> list[str]:
        """Return a line of text for each fitted number, with its value, standard error and confidence interval."""
        each, percent = self.numbers(confidence), f"{100 * confidence:g} %"
        return [f"{one.words} ({percent} between {one.lower:.4g} and {one.upper:.4g})" for one in each]

    @property
    def in_doubt(self) -> bool:
        """Return True if the fit has not converged or there are doubts."""
        return not self.converged or bool(self.doubts)

    def __repr__(self) -> str:
        ended = ("; in doubt" if self.doubts else "") if self.converged else "; not converged"
        return f"Fit({', '.join(one.words for one in self.numbers())}{ended})"

    def _repr_html_(self) -> str:
        page: str = on_top("fit_page")(self)
        return page

    def __str__(self) -> str:
        return "\n".join([*self.lines(), *self.cautions, NOISE_ALONE])

    @property
    def cautions(self) -> list[str]:
        """Return warnings about correlated numbers, missing convergence, rejected points, and doubts."""
        apart = [f"{a} and {b} are hardly distinguished (correlation {c:.3f})." for a, b, c in self.not_told_apart]
        ended = [] if self.converged else ["The fit has not converged: give more iterations."]
        lost = f"The runs at {counted(self.refused, 'point')} of the search diverged, and the fit ignores these points"
        refused = [f"{lost}: try a smaller solver.time_step, or bounds."] if self.refused else []
        return [*apart, *ended, *refused, *self.doubts]


def _plain(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    return {name: array if array.shape else float(array) for name, array in arrays.items()}


def with_error(value: float, error: float) -> str:
    """Format a value and its standard error. Errors that begin with 1 to 3 have two digits, and other errors one."""
    if not np.isfinite(error) or error <= 0.0:
        return f"{value:.6g} ± {error:.2g}"
    power = int(np.floor(np.log10(error)))
    digits = -power + (1 if error / 10.0**power < 3.55 else 0)
    if digits >= 0 and abs(value) < 1e6 and digits <= 8:
        return f"{value:.{digits}f} ± {error:.{digits}f}"
    return f"{value:.{max(int(np.floor(np.log10(abs(value) or error))) + digits, 0)}e} ± {error:.1e}"


def unit_of(label: str) -> str:
    name = label.partition("[")[0]
    return UNITS.get(name) or OF_VIEWS.get(name.rpartition(".")[2], "")


@public
def fit(
    experiments: Experiment | Sequence[Experiment],
    start: Mapping[str, Any],
    bounds: Mapping[str, tuple[Any, Any]] | None = None,
    iterations: int = 50,
    on_trial: Callable[[], None] | None = None,
    starts: int | None = None,
) -> Fit:
    """Fit parameters to measured experiments by least squares, with error bars.

    A residual is a simulation's prediction minus the measured number. Each Jacobian takes one run for each fitted
    number. The first fit weights all residuals equally, and
    its residuals determine the weights of a second fit. The residuals of the second fit determine the error bars (see
    `cortado.optimisation.fitting.certainty`).

    Args:
        experiments: a `measured.Experiment`, or several with the same parameters.
        start: initial values of the fitted parameters, by name. Positive parameters, such as a viscosity, are searched
            by their logarithm. Parameters that videos calibrate are added automatically. Their initial values are the
            cameras' values.
        bounds: pairs (lower, upper) by parameter name. A bound is a number, an array in the shape of the parameter, or
            None. A number with two equal bounds is not fitted.
        iterations: greatest number of trial points of each of the two fits.
        on_trial: function that is called after each trial point.
        starts: number of starts. The default is one start, and three more if the first fit ends in doubt. Additional
            starts are chosen within the bounds by forward runs. Positive numbers without bounds are varied by a factor
            of 100 in both directions. The fit with the least residuals is returned. Its attribute ``tried`` lists all
            searches.

    Raises InputError for unsuitable start, bounds or experiments, DivergedError if the run at the start diverges, and
    ComputationError if the measurements do not determine all parameters.

    Example::

        fit = cortado.fit(experiment, {"viscosity": 0.1}, bounds={"viscosity": (0.01, 1.0)})
        print(fit.values["viscosity"])
    """
    each = [experiments] if isinstance(experiments, Experiment) else experiments
    if not isinstance(each, list | tuple) or not all(isinstance(one, Experiment) for one in each):
        raise InputError(f"experiments is {shown(experiments)}, but must be a cortado.measured.Experiment, or a list.")
    if not each:
        raise InputError("experiments is empty, but must have one experiment at least.")
    require_table("start", start, "{'viscosity': 1.0}")
    require_function("on_trial", on_trial)
    iterations = whole_number("iterations", iterations, 1)
    starts = None if starts is None else whole_number("starts", starts, 1)
    known = each[0].simulation.known
    own = {name: value for one in each for name, value in one.start.items()}
    given = {**start, **{name: value for name, value in own.items() if name not in start}}
    if not given:
        raise InputError("start is empty, but must have a parameter to fit.")
    above_zero = (Range.POSITIVE, Range.NOT_NEGATIVE)
    positive = [n for n in given if (n in known and known[n].range in above_zero) or n.endswith(".extinction")]
    unseen = {name: mask for one in each for name, mask in one.unseen.items()}
    clocks = {name: ends for one in each for name, ends in one.clocks.items()}
    coordinates = Coordinates.of(given, positive, {**clocks, **({} if bounds is None else bounds)}, unseen)
    problem = LeastSquares(each, coordinates, on_trial)
    found = _from(problem, coordinates.start, iterations)
    if starts != 1 and (starts is not None or found.in_doubt):
        tried = list(found.tried)
        for other_start in other_starts(problem, 3 if starts is None else starts - 1):
            try:
                other = _from(problem, other_start, iterations)
            except (ComputationError, DivergedError):
                continue
            tried += other.tried
            if other.tried[0].misfit < min(one.misfit for one in found.tried):
                found = other
            if starts is None and not (found.in_doubt and elsewhere(found, tried)):
                break  # a fit without doubts, or all have the same end
        spent = replace(found, runs=problem.runs, tangents=problem.tangents, refused=problem.refused)
        found = replace(spent, tried=tuple(tried), doubts=(*found.doubts, *other_minima(found, tried)))
    if not found.doubts:
        return found
    assert found.at is not None
    causes = dear_causes(problem, found.at, [part.weighting for part in found.parts])
    return replace(found, doubts=(*found.doubts, *causes), runs=problem.runs, tangents=problem.tangents)


def _from(problem: LeastSquares, start: np.ndarray, iterations: int) -> Fit:
    at = problem.estimated(start)
    sizes = [part.observation.noise or spread(r) or 1.0 for part, r in zip(problem.parts, at.residuals, strict=True)]
    weights = [Weighting(size) for size in sizes]
    at = search(problem, at, weights, iterations, 1e-3).at
    weights = noise_of(problem, at, weights)
    at, converged = least(problem, at, weights, iterations)
    at, settled = over_the_bars(problem, at, weights)
    found = Certainty.of(problem, at, weights)
    alone = [Weighting(spread(r) or weight.scale) for r, weight in zip(at.residuals, weights, strict=True)]
    return Fit(
        coordinates=problem.coordinates,
        u=at.u,
        coordinate_covariance=found.covariance,
        naive_covariance=inverse(problem, hessian(problem, at, alone)),
        degrees_of_freedom=found.degrees_of_freedom,
        parts=found.parts,
        doubts=doubts_of(problem, at, weights, found),
        converged=converged if settled is None else settled,
        tried=(Tried(start, at.u, misfit(problem, at.residuals)),),
        runs=problem.runs,
        tangents=problem.tangents,
        refused=problem.refused,
        sum_of_squares=problem.sum_of_squares(at.residuals, weights),
        hessian=found.hessian,
        problem=problem,
        at=at,
    )


def elsewhere(found: Fit, tried: Sequence[Tried]) -> list[Tried]:
    """Return the searches that ended at a minimum other than ``found``, sorted by misfit."""
    bars = np.sqrt(np.diag(found.coordinate_covariance))
    near = SAME * np.where(found.coordinates.by_logarithm, 1.0, np.abs(found.u))
    others = [one for one in tried if (np.abs(one.end - found.u) > np.maximum(FAR * bars, near)).any()]
    return sorted(others, key=lambda one: one.misfit)


def other_minima(found: Fit, tried: Sequence[Tried]) -> list[str]:
    """Return a sentence on the second-lowest local minimum, if it is nearly as likely as the fit."""
    others, bars = elsewhere(found, tried), np.sqrt(np.diag(found.coordinate_covariance))
    if not others:
        return []
    other, least = others[0], min(one.misfit for one in tried)
    independent = sum(part.frames * part.samples for part in found.parts)
    if 2.0 * independent * (other.misfit - least) > 9.0:  # log of the likelihood ratio: three standard errors
        return []
    k = int(np.argmax(np.abs(other.end - found.u) / np.maximum(bars, TINY)))
    label, value = found.labels[k], found.coordinates.numbers(other.end)[k]
    times = f"with residuals {np.exp(other.misfit - least):.3g} times as large"
    said = f"Another search ended where {label} is {value:.3g}, {times}"
    return [f"{said}: the measurements hardly decide between both results."]
