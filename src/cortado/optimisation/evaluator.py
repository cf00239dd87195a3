"""The objective function of a search, and a test of whether gradients predict changes of the loss."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np

from cortado.arrays import as_numbers, as_one_number
from cortado.errors import ComputationError, DivergedError, InputError, Words, shown
from cortado.executors import InProcess
from cortado.gradients import Exact
from cortado.gradients.ensembles import Ensemble, LeftOutWarning
from cortado.gradients.estimator import Differentiable, Estimate, Point, evaluated
from cortado.optimisation.optimisers import LineSearch
from cortado.optimisation.search import Log, LoggedEvaluation, ParameterLayout, Search, Vector
from cortado.rollout.rollout import Observer
from cortado.scene.parameter_values import Values

Parameters = dict[str, Any]
"""Parameters by name. A value is a float if the initial value was a number, or else a float64 array."""
GREATEST_GRADIENT = 1e150
"""Greatest gradient component that counts as finite. The square of this number does not overflow."""
REFUSED = (DivergedError, InputError)
"""Errors that give a trial point an infinite loss."""
WRONG = 10.0
"""A gradient counts as wrong if predicted and real changes of the loss differ by more than a factor of `WRONG`."""
FELT = 0.01
"""Changes of the loss below this fraction of the range of all losses are negligible."""
ROUND_OFF = 1e-5
"""Round-off of a float32 loss, relative to the greatest loss. Predicted changes below the round-off are not tested."""
MISLED, FEW = 0.25, 2
"""Least fraction and least number of steps with wrong gradients in a search that counts as misled."""
LEAST = 8


class Optimisable(Protocol):
    """Protocol of problems for `optimise`. A resumed search compares the optional text `fingerprint`."""

    def value_and_gradient(self, parameters: dict[str, Any], gradient: Any = None) -> tuple[float, Mapping[str, Any]]:
        """Return the loss, and its gradient as arrays by parameter name in the shapes of the parameters."""


@dataclass(frozen=True, eq=False)
class Record:
    """An evaluation in the history of an optimisation."""

    iteration: int
    """Index of the evaluation, from 0."""
    updates: int
    """Number of updates before this evaluation. A line search may need several evaluations per update."""
    loss: float
    gradient_norm: float
    """Euclidean norm of the gradient over all parameters."""
    parameters: Parameters
    replayed: bool
    """True if the evaluation comes from the checkpoint."""
    refused: int = 0
    """Number of steps that the search refused before the evaluation, as in `Result.refused`."""
    left_out: int = 0
    """Number of failed runs that ensemble averages ignored so far. Replayed evaluations are not counted."""

    def __repr__(self) -> str:
        return f"Record(iteration {self.iteration}: loss {self.loss:.6g}, gradient norm {self.gradient_norm:.4g})"


@dataclass
class Promises:
    """Predicted and real changes of the loss in each step of a search, to test the gradients.

    The slopes at both ends of a step give two predictions of the change of the loss. The change of a smooth loss is
    close to one prediction, or between both. If the slope changes its sign, the step may cross a minimum and is not
    tested.
    """

    losses: list[float] = field(default_factory=list)
    steps: list[tuple[float, float, float]] = field(default_factory=list, repr=False)
    """Changes of the loss in each step: predicted at the start, predicted at the end, and real."""
    _last: LoggedEvaluation | None = field(default=None, repr=False)
    _best: LoggedEvaluation | None = field(default=None, repr=False)

    def note(self, evaluation: LoggedEvaluation) -> None:
        if self._last is not None:
            step = evaluation.parameters - self._last.parameters
            with np.errstate(over="ignore", invalid="ignore"):
                promised = float(self._last.gradient @ step), float(evaluation.gradient @ step)
            self.steps.append((*promised, evaluation.loss - self._last.loss))
        self.losses.append(evaluation.loss)
        self._last = evaluation
        if self._best is None or evaluation.loss < self._best.loss:
            self._best = evaluation

    def doubt(
        self, search: Search, estimator: object, optimiser: object, converged: bool, is_run: bool
    ) -> tuple[bool, bool, str]:
        """Return True if gradients misled the search, True if the loss stays large, and advice as text."""
        assert self._best is not None
        x, gradient = self._best.parameters, self._best.gradient
        outwards = ((x <= search.lower) & (gradient > 0.0)) | ((x >= search.upper) & (gradient < 0.0))
        names = [name for name, marks in search.layout.unravel(np.where(outwards, 1.0, 0.0)).items() if marks.any()]
        ends = " and ".join(names) + (" is at a bound" if len(names) == 1 else " are at bounds")
        by_direction, is_exact = isinstance(optimiser, LineSearch), estimator is None or isinstance(estimator, Exact)
        first, last, change = np.array(self.steps or np.zeros((0, 3))).T
        least, most = np.minimum(np.abs(first), np.abs(last)), np.maximum(np.abs(first), np.abs(last))
        felt = max(FELT * (max(self.losses) - min(self.losses)), ROUND_OFF * max(map(abs, self.losses)))
        tells = (np.sign(first) == np.sign(last)) & (np.maximum(most, np.abs(change)) > felt)
        along = np.sign(first) * change
        is_wrong = tells & ((along < least / WRONG) | (along > most * WRONG))
        broken, told = int(np.count_nonzero(is_wrong)), int(np.count_nonzero(tells))
        misled = broken >= max(FEW, MISLED * told) and (is_exact or not by_direction)
        best, before = min(self.losses), min(self.losses[: -max(len(self.losses) // 3, 1)], default=np.inf)
        stopped = converged or (len(self.losses) >= LEAST and before - best < FELT * abs(best))
        stays, to_try = not names and best > FELT * self.losses[0] and stopped, ["another start"]
        if misled:
            said = f" The gradient is wrong: in {broken} of {told} tested steps, the loss changed by less than a tenth"
            said += " or by more than ten times of the change that the gradient predicted."
            if is_run and is_exact:
                said += " cortado.certify finds how many steps have useful gradients. For more steps, use the gradient"
                return misled, stays, f"{said} AdjointViscosity() with the optimiser LineSearch, or another start."
            to_try += [] if is_run else ["finite differences, to check the gradient"]
        elif stays:
            said = f" The lowest loss is {best / self.losses[0]:.0%} of the first loss, maybe in a wrong local minimum."
            to_try += ["fewer steps"] if is_run else []
            if is_run and is_exact:
                pair = "the gradient AdjointViscosity() with the optimiser LineSearch"
                said += f" Try {', or '.join(to_try)}; or {pair}, if cortado.certify finds the exact gradient useless."
                return misled, stays, said
        else:
            held = f" {ends}, and the loss falls further beyond: widen the bounds, if wider bounds make sense."
            return misled, stays, held if names else ""
        to_try += [] if by_direction else ["the optimiser LineSearch, which steps over narrow minima"]
        return misled, stays, f"{said} Try {', or '.join(to_try)}."


@dataclass
class Evaluator:
    """The objective function of the optimiser. Logged evaluations are replayed first."""

    problem: Optimisable
    estimator: Any
    layout: ParameterLayout
    start: Mapping[str, Any]
    log: Log
    on_iteration: Callable[[Record], None] | None
    history: list[Record] = field(default_factory=list)
    updates: int = 0
    refused: int = 0
    promises: Promises = field(default_factory=Promises)
    logged: int = 0
    left_out: int = 0

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """Estimate loss and gradient with an ensemble. Only the first estimate with failed runs gives a warning."""
        with warnings.catch_warnings():
            if self.left_out:
                warnings.simplefilter("ignore", LeftOutWarning)
            found: Estimate = self.estimator.estimate(problem, parameters, observe)
        self.left_out += found.left_out
        return found

    def count_update(self) -> None:
        self.updates += 1

    def __call__(self, vector: Vector) -> tuple[float, Vector]:
        found = self.attempt(vector, is_trial=False)
        if found is None:
            said = f"One of the earlier evaluations, which {self.log.fate}, has an infinite loss"
            raise InputError(f"{said}, but this optimiser needs finite losses: give another checkpoint folder.")
        return found

    def attempt(self, vector: Vector, is_trial: bool = True) -> tuple[float, Vector] | None:
        """Return the loss and its gradient. For a failed run, return None and log an infinite loss."""
        replayed = self.logged < len(self.log)
        if replayed:
            evaluation = self._replay(vector)
        else:
            try:
                evaluation = self._computed(vector)
            except REFUSED as error:
                if not is_trial and self.history:
                    raise self._with_advice(error, vector) from error
                if not is_trial:
                    raise
                evaluation = LoggedEvaluation(vector.copy(), math.inf, np.zeros_like(vector))
            self.log.append(evaluation)
        self.logged += 1
        if not math.isfinite(evaluation.loss):
            self.refused += 1
            return None
        record = Record(
            iteration=len(self.history),
            updates=self.updates,
            loss=evaluation.loss,
            gradient_norm=math.sqrt(np.sum(evaluation.gradient**2)),
            parameters=as_given(self.layout.unravel(evaluation.parameters), self.start),
            replayed=replayed,
            refused=self.refused,
            left_out=self.left_out,
        )
        self.history.append(record)
        self.promises.note(evaluation)
        if self.on_iteration is not None:
            self.on_iteration(record)
        return evaluation.loss, evaluation.gradient.copy()

    def losses(self, vectors: Sequence[Vector]) -> list[float]:
        """Return the losses at vectors (size,), infinite for failed runs. The history does not contain the losses."""
        known = [self._replay(vector, k).loss for k, vector in enumerate(vectors[: len(self.log) - self.logged])]
        left = vectors[len(known) :]
        found: list[float] = []

        def keep(loss: Any) -> None:
            number = as_one_number("The problem's loss", loss)
            self.log.append(LoggedEvaluation(left[len(found)].copy(), number, np.zeros_like(left[0])))
            found.append(number)

        problem: Any = self.problem
        if not callable(getattr(problem, "value", None)):  # it always computes its gradient too
            problem = SimpleNamespace(value=lambda point: self._evaluated(point)[0])
        trials = [Point(self.layout.unravel(vector), loss_if_diverged=math.inf, errors=REFUSED) for vector in left]
        evaluated(problem, trials, InProcess(), on_result=lambda _, one: keep(one.loss))
        self.logged += len(vectors)
        return [loss if math.isfinite(loss) else math.inf for loss in (*known, *found)]

    def _evaluated(self, parameters: dict[str, Any]) -> tuple[Any, Mapping[str, Any]]:
        estimator = self if isinstance(self.estimator, Ensemble) else self.estimator
        found: Any = self.problem.value_and_gradient(parameters, gradient=estimator)
        if isinstance(found, tuple | list):
            pair, kind = len(found) == 2, type(found).__name__
            if pair and isinstance(found[1], Mapping):
                return found[0], found[1]
            words = f"a loss and a gradient of type {type(found[1]).__name__}" if pair else f"a {kind} of {len(found)}"
            found = Words(words)
        said = f"problem returned {shown(found)}, but must return two things: the loss, a number"
        raise InputError(f"{said}, and the gradient, a dictionary with an array for each parameter.")

    def _replay(self, vector: Vector, ahead: int = 0) -> LoggedEvaluation:
        """Return evaluation ``self.logged + ahead`` of the log. The logged parameters must equal ``vector``."""
        evaluation = self.log.read(self.logged + ahead)
        changed = vector.view(np.uint64) != evaluation.parameters.view(np.uint64)
        if changed.any():
            found = f"Evaluation {len(self.history)} has another {self._names_of(changed)} now than in the checkpoint"
            why = "the start, bounds, optimiser, machine or number of threads has changed"
            advice = f"repeat the old settings, or give another checkpoint folder. The old evaluations {self.log.fate}"
            raise InputError(f"{found}, because {why}; {advice}.")
        return evaluation

    def _with_advice(self, error: DivergedError | InputError, vector: Vector) -> ComputationError:
        if isinstance(error, InputError):
            said = f"In evaluation {len(self.history)} the search tried impossible parameters: {error}"
            advice = f"bounds on the parameters. The {len(self.history)} earlier evaluations {self.log.fate}"
            return ComputationError(f"{said} Try a smaller learning rate, or {advice}.")
        best = min(self.history, key=lambda record: record.loss)
        told = [f"{error.advice}, a smaller learning rate or scale, or bounds on the parameters"]
        least = f"the lowest earlier loss is {best.loss:.4g}"
        if vector.size <= 6:  # else the sentence is too long
            told.append(f"the search had reached {_in_words(self.layout.unravel(vector))}")
            least = f"{least} at {_in_words(best.parameters)}"
        return error.with_advice("; ".join([*told, least]))

    def _computed(self, vector: Vector) -> LoggedEvaluation:
        loss, gradients = self._evaluated(self.layout.unravel(vector))
        loss = as_one_number("The problem's loss", loss)
        wanted = dict(zip(self.layout.names, self.layout.shapes, strict=True))
        found = {name: np.shape(gradient) for name, gradient in gradients.items()}
        if found != wanted:
            said = f"problem returned gradients of shapes {found} for parameters of shapes {wanted}"
            raise InputError(f"{said}; a gradient must have the names and the shapes of the parameters.")
        gradient = self.layout.ravel({n: as_numbers(f"The gradient of '{n}'", gradients[n]) for n in wanted})
        broken = ~(np.abs(gradient) <= GREATEST_GRADIENT)
        if math.isfinite(loss) and not broken.any():
            return LoggedEvaluation(vector.copy(), loss, gradient)
        what = f"the gradient with respect to {self._names_of(broken)} is not finite or beyond {GREATEST_GRADIENT:g}"
        if not math.isfinite(loss):
            what = f"the loss is {loss} as a function of {self._names_of(np.ones_like(broken))}"
        if not self.history:
            said = f"At the start {what}"
            raise ComputationError(f"{said}; try another start, check the loss function, or take fewer time steps.")
        advice = "try a smaller learning rate, bounds on the parameters, or fewer time steps"
        kept = f"The {len(self.history)} earlier evaluations {self.log.fate}"
        raise ComputationError(f"In evaluation {len(self.history)} {what}; {advice}. {kept}.")

    def _names_of(self, components: np.ndarray) -> str:
        marked = self.layout.unravel(components.astype(np.float64))
        return ", ".join(f"'{name}'" for name, marks in marked.items() if marks.any())


def _in_words(parameters: Parameters) -> str:
    found = {name: np.array2string(np.asarray(value), precision=4) for name, value in parameters.items()}
    return ", ".join(f"{name} {' '.join(text.split())}" for name, text in found.items())


def as_given(parameters: Mapping[str, Vector], start: Mapping[str, Any]) -> Parameters:
    return {
        name: float(value) if value.ndim == 0 and not isinstance(start[name], np.ndarray) else value
        for name, value in parameters.items()
    }
