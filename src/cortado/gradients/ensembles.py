"""Estimators that average over an ensemble of parameters and initial states."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cortado.arrays import as_number, as_numbers, is_whole, require_at_most, require_whole
from cortado.calls import keep_own
from cortado.device.threads import require
from cortado.errors import ComputationError, CortadoWarning, DivergedError, InputError, OutOfRangeError, shown, warn
from cortado.executors import Executor, InProcess, checked_executor
from cortado.gradients.estimator import (
    NO_RUN,
    Differentiable,
    Estimate,
    GradientEstimator,
    Point,
    checked_estimate,
    checked_estimator,
    evaluated,
    without_runs,
)
from cortado.gradients.reverse_mode import AdjointViscosity
from cortado.rollout.rollout import Observer
from cortado.scene.parameter_values import Arrays, Values

MOST_SAMPLES = 100_000
_RUN = 1000.0


@dataclass(frozen=True)
class Ensemble:
    """A random ensemble around given parameters.

    Let N be the number of components of all parameters. The deviations from the given parameters, divided by their
    spreads, are drawn from a ball of radius sqrt(N). A normal random number is added to every coordinate of the initial
    positions. Samples come in antithetic pairs, and every call uses the same samples.
    """

    spread: float | Mapping[str, float] = 0.5
    """Width of the ensemble in each parameter, in the unit of the parameter: one number, or a dictionary by name. The
    width is sqrt((N + 2) / N) times the standard deviation of a component, where N is the number of components."""
    samples: int = 8
    """Number of samples, at most 100,000. The memory must have room for the results of all samples."""
    position_noise: float = 0.01
    """Standard deviation of the perturbations of initial positions [spacings]."""
    seed: int = 0
    executor: Executor = field(default=InProcess(), compare=False, repr=False, kw_only=True)
    """Executor that computes the members of the ensemble. The results of all executors are bitwise equal."""

    def __post_init__(self) -> None:
        if not is_whole(self.samples) or self.samples < 2:
            raise InputError(f"samples is {shown(self.samples)}, but must be at least 2: one sample has no scatter.")
        require_at_most("samples", self.samples, MOST_SAMPLES)
        position_noise = as_number(self.position_noise)
        if position_noise is None or position_noise < 0.0:
            said = f"position_noise is {shown(self.position_noise)}"
            raise InputError(f"{said}, but must be a number of at least 0, in spacings.")
        require_whole("seed", self.seed, 0)
        for name, spread in self.spread.items() if isinstance(self.spread, Mapping) else [("parameters", self.spread)]:
            if (as_number(spread) or 0.0) <= 0.0:
                raise InputError(f"spread of {name} is {shown(spread)}, but must be a number greater than 0.")
        checked_executor(self.executor)
        keep_own(self, "spread")

    def around(self, problem: Differentiable, parameters: Values, draw: int = 0) -> "Sampler":
        """Return the ensemble around the parameters. Different numbers ``draw`` give independent samples."""
        if problem.simulation.batch is not None:
            said = f"{type(self).__name__} is given a problem with a batch of scenes, but needs a single scene"
            raise InputError(f"{said}: the estimator makes its own batches of samples.")
        if not parameters:
            raise InputError(f"parameters is empty, but must name the parameters that {type(self).__name__} varies.")
        values = {name: as_numbers(f"parameter {name}", value) for name, value in parameters.items()}
        if lacking := [name for name in values if isinstance(self.spread, Mapping) and name not in self.spread]:
            raise InputError(f"spread has no number for {lacking[0]}, but must have a number for every parameter.")
        given = self.spread if isinstance(self.spread, Mapping) else dict.fromkeys(values, self.spread)
        widths, precision = {name: float(given[name]) for name in values}, problem.simulation.precision
        for name, value in values.items():
            lost = np.asarray(value, precision.numpy) == np.asarray(value + widths[name], precision.numpy)
            if lost.any():  # all samples would be equal
                wanted = f"large enough to change {value[lost].flat[0]:g} in {precision.name}"
                raise InputError(f"spread of {name} is {widths[name]:g}, but must be {wanted}.")
        spreads = np.concatenate([np.full(value.size, widths[name]) for name, value in values.items()])
        start = problem.simulation.positions
        position_noise = self.position_noise * problem.simulation.scene.discretisation.spacing
        return Sampler(values, spreads, start, position_noise, np.random.default_rng([self.seed, draw]))

    def evaluated(self, problem: Differentiable, points: Iterable[Point], observe: Observer | None) -> list[Estimate]:
        """Return the estimates at the points. With ``observe``, this process computes all runs."""
        return evaluated(problem, points, self.executor if observe is None else InProcess(), observe)

    def require_memory(self, runs: int, numbers: int) -> None:
        require({f"{runs:,} runs of {self.samples:,} samples": runs * (_RUN + 8.0 * numbers)}, "take fewer samples")


@dataclass(frozen=True)
class Sampler:
    values: Arrays
    spreads: np.ndarray
    """Spread of each component of the parameters (numbers,)."""
    start: np.ndarray
    """Initial positions (n, d) [m]."""
    position_noise: float
    """Standard deviation of the perturbations of initial positions [m]."""
    random: np.random.Generator

    def rotation(self) -> np.ndarray:
        """Return a random orthonormal basis (numbers, numbers), uniformly distributed over all rotations."""
        q, r = np.linalg.qr(self.random.standard_normal((len(self.spreads), len(self.spreads))))
        return (q * np.sign(np.diag(r))).T

    def offset(self) -> np.ndarray:
        direction, numbers = self.random.standard_normal(len(self.spreads)), len(self.spreads)
        radius = np.sqrt(numbers) * self.random.random() ** (1.0 / numbers)
        return radius / np.linalg.norm(direction) * direction

    def displacement(self) -> np.ndarray:
        return self.position_noise * self.random.standard_normal(self.start.shape)

    def sample(self, u: np.ndarray, displacement: np.ndarray, estimator: GradientEstimator | None = None) -> Point:
        """Return the sample with parameters moved by ``u`` (numbers,) times their spreads."""
        values = _moved(self.values, self.spreads * u)
        if self.position_noise:
            values["initial_positions"] = values.get("initial_positions", self.start) + displacement
        return Point(values, estimator, errors=NO_RUN, is_sample=True)

    def named(self, numbers: np.ndarray) -> Arrays:
        """Split a vector (numbers,) into arrays by parameter name."""
        return _moved({name: np.zeros_like(value) for name, value in self.values.items()}, numbers)


def _moved(values: Arrays, change: np.ndarray) -> Arrays:
    parts = np.split(change, np.cumsum([value.size for value in values.values()])[:-1])
    return {name: value + part.reshape(value.shape) for (name, value), part in zip(values.items(), parts, strict=True)}


MOST_LEFT_OUT = 0.25
"""Greatest fraction of failed members in an average."""
ADVICE = "take a smaller spread, or a logarithm (cortado.optimisation.transforms)"


class LeftOutWarning(CortadoWarning):
    """A warning that an average ignores failed runs of the ensemble."""


def remaining(runs: Sequence[Estimate], members: int, what: str) -> np.ndarray:
    """Return a mask (members,) of the members without a failed run. ``what`` names members in the plural."""
    errors = [getattr(one, "diverged", None) for one in runs]  # an estimator of one's own may return anything
    lost = np.array([error is not None for error in errors], dtype=bool).reshape(members, -1)
    kept = np.array([not any(member) for member in lost], dtype=bool)
    out = int(np.count_nonzero(~kept))
    if not out:
        return kept
    present = [error for error in errors if error is not None]
    said = f"{without_runs(present, f'{lost.size} runs of the ensemble')}, so that {out} of {len(kept)} {what}"
    if out > MOST_LEFT_OUT * len(kept):
        preface = f"{said} cannot be averaged, but at most a quarter may be left out: {ADVICE}. The first error:"
        if isinstance(present[0], DivergedError):
            raise present[0].among_others(preface)
        raise OutOfRangeError(f"{preface} {present[0]}")
    warn(f"{said} are left out of the average. The first error: {present[0]}", LeftOutWarning)
    return kept


SMOOTHING, SURROGATE = AdjointViscosity(order=2), AdjointViscosity()
MOST_NUMBERS = 64
"""Greatest number of components for central differences. Each component costs two runs per sample."""


@dataclass(frozen=True)
class RandomizedSmoothing(Ensemble):
    """A gradient estimator: central differences averaged over an ensemble of parameters and initial states. Randomized
    smoothing is the reference for long runs.

    Formula: let u be the parameters with N components, each divided by its spread, and L the loss. The gradient is

        g = mean over samples of sum_k (L(u + r q_k) - L(u - r q_k)) / (2 r) q_k,   r = sqrt(N),

    where q_1 ... q_N is an orthonormal basis, rotated at random in every sample. The two losses of a difference have
    the same perturbed initial positions. The gradient g belongs to the loss averaged over the ball of an `Ensemble`.

    Bias: the average removes features of the loss narrower than the spread, as intended. Noise: the ``standard_error``
    of the `Estimate`. Cost: 2 N forward runs per sample, so N should be a few dozen at most.

    Runs that diverge: a difference with a diverged run is left out, up to a quarter of all differences. The sum over
    the remaining differences of the sample is scaled up. The scaling adds no bias if all directions diverge equally
    often.

    ``position_noise`` is the standard deviation of the displacements of initial positions, in spacings. ``seed`` is the
    seed of the random numbers. ``executor`` computes the runs.

    Example: ``estimate = problem.estimate(parameters, cortado.gradients.RandomizedSmoothing(0.5))``
    """

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """Return the loss and its smoothed gradient. ``observe`` is not called, because there are no adjoints."""
        ensemble = self.around(problem, parameters)
        numbers = len(ensemble.spreads)
        if numbers > MOST_NUMBERS:
            said = f"the parameters have {numbers} components, but must have at most {MOST_NUMBERS}"
            advice = "take fewer components, such as one gravity for all steps, or another estimator"
            raise InputError(f"{said}, as each component takes two runs: {advice}.")
        self.require_memory(2 * numbers * self.samples, numbers)
        directions, r = [], np.sqrt(numbers)

        def points() -> Iterator[Point]:
            yield Point(ensemble.values)
            for _ in range(self.samples):
                for q in ensemble.rotation():
                    displacement = ensemble.displacement()
                    directions.append(q)
                    yield ensemble.sample(r * q, displacement)
                    yield ensemble.sample(-r * q, displacement)

        at_them, *runs = self.evaluated(problem, points(), None)
        kept = remaining(runs, len(directions), "differences")
        found = np.zeros((self.samples, numbers))
        for k in np.flatnonzero(kept):
            found[k // numbers] += (runs[2 * k].loss - runs[2 * k + 1].loss) / (2.0 * r) * directions[k]
        counts = kept.reshape(self.samples, numbers).sum(axis=1)
        found = found[counts > 0] * (numbers / counts[counts > 0, None])
        gradient, error = (ensemble.named(one / ensemble.spreads) for one in mean_and_error(found))
        left_out = 2 * int(np.count_nonzero(~kept))
        mean = float(np.mean([one.loss for one in runs if one.diverged is None]))
        return Estimate(at_them.loss, gradient, error, len(found) - 1, mean, left_out)


@dataclass(frozen=True)
class EnsembleMean(Ensemble):
    """A gradient estimator: the mean gradient of a given estimator over an ensemble of parameters and initial states.

    Formula: g is the mean of the estimator's gradient over the points of the ensemble. If the estimator is accurate, g
    is the gradient of `RandomizedSmoothing`, but the cost does not depend on the number of parameters. For long runs,
    do not average `Exact` gradients, because the largest few dominate the mean.

    Bias: the estimator's bias. Perturbed initial positions add a bias if their effect on the loss is as large as the
    loss. Noise: the ``standard_error`` of the `Estimate`. Cost: ``samples`` gradients and one forward run.

    Samples that diverge: the whole antithetic pair is left out, up to a quarter of all pairs. The remaining samples are
    symmetric about the parameters, so that the mean is not shifted.

    ``spread`` is the width of the ensemble in the units of the parameters: one number, or a table by parameter name.
    ``position_noise`` is the standard deviation of the displacements of initial positions, in spacings. ``seed`` is the
    seed of the random numbers. ``executor`` computes the runs.

    Example: ``estimate = problem.estimate(parameters, cortado.gradients.EnsembleMean(0.5, samples=8))``
    """

    samples: int = 4
    """Number of samples, which must be even, because samples come in antithetic pairs."""
    estimator: GradientEstimator = SMOOTHING

    def __post_init__(self) -> None:
        super().__post_init__()
        require_pairs(self.samples)
        checked_estimator(self.estimator)

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """Return the loss and the mean gradient. ``observe`` is called with the adjoints of each sample."""
        ensemble = self.around(problem, parameters)
        displaced = ensemble.start.size if self.position_noise else 0
        self.require_memory(self.samples, 2 * len(ensemble.spreads) + displaced)

        def points() -> Iterator[Point]:
            yield Point(ensemble.values)
            for _ in range(self.samples // 2):
                u, displacement = ensemble.offset(), ensemble.displacement()
                yield ensemble.sample(u, displacement, self.estimator)
                yield ensemble.sample(-u, -displacement, self.estimator)

        at_them, *samples = self.evaluated(problem, points(), observe)
        kept = np.repeat(remaining(samples, self.samples // 2, "antithetic pairs"), 2)
        checked = [checked_estimate(samples[k], ensemble.values) for k in np.flatnonzero(kept)]
        numbers = np.array([joined(one.gradient, ensemble.values) for one in checked])
        gradient, error = (ensemble.named(one) for one in self.combined(numbers))
        mean = float(np.mean([one.loss for one in checked]))
        return Estimate(at_them.loss, gradient, error, len(numbers) // 2 - 1, mean, len(samples) - len(checked))

    def combined(self, gradients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard error of gradients (samples, numbers) in antithetic pairs."""
        return mean_and_error((gradients[::2] + gradients[1::2]) / 2.0)


