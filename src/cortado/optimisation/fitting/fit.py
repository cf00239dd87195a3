"""`cortado.fit`: fit parameters to measured experiments, with error bars and doubts about the model."""

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
from cortado.optimisation.fitting.certainty import Certainty, FittedPart, counted_covariance, noise_of, spread
from cortado.optimisation.fitting.doubts import dear_causes, doubts_of
from cortado.optimisation.fitting.experiment import Experiment
from cortado.optimisation.fitting.gauss_newton import TINY, least, misfit, other_starts, over_the_bars, search
from cortado.optimisation.fitting.least_squares import Coordinates, LeastSquares, Linearised, Weighting
from cortado.scene.parameter_values import UNITS
from cortado.scene.parameters import Range

NOISE_ALONE = (
    "The bars are of noise alone and leave out what the spacing and the time step have wrong: a fit with another "
    "discretisation.spacing shows how much that is."
)
OF_VIEWS = {
    "translation": "m",
    "rotation": "rad",
    "field_of_view": "degrees",
    "width": "m",
    "extinction": "1/m",
    "start": "s",
}
FAR, SAME = 3.0, 1e-3
"""Two searches ended in different local minima if their ends are further apart than both thresholds: `FAR` standard
errors, and the relative difference `SAME`."""


@dataclass(frozen=True)
class Profile:
    """The least sum of squares as a function of a number, with all other numbers fitted."""

    label: str
    values: np.ndarray
    """Values (points,) of the number, in its unit."""
    deviance: np.ndarray
    """Sum of squares (points,) minus the least one, in squared standard errors."""
    expected: np.ndarray
    """The deviance (points,) of the linear model from which the intervals are computed."""


@dataclass(frozen=True)
class FittedNumber:
    """A fitted number with standard ``error`` and interval from ``lower`` to ``upper``."""

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
    """A start of a fit, and the end of the search from this start, as coordinates (free,)."""

    start: np.ndarray
    end: np.ndarray
    misfit: float
    """Mean logarithm of the size of the residuals at the end."""


