"""Find the number of steps up to which exact gradients are useful, and the estimators for longer runs."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from cortado.calls import ShortRepr
from cortado.certificate.consistency import LossHistory
from cortado.errors import InputError, shown
from cortado.gradients import AdjointViscosity, EnsembleMean, Exact, GradientEstimator, Guided, RandomizedSmoothing
from cortado.gradients.estimator import NO_RUN
from cortado.problem import Problem
from cortado.rollout.parameter_space import ParameterSpace
from cortado.scene.parameter_values import Arrays, Values
from cortado.scene.parameters import Axis, Parameter, Range, Role

PERTURBATION = 0.05
"""Size of a meaningful perturbation, relative to the parameter's value. Positions are perturbed relative to the
spacing, and velocities relative to the speed of a fall over the fluid's height."""


def checked_parameters(problem: Problem, parameters: Values | Sequence[str]) -> Arrays:
    simulation = problem.simulation
    if problem.state is not None:
        said = "problem begins at a given state, but must begin at the scene's initial state"
        raise InputError(f"{said}, as certificates also vary initial positions and velocities.")
    values = ParameterSpace(simulation, problem.steps).defaults()
    for view, other in simulation.known.views.items():
        parameter = simulation.known[view]
        led = other == "gravity" and simulation.scene.schedule.leads_gravity
        if parameter.present(simulation.scene) and not led:
            values[view] = parameter.value(simulation)
    if not isinstance(parameters, (Mapping, Sequence)) or isinstance(parameters, (str, bytes)):
        raise InputError(f"parameters is {shown(parameters)}, but must be values by name, or a list of names.")
    known = ", ".join(values)
    if isinstance(parameters, Mapping):
        values = dict(parameters)
    unknown = [name for name in parameters if not isinstance(name, str) or name not in values]
    if unknown:
        raise InputError(f"parameter {shown(unknown[0])} is unknown, but must be one of {known}.")
    if not parameters:
        raise InputError(f"parameters is empty, but must have at least one of {known}.")
    found = ParameterSpace(simulation, problem.steps).checked({name: values[name] for name in parameters})
    for name, value in found.items():
        if not _moves_both_ways(simulation.known[name], value):
            raise InputError(f"parameter {name} is 0, but must be above 0: certify increases and decreases {name}.")
    return found


def everything(problem: Problem, chosen: Arrays) -> Arrays:
    """Return the values of all parameters that affect the run and can be both increased and decreased."""
    values = {**ParameterSpace(problem.simulation, problem.steps).defaults(), **chosen}
    found = {}
    for name, value in values.items():
        parameter = problem.simulation.known[name]
        over_time = parameter.axis is Axis.STEP
        replaced = any(view in chosen and name == other for view, other in problem.simulation.known.views.items())
        idle = replaced or (over_time and problem.steps == 0) or not _moves_both_ways(parameter, value)
        if not idle and parameter.acts(problem.simulation, values):
            row = value.shape[value.ndim - parameter.rank :]
            found[name] = np.broadcast_to(value, (problem.steps, *row)).copy() if over_time else value
    return found


def _moves_both_ways(parameter: Parameter, value: np.ndarray) -> bool:
    return parameter.range is not Range.NOT_NEGATIVE or bool((value > 0.0).all())


def scales(problem: Problem, values: Arrays, perturbation: float = PERTURBATION) -> Arrays:
    """Return the size of a meaningful perturbation of each parameter, in the shape and unit of the parameter."""
    known = problem.simulation.known
    sizes = {name: perturbation * known[name].change(problem.simulation, value) for name, value in values.items()}
    return {name: np.broadcast_to(size, values[name].shape) for name, size in sizes.items()}


def directions(values: Arrays, sizes: Arrays, random: np.random.Generator) -> Arrays:
    """Return a random direction of the given size for each parameter. A scalar has a positive direction."""
    drawn = {name: random.standard_normal(value.shape) if value.ndim else 1.0 for name, value in values.items()}
    return {name: sizes[name] * part for name, part in drawn.items()}


def coherent_directions(problem: Problem, values: Arrays, sizes: Arrays, random: np.random.Generator) -> Arrays:
    """Return random directions, smooth in space and constant in time. Displacements begin at 0."""
    x = problem.simulation.positions - problem.simulation.positions.mean(axis=0)
    x = x / (np.abs(x).max() or 1.0)
    found = directions(values, sizes, random)
    for name in found:
        parameter = problem.simulation.known[name]
        if parameter.axis not in (Axis.STEP, Axis.PARTICLE):
            continue
        columns = values[name].shape[values[name].ndim - parameter.rank :]
        field = random.standard_normal(columns)
        if parameter.role is Role.STATE:
            field = field + x @ random.standard_normal((x.shape[1], *columns))
        if parameter.grows and values[name].ndim > parameter.rank:
            field = np.multiply.outer(np.arange(1.0, problem.steps + 1.0) / problem.steps, field)
        found[name] = sizes[name] * field
    return found


def growth(norms: np.ndarray, time_step: float) -> float:
    """Return the growth of an adjoint over all backward steps [e-folds], by a line fit to log ``norms``."""
    total = np.hypot(norms[:, 0], norms[:, 1] / max((len(norms) - 1) * time_step, 1e-300))[::-1]
    there = np.flatnonzero(total > 0.0)
    if len(there) < 3:
        return 0.0
    if not np.isfinite(total).all():
        return np.inf
    return float(np.polyfit(there, np.log(total[there]), 1)[0] * (there[-1] - there[0]))