def require_pairs(samples: int) -> None:
    if samples % 2 or samples < 4:
        raise InputError(f"samples is {shown(samples)}, but must be an even number of at least 4.")


def mean_and_error(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean and its standard error without overflow, or NaN for infinite samples."""
    size = np.abs(samples).max(initial=0.0)
    unit = size if 0.0 < size < np.inf else 1.0
    with np.errstate(invalid="ignore"):
        return samples.mean(axis=0), unit * (samples / unit).std(axis=0, ddof=1) / np.sqrt(len(samples))


def joined(gradient: Arrays, names: Iterable[str]) -> np.ndarray:
    return np.concatenate([gradient[name].ravel() for name in names])


@dataclass(frozen=True)
class Guided(Ensemble):
    """A gradient estimator: the mean gradient of a surrogate estimator over an ensemble, with each part scaled by
    differences of the loss.

    Formula: the mean of the surrogate's gradients, in units of the spreads, is divided into equal parts along the first
    axis of each parameter (steps or knots). Let p_1 ... p_K be the parts, scaled to length 1. The gradient is

        g = sum_k D_k p_k,   D_k = mean over samples of (L(u + r_k p_k) - L(u - r_k p_k)) / (2 r_k),   r_k = sqrt(N_k),

    where L is the loss, u are the parameters, and N_k is the number of non-zero components of part k. The two losses of
    a difference have the same perturbed initial positions. The gradient g is therefore the projection of the smoothed
    gradient onto the span of the parts. Source: guided evolution strategies (Maheswaranathan et al. 2019), without the
    search outside the span of the parts.

    Bias: directions outside the span of the parts are missed. The size of each part is correct for the smoothed loss.
    Noise: the ``standard_error`` combines the errors of D_k and p_k, with degrees of freedom by Welch and
    Satterthwaite. Cost: ``samples`` gradients of the surrogate and 1 + 2 K ``differences`` forward runs, for any number
    of parameters.

    Runs that diverge: runs of the surrogate are treated as in `EnsembleMean`. If a difference fails, its sample is left
    out of all D_k, so that all D_k average the same samples. At most a quarter of the samples may be left out. With
    fewer than 4 samples, no sample may be left out.

    ``spread`` is the width of the ensemble in the units of the parameters: one number, or a table by parameter name.
    ``position_noise`` is the standard deviation of the displacements of initial positions, in spacings. ``seed`` is the
    seed of the random numbers. ``executor`` computes the runs.

    Example: ``estimate = problem.estimate(parameters, cortado.gradients.Guided(0.5, parts=4))``
    """

    samples: int = 4
    """Number of gradients of the surrogate, which must be even."""
    parts: int = 4
    """Number of parts of each parameter, at most the length of its first axis. A vector or a number has one part."""
    differences: int = 2
    """Number of samples of each difference."""
    surrogate: GradientEstimator = SURROGATE

    def __post_init__(self) -> None:
        super().__post_init__()
        require_pairs(self.samples)
        require_whole("parts", self.parts, 1)
        require_whole("differences", self.differences, 2)
        for name in ("parts", "differences"):
            require_at_most(name, getattr(self, name), MOST_SAMPLES)
        checked_estimator(self.surrogate)

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """Return the loss and its gradient. ``observe`` is called with the adjoints of the surrogate's samples."""
        ensemble = self.around(problem, parameters, draw=1)
        own = self.spread, self.samples, self.position_noise, self.seed, self.surrogate
        surrogate = EnsembleMean(*own, executor=self.executor).estimate(problem, parameters, observe)
        assert surrogate.standard_error is not None and surrogate.degrees_of_freedom is not None
        parts, turns = self._parts(ensemble, surrogate.gradient, surrogate.standard_error)
        self.require_memory(2 * self.differences * len(parts), 0)
        reach = [np.sqrt(np.count_nonzero(part)) for part in parts]

        def points() -> Iterator[Point]:
            for _ in range(self.differences):
                displacement = ensemble.displacement()
                for r, part in zip(reach, parts, strict=True):
                    yield ensemble.sample(r * part, displacement)
                    yield ensemble.sample(-r * part, displacement)

        runs = self.evaluated(problem, points(), None)
        kept = remaining(runs, self.differences, "samples of the differences")
        pairs = np.array([one.loss for one in runs]).reshape(self.differences, len(parts), 2)[kept]
        sizes, size_errors = mean_and_error((pairs[..., 0] - pairs[..., 1]) / (2.0 * np.array(reach)))
        along, across = (np.reshape(rows, (-1, len(ensemble.spreads))) for rows in (parts, turns))
        errors = np.array([size_errors @ np.abs(along), np.abs(sizes) @ across])
        gradient, error = (ensemble.named(one / ensemble.spreads) for one in (sizes @ along, np.hypot(*errors)))
        shares = (errors**2).sum(axis=1) / max((errors**2).sum(), np.finfo(float).tiny)
        freedoms = len(pairs) - 1, surrogate.degrees_of_freedom
        freedom = float(1.0 / max((shares**2 / freedoms).sum(), 1.0 / sum(freedoms)))  # of a sum of errors (Welch 1947)
        left_out = surrogate.left_out + len(runs) // self.differences * int(np.count_nonzero(~kept))
        return Estimate(surrogate.loss, gradient, error, freedom, surrogate.mean_loss, left_out)

    def _parts(self, ensemble: Sampler, gradient: Arrays, error: Arrays) -> tuple[list[np.ndarray], list[np.ndarray]]:
        numbers = []  # of the part of each component
        for k, value in enumerate(ensemble.values.values()):
            rows = len(value) if value.ndim > 1 else 1
            numbers.append(self.parts * k + np.repeat(np.arange(rows) * self.parts // rows, value.size // rows))
        places = np.concatenate(numbers)
        whole, errors = (ensemble.spreads * joined(one, ensemble.values) for one in (gradient, error))
        greatest = np.abs(whole).max()
        if not np.isfinite(greatest):
            said = f"The gradient of {self.surrogate!r} is not finite, so that Guided has no direction"
            raise ComputationError(f"{said}; take another surrogate, or fewer steps.")
        whole, errors = (one / (greatest or 1.0) for one in (whole, errors))  # so that no square overflows
        lengths = {k: np.linalg.norm(whole[places == k]) for k in np.unique(places)}
        there = [(places == k, length) for k, length in lengths.items() if length]
        parts, turns = ([np.where(own, one, 0.0) / size for own, size in there] for one in (whole, errors))
        return parts, turns