@public
@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters that were fitted to experiments, with their error bars.

    Example::

        fit = cortado.fit(experiment, {"viscosity": 0.1})
        print(fit.intervals(0.95)["viscosity"])
    """

    coordinates: Coordinates = field(repr=False)
    u: np.ndarray = field(repr=False)
    """Fitted coordinates (free,): numbers, or logarithms of positive numbers."""
    coordinate_covariance: np.ndarray = field(repr=False)
    """Covariance (free, free) of the coordinates."""
    naive_covariance: np.ndarray = field(repr=False)
    """Covariance (free, free) if all measured numbers were independent, for comparison; far too small."""
    degrees_of_freedom: np.ndarray = field(repr=False)
    """Degrees of freedom (free,) of Student's t-distribution."""
    parts: tuple[FittedPart, ...] = field(repr=False)
    """Residuals and their scatter, for each observation."""
    doubts: tuple[str, ...] = field(repr=False)
    """Sentences about residuals that do not look like noise; the model's error then exceeds the error bars."""
    converged: bool = True
    """True if the search ended at a minimum of the sum of squares; False if the search used all iterations."""
    tried: tuple[Tried, ...] = field(default=(), repr=False)
    """All starts with the ends of their searches, including this fit's."""
    runs: int = 0
    """Number of forward runs of single experiments."""
    tangents: int = 0
    """Number of forward-mode runs of single experiments along single tangents."""
    refused: int = 0
    """Number of trial points that the fit did not use, because their runs diverged."""
    sum_of_squares: float = field(default=0.0, repr=False)
    hessian: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    problem: LeastSquares | None = field(default=None, repr=False)
    at: Linearised | None = field(default=None, repr=False)
    """The end of the search with the Jacobian of the error bars; None in pickled fits."""

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "problem": None, "at": None}

    @property
    def values(self) -> dict[str, Any]:
        """Return the fitted parameters by name: arrays, or numbers."""
        return _plain(self.coordinates.values(self.u))

    @property
    def labels(self) -> list[str]:
        """Return the labels of the numbers that were searched, in the order of the covariance."""
        return self.coordinates.labels

    @cached_property
    def covariance(self) -> np.ndarray:
        """Return the covariance (free, free) of the numbers in the parameters' units, valid for small errors."""
        slopes = self.coordinates.slopes(self.u)
        return self.coordinate_covariance * np.outer(slopes, slopes)

    @property
    def standard_errors(self) -> dict[str, Any]:
        """Return standard errors by name, in the shape and the unit of the parameter; 0 for a number not searched."""
        return _plain(self.coordinates.spread(np.sqrt(np.diag(self.covariance)), 0.0))

    @property
    def correlation(self) -> np.ndarray:
        """Return the correlation matrix (free, free) of the fitted coordinates."""
        size = np.sqrt(np.diag(self.coordinate_covariance))
        return self.coordinate_covariance / np.maximum(np.outer(size, size), 1e-300)

    @property
    def not_told_apart(self) -> tuple[tuple[str, str, float], ...]:
        """Return pairs of labels whose estimates have a correlation of more than 0.9, with the correlation."""
        found, labels = self.correlation, self.labels
        pairs = combinations(range(len(labels)), 2)
        return tuple((labels[i], labels[j], float(found[i, j])) for i, j in pairs if abs(found[i, j]) > 0.9)

    def intervals(self, confidence: float = 0.95) -> dict[str, tuple[Any, Any]]:
        """Return, by name, lower and upper ends of intervals that contain the true value with the probability
        ``confidence``, if the model is right. Intervals of positive numbers are those of their logarithms. Raise
        `InputError` for an unsuitable confidence."""
        if not 0.0 < as_one_number("confidence", confidence) < 1.0:
            raise InputError(f"confidence is {shown(confidence)}, but must be between 0 and 1.")
        from scipy.stats import t as student

        reach = student.ppf(0.5 + 0.5 * confidence, self.degrees_of_freedom)
        reach = reach * np.sqrt(np.diag(self.coordinate_covariance))
        lower, upper = (_plain(self.coordinates.values(self.u + way * reach)) for way in (-1.0, 1.0))
        return {name: (lower[name], upper[name]) for name in lower}

    def profile(self, label: str, points: int = 7, reach: float = 2.5) -> Profile:
        """Compute the least sum of squares at ``points`` values of the number ``label``, with all other numbers fitted.
        The values extend by ``reach`` standard errors to both sides. Intervals are rough unless the profile is a
        parabola. Raise `InputError` for an unknown label, or if the fit was pickled."""
        if label not in self.labels or self.problem is None or self.at is None:
            raise InputError(f"label is {shown(label)}, but must be one of {', '.join(self.labels)}.")
        k, weights = self.labels.index(label), [part.weighting for part in self.parts]
        V = self.coordinate_covariance
        counted = np.linalg.inv(self.hessian)[k, k]
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
        """Return the logarithm of the posterior density, up to a constant, at coordinates ``u`` (free,), for samplers.
        A call takes a forward run.

        The prior is flat in the coordinates (logarithms of positive numbers) within the bounds. The result is -inf
        out of bounds, and if the run diverges. `Fit.coordinates.values` converts coordinates to parameters. Raise
        `InputError` for a wrong shape, or if the fit was pickled.

        The result is minus half of the weighted sum of squares, relative to the minimum. With correlated noise the
        error bars, of covariance V, are longer than the curvature N of the sum of squares gives. Distances from the
        estimate are therefore multiplied by the matrix W with W^T N W = V^-1, the curvature adjustment of Ribatet,
        Cooley and Davison (2012).
        """
        point = as_numbers("u", u)
        if point.shape != self.u.shape:
            raise InputError(f"u has shape {point.shape}, but must be {self.u.shape}, one for each fitted number.")
        if self.problem is None:
            raise InputError(
                "The fit was pickled without its experiments, which are needed to compute how likely other "
                "parameters are."
            )
        lower, upper = self.coordinates.bounds
        root = np.linalg.cholesky(self.hessian)
        wanted = np.linalg.cholesky(np.linalg.inv(self.coordinate_covariance))
        shortened = self.u + np.linalg.solve(root.T, wanted.T @ (point - self.u))
        if not (np.isfinite(point) & (lower <= point) & (point <= upper)).all():
            return -np.inf
        try:
            residuals = self.problem.residuals(np.clip(shortened, lower, upper))
        except DivergedError:
            return -np.inf
        squares = self.problem.sum_of_squares(residuals, [part.weighting for part in self.parts])
        return -0.5 * (squares - self.sum_of_squares)

    def numbers(self, confidence: float = 0.95) -> list["FittedNumber"]:
        """Return the fitted numbers with their `intervals` for a ``confidence``."""
        ends = self.intervals(confidence)
        free = self.coordinates.free
        lower, upper = (np.concatenate([np.ravel(pair[k]) for pair in ends.values()])[free] for k in range(2))
        values, errors = self.coordinates.numbers(self.u), np.sqrt(np.diag(self.covariance))
        each = zip(self.labels, self.coordinates.at_start[free], values, errors, lower, upper, strict=True)
        return [FittedNumber(label, *map(float, rest)) for label, *rest in each]

    def lines(self, confidence: float = 0.95) -> list[str]:
        """Return a line for each number, with value, standard error, and interval for a ``confidence``."""
        return [
            f"{one.words} ({100 * confidence:g} % between {one.lower:.4g} and {one.upper:.4g})"
            for one in self.numbers(confidence)
        ]

    @property
    def in_doubt(self) -> bool:
        """Return True if the fit has not converged, or there are doubts."""
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
        """Return sentences about correlated numbers, an early end, refused points, and doubts."""
        apart = [f"{a} and {b} are hardly told apart (correlation {c:.3f})." for a, b, c in self.not_told_apart]
        ended = [] if self.converged else ["The fit has not converged: give it more iterations."]
        lost = f"The runs at {counted(self.refused, 'point')} that the fit tried diverged, and it knows nothing of them"
        refused = [f"{lost}: try a smaller solver.time_step, or bounds."] if self.refused else []
        return [*apart, *ended, *refused, *self.doubts]