WITHIN = 0.25
"""Greatest relative difference between a useful exact derivative and the finite difference."""
LINEAR = 0.3
"""Relative displacement of neighbours up to which a linear approximation of their forces is good [spacings]."""


@dataclass(frozen=True, repr=False)
class Horizon(ShortRepr):
    """Exact derivatives and finite differences of the loss for a meaningful perturbation of one parameter."""

    parameter: str
    sample_steps: np.ndarray
    """Numbers of steps (sample_steps,) after which the loss is computed."""
    exact: np.ndarray
    """Exact derivatives (sample_steps,) by forward mode."""
    difference: np.ndarray
    """Central differences (sample_steps,) over the full perturbation, or NaN after one of the two runs diverges."""
    strain: np.ndarray
    """First-order change of nearest neighbours' distances by the perturbation (sample_steps,) [spacings]."""

    @property
    def measured(self) -> int:
        """Last of two successive sample steps at which the exact derivative is useful, or 0."""
        good = np.abs(self.exact - self.difference) <= WITHIN * np.maximum.accumulate(np.abs(self.difference))
        there = np.flatnonzero(good & np.append(good[:1], good[:-1]))
        return int(self.sample_steps[there[-1]]) if there.size else 0

    @property
    def reached(self) -> int:
        """Last sample step with a finite difference, or 0."""
        there = np.flatnonzero(~np.isnan(self.difference))
        return int(self.sample_steps[there[-1]]) if there.size else 0

    @property
    def lasts(self) -> bool:
        """True if the exact derivative is useful up to the last step."""
        return self.measured == self.sample_steps[-1]

    @property
    def predicted(self) -> int | None:
        """First sample step at which the strain exceeds `LINEAR`, or None."""
        beyond = np.flatnonzero(self.strain > LINEAR)
        return int(self.sample_steps[beyond[0]]) if beyond.size else None


def horizon(history: LossHistory, values: Arrays, name: str, perturbation: np.ndarray) -> Horizon:
    along, spacing = {name: perturbation}, history.problem.simulation.scene.discretisation.spacing
    _, slopes, strain = history.tangent(values, along)
    difference, _ = history.sides(values, along, 1.0, np.zeros(len(history.sample_steps)))
    return Horizon(name, history.sample_steps, slopes, difference, strain / spacing)


MOST_NUMBERS = 12
"""Greatest number of components of a smoothed gradient. Each component costs two runs per sample."""
SAMPLES = 2
LEAST_COSINE = 0.5
"""Least cosine between a recommended estimator's gradient and the smoothed gradient."""
GOOD_COSINE = 0.95
"""Cosine below which ensemble averages are also tried, although ensemble averages cost ten times as much."""
ESTIMATORS: tuple[GradientEstimator, ...] = (Exact(), AdjointViscosity())
AVERAGES: dict[str, Callable[[dict[str, float]], GradientEstimator]] = {
    "EnsembleMean(spread)": lambda spread: EnsembleMean(spread, seed=1, estimator=AdjointViscosity()),
    "Guided(spread)": lambda spread: Guided(spread, seed=1),
}
"""Ensemble estimators to try, with other random numbers than the smoothed gradient."""


@dataclass(frozen=True)
class Judged:
    estimator: str
    """Python code of the estimator, without the prefix ``gradients.``."""
    cosine: float
    size: float
    """Norm of the gradient divided by the norm of the smoothed gradient."""

    @property
    def merit(self) -> float:
        return self.cosine * min(self.size, 1.0 / self.size) if self.size > 0.0 else 0.0


@dataclass(frozen=True)
class Alignment:
    noise: float
    """Relative standard error of the smoothed gradient."""
    estimators: tuple[Judged, ...]
    spread: Mapping[str, float] = field(default_factory=dict)
    """Standard deviation of the random changes in ensembles, by parameter name."""

    @property
    def best(self) -> Judged | None:
        """Estimator with the greatest merit, except `Exact`. The value is None if all cosines are too small."""
        good = [judged for judged in self.estimators[1:] if judged.cosine > LEAST_COSINE]
        return max(good, key=lambda judged: judged.merit, default=None)


def alignment(problem: Problem, values: Arrays, sizes: Arrays, exact: Arrays) -> Alignment | None:
    """Return None if the parameters have too many components, a run fails, or the smoothed gradient is 0."""
    if sum(value.size for value in values.values()) > MOST_NUMBERS:
        return None
    spread = {name: float(size.mean()) for name, size in sizes.items()}
    try:
        smoothed = RandomizedSmoothing(spread, SAMPLES).estimate(problem, values)
    except NO_RUN:
        return None

    def numbers(gradient: Arrays) -> np.ndarray:
        return np.concatenate([spread[name] * gradient[name].ravel() for name in values])

    reference, error = numbers(smoothed.gradient), numbers(smoothed.standard_error or {})
    length = float(np.linalg.norm(reference))

    def judged(name: str, estimator: GradientEstimator) -> Judged:
        gradient = numbers(exact if estimator == Exact() else problem.estimate(values, estimator).gradient)
        size = float(np.linalg.norm(gradient))
        cosine = float(gradient @ reference) / (size * length) if 0.0 < size < np.inf else 0.0
        return Judged(name, cosine, size / length)

    if not length > 0.0:
        return None
    found = [judged(f"{type(estimator).__name__}()", estimator) for estimator in ESTIMATORS]
    if max(one.cosine for one in found) < GOOD_COSINE:
        with suppress(*NO_RUN):
            found += [judged(name, make(spread)) for name, make in AVERAGES.items()]
    return Alignment(float(np.linalg.norm(error)) / length, tuple(found), spread)
