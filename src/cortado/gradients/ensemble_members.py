"""Ensembles: parameters and first states around given ones, over which a loss or its gradient is averaged."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from cortado.arrays import as_numbers, is_whole, require_at_most, require_whole
from cortado.device.memory import require
from cortado.device.precision import Precision
from cortado.errors import InputError, shown
from cortado.executors import Executor, InProcess, checked_executor
from cortado.fixed import keep_own
from cortado.gradients.estimator import Differentiable, Estimate, GradientEstimator
from cortado.gradients.points import Point, Sample, evaluated
from cortado.rollout.rollout import Observer
from cortado.scene.fields import as_number
from cortado.scene.parameters.values import Arrays, Values

MOST_SAMPLES = 100_000
"""Samples of an ensemble; more are taken for a mistake."""
_RUN = 1000.0
"""[bytes] of what is kept of a run besides numbers."""


@dataclass(frozen=True)
class Ensemble:
    """An ensemble around the parameters that an estimator is asked about: its width, and how many samples are drawn.

    The parameters, N numbers in all, are drawn from a ball of radius sqrt(N), in units of their spreads; to every
    coordinate of the first positions a normal random number is added. Samples come in antithetic pairs, and are the
    same at every call.
    """

    spread: float | Mapping[str, float] = 0.5
    """Width of the ensemble in each parameter, in its units, one for all or by name. It is sqrt((N + 2) / N) times the
    standard deviation of a component."""
    samples: int = 8
    """At most 100,000; all their results are kept until they are averaged, for which there has to be memory."""
    position_noise: float = 0.01
    """Standard deviation of the perturbations of first positions [spacings]; 0 for none."""
    seed: int = 0
    executor: Executor = field(default=InProcess(), compare=False, repr=False, kw_only=True)
    """Where the members of the ensemble are computed, which changes no bit of the result."""

    def __post_init__(self) -> None:
        if not is_whole(self.samples) or self.samples < 2:
            raise InputError(f"samples is {shown(self.samples)}, but must be at least 2, to know how they scatter.")
        require_at_most("samples", self.samples, MOST_SAMPLES)
        position_noise = as_number(self.position_noise)
        if position_noise is None or position_noise < 0.0:
            raise InputError(
                f"position_noise is {shown(self.position_noise)}, but must be a number of at least 0, in spacings."
            )
        require_whole("seed", self.seed, 0)
        for name, spread in self.spread.items() if isinstance(self.spread, Mapping) else [("parameters", self.spread)]:
            _checked_spread(name, spread)
        checked_executor(self.executor)
        keep_own(self, "spread")

    def around(self, problem: Differentiable, parameters: Values, draw: int = 0) -> "Sampler":
        """The ensemble around these parameters of a problem; another ``draw`` has other samples, independent of these.
        Raises `InputError` for a batch, for no parameters, and for spreads that round-off swallows."""
        if problem.simulation.batch is not None:
            raise InputError(
                f"{type(self).__name__} is given a problem of a batch, but must be given one of a single scene, whose "
                "samples it runs in batches of its own."
            )
        if not parameters:
            raise InputError(f"parameters is empty, but must name what {type(self).__name__} is to vary.")
        values = {name: as_numbers(f"parameter {name}", value) for name, value in parameters.items()}
        widths = {name: self._spread(name) for name in values}
        for name, value in values.items():
            _check_resolved(name, value, widths[name], problem.simulation.precision)
        spreads = np.concatenate([np.full(value.size, widths[name]) for name, value in values.items()])
        start = problem.simulation.positions
        position_noise = self.position_noise * problem.simulation.scene.discretisation.spacing
        return Sampler(values, spreads, start, position_noise, np.random.default_rng([self.seed, draw]))

    def evaluated(self, problem: Differentiable, points: Iterable[Point], observe: Observer | None) -> list[Estimate]:
        """Estimates at points, in their order. Where ``observe`` is given they are computed in this process, which has
        the states that it is called with."""
        executor = self.executor if observe is None else InProcess()
        return evaluated(problem, points, executor, observe)

    def require_memory(self, runs: int, numbers: int) -> None:
        """Raises `InputError` unless there is memory for what so many runs leave, so many numbers each."""
        require({f"{runs:,} runs of {self.samples:,} samples": runs * (_RUN + 8.0 * numbers)}, "take fewer samples")

    def _spread(self, name: str) -> float:
        if isinstance(self.spread, Mapping) and name not in self.spread:
            raise InputError(f"spread has nothing for {name}, but must have a number for every parameter.")
        return _checked_spread(name, self.spread[name] if isinstance(self.spread, Mapping) else self.spread)


@dataclass(frozen=True)
class Sampler:
    """An ensemble around the parameters of a problem, from which samples are drawn."""

    values: Arrays
    spreads: np.ndarray
    """(numbers,) the spread of every component of the values, as one vector."""
    start: np.ndarray
    """(n, d) first positions of the simulation [m]"""
    position_noise: float
    """[m]"""
    random: np.random.Generator

    def rotation(self) -> np.ndarray:
        """(numbers, numbers) rows of a random orthonormal basis, uniform over all of them."""
        q, r = np.linalg.qr(self.random.standard_normal((len(self.spreads), len(self.spreads))))
        return (q * np.sign(np.diag(r))).T

    def offset(self) -> np.ndarray:
        """(numbers,) uniform in the ball, in spreads."""
        direction, numbers = self.random.standard_normal(len(self.spreads)), len(self.spreads)
        radius = np.sqrt(numbers) * self.random.random() ** (1.0 / numbers)
        return radius / np.linalg.norm(direction) * direction

    def displacement(self) -> np.ndarray:
        """(n, d) a random displacement of the first positions [m]"""
        return self.position_noise * self.random.standard_normal(self.start.shape)

    def sample(self, u: np.ndarray, displacement: np.ndarray, estimator: GradientEstimator | None = None) -> Sample:
        """The parameters moved by ``u`` (numbers,), in spreads, and displaced first positions."""
        values = _moved(self.values, self.spreads * u)
        if self.position_noise:
            values["initial_positions"] = values.get("initial_positions", self.start) + displacement
        return Sample(values, estimator)

    def named(self, numbers: np.ndarray) -> Arrays:
        """One vector of numbers (numbers,) as arrays by the parameters' names."""
        return _moved({name: np.zeros_like(value) for name, value in self.values.items()}, numbers)


def _checked_spread(name: str, spread: object) -> float:
    number = as_number(spread)
    if number is None or number <= 0.0:
        raise InputError(f"spread of {name} is {shown(spread)}, but must be a number greater than 0.")
    return number


def _check_resolved(name: str, value: np.ndarray, spread: float, precision: Precision) -> None:
    """Raises `InputError` where a spread is lost in round-off, so that all samples would be the same."""
    lost = np.asarray(value, precision.numpy) == np.asarray(value + spread, precision.numpy)
    if lost.any():
        wanted = f"large enough to change {value[lost].flat[0]:g} in {precision.name}"
        raise InputError(f"spread of {name} is {spread:g}, but must be {wanted}.")


def _moved(values: Arrays, change: np.ndarray) -> Arrays:
    """Values plus a change (numbers,), which is one vector for all of them."""
    ends = np.cumsum([value.size for value in values.values()])
    parts = np.split(change, ends[:-1])
    return {name: value + part.reshape(value.shape) for (name, value), part in zip(values.items(), parts, strict=True)}