def _plain(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    return {name: array if array.shape else float(array) for name, array in arrays.items()}


def with_error(value: float, error: float) -> str:
    """Format a value and its standard error, with two digits of an error that begins with 1 to 3, or one digit."""
    if not np.isfinite(error) or error <= 0.0:
        return f"{value:.6g} ± {error:.2g}"
    power = int(np.floor(np.log10(error)))
    digits = -power + (1 if error / 10.0**power < 3.55 else 0)
    if digits >= 0 and abs(value) < 1e6 and digits <= 8:
        return f"{value:.{digits}f} ± {error:.{digits}f}"
    return f"{value:.{max(int(np.floor(np.log10(abs(value) or error))) + digits, 0)}e} ± {error:.1e}"


def unit_of(label: str) -> str:
    """Return the unit of a fitted number by its label; empty without a unit."""
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

    A residual is a simulation's prediction minus the measured number. The search estimates the Jacobian by a forward
    run for each fitted number, and at its end computes the Jacobian by forward mode. The first fit weights all
    residuals equally. The scatter and correlation of the residuals give the weights of a second fit, whose residuals
    give the error bars (see `cortado.optimisation.fitting.certainty`).

    ``experiments``: a `measured.Experiment`, or several with the same parameters. ``start``: first values of the fitted
    parameters, by name. Positive parameters, such as a viscosity, are searched by their logarithm. Parameters that
    videos calibrate are added automatically, with the values of the cameras. ``bounds``: by name, (lower, upper), each
    a number, an array of the parameter's shape, or None. A number with two equal bounds is not searched.
    ``iterations``: greatest number of trial points of each of the two fits. ``on_trial``: called after each trial
    point. ``starts``: number of starts, by default one, and three more if the first fit ends in doubt. Forward runs
    choose further starts within the bounds, or within two decades to both sides of a positive number. The fit with the
    least residuals is returned, and the fit's ``tried`` lists the ends of all searches.

    Raises InputError for unsuitable start, bounds or experiments, DivergedError if the run at the start diverges, and
    ComputationError if the measurements do not determine all parameters.

    Example::

        fit = cortado.fit(experiment, {"viscosity": 0.1}, bounds={"viscosity": (0.01, 1.0)})
        print(fit.parameters["viscosity"])
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
        doubts = (*found.doubts, *other_valleys(found, tried))
        spent = replace(found, runs=problem.runs, tangents=problem.tangents, refused=problem.refused)
        found = replace(spent, tried=tuple(tried), doubts=doubts)
    if not found.doubts:
        return found
    assert found.at is not None
    causes = dear_causes(problem, found.at, [part.weighting for part in found.parts])
    return replace(found, doubts=(*found.doubts, *causes), runs=problem.runs, tangents=problem.tangents)


def _from(problem: LeastSquares, start: np.ndarray, iterations: int) -> Fit:
    """Fit from a start, first with equal weights, and again with weights from the residuals."""
    at = problem.estimated(start)
    sizes = [part.observation.noise or spread(r) or 1.0 for part, r in zip(problem.parts, at.residuals, strict=True)]
    weights = [Weighting(size) for size in sizes]
    at = search(problem, at, weights, iterations, 1e-3).at
    weights = noise_of(problem, at, weights)
    at, converged = least(problem, at, weights, iterations)
    at, settled = over_the_bars(problem, at, weights)
    found = Certainty.of(problem, at, weights)
    return Fit(
        coordinates=problem.coordinates,
        u=at.u,
        coordinate_covariance=found.covariance,
        naive_covariance=counted_covariance(problem, at, weights),
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
    """Return the searches that ended in other local minima, the lowest first."""
    bars = np.sqrt(np.diag(found.coordinate_covariance))
    near = SAME * np.where(found.coordinates.by_logarithm, 1.0, np.abs(found.u))
    others = [one for one in tried if (np.abs(one.end - found.u) > np.maximum(FAR * bars, near)).any()]
    return sorted(others, key=lambda one: one.misfit)


def other_valleys(found: Fit, tried: Sequence[Tried]) -> list[str]:
    """Return a sentence about the lowest other local minimum, if it is nearly as likely."""
    others, bars = elsewhere(found, tried), np.sqrt(np.diag(found.coordinate_covariance))
    if not others:
        return []
    other, least = others[0], min(one.misfit for one in tried)
    independent = sum(part.frames * part.samples for part in found.parts)
    if 2.0 * independent * (other.misfit - least) > 9.0:  # log of the likelihood ratio: three standard errors
        return []
    k = int(np.argmax(np.abs(other.end - found.u) / np.maximum(bars, TINY)))
    label, value = found.labels[k], found.coordinates.numbers(other.end)[k]
    return [
        f"Another search ended where {label} is {value:.3g}, with residuals {np.exp(other.misfit - least):.3g} times "
        "as large: what was measured hardly tells which of both is right."
    ]
