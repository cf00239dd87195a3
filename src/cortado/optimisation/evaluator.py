"""The problem of a search as a function of the optimiser's vector, and a test if gradients predict changes of the
loss."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from cortado.arrays import as_numbers, as_one_number
from cortado.errors import ComputationError, DivergedError, InputError, Words, shown
from cortado.executors import InProcess
from cortado.gradients import Exact
from cortado.gradients.ensembles import Ensemble, LeftOutWarning
from cortado.gradients.estimator import Differentiable, Estimate, Point, evaluated
from cortado.optimisation.optimisers import LineSearch
from cortado.optimisation.search import Log, LoggedEvaluation, ParameterLayout, Vector
from cortado.rollout.rollout import Observer
from cortado.scene.parameter_values import Values

Parameters = dict[str, Any]
"""Parameters by name: floats for numbers at the start, otherwise float64 arrays."""
GREATEST_GRADIENT = 1e150
"""Greatest gradient component that counts as finite, because optimisers compute squares."""
REFUSED = (DivergedError, InputError)
"""Errors after which a trial has an infinite loss."""
WRONG = 10.0
"""A step contradicts its gradients if the change of the loss differs from the predictions by more than this factor."""
FELT = 0.01
"""Greatest change of the loss, relative to the range of all losses, that counts as none."""
ROUND_OFF = 1e-5
"""Predictions below this part of the greatest loss are not tested, because float32 losses are not precise enough."""
MISLED, FEW = 0.25, 2
"""A search is misled if at least this fraction of the tested steps, and at least this number, contradict their
gradients."""
LEAST = 8
"""Least number of evaluations of a search whose loss has stopped falling."""


class Optimisable(Protocol):
    """Protocol of problems for `optimise`. A text `fingerprint` is optional; resuming a search compares it."""

    def value_and_gradient(self, parameters: dict[str, Any], gradient: Any = None) -> tuple[float, Mapping[str, Any]]:
        """Return the loss and its gradient, arrays by parameter name in the parameters' shapes."""


def loss_and_gradient(returned: Any) -> tuple[Any, Mapping[str, Any]]:
    """Return a result unchanged if it consists of a loss and a gradient by name; raise `InputError` otherwise."""
    pair = isinstance(returned, (tuple, list)) and len(returned) == 2
    if pair and isinstance(returned[1], Mapping):
        return returned[0], returned[1]
    found = returned
    if pair:
        found = Words(f"a loss and a gradient of type {type(returned[1]).__name__}")
    elif isinstance(returned, (tuple, list)):
        found = Words(f"a {type(returned).__name__} of {len(returned)}")
    raise InputError(
        f"What is optimised returned {shown(found)}, but must return two things: the loss, a number, and its gradient, "
        "a dictionary with an array for each parameter by its name."
    )


@dataclass(frozen=True, eq=False)
class Record:
    """An evaluation in the history of an optimisation."""

    iteration: int
    """Index of the evaluation, from 0."""
    updates: int
    """Number of updates before this evaluation; a line search may evaluate several times per update."""
    loss: float
    gradient_norm: float
    """Euclidean norm of the gradient over all parameters."""
    parameters: Parameters
    """Parameters at which the loss was evaluated."""
    replayed: bool
    """True if the evaluation was read from the checkpoint."""
    refused: int = 0
    """Number of refused steps before this evaluation, after which runs diverged or parameters were out of range."""
    left_out: int = 0
    """Number of runs that ensemble averages left out so far, without replayed evaluations."""

    def __repr__(self) -> str:
        return f"Record(iteration {self.iteration}: loss {self.loss:.6g}, gradient norm {self.gradient_norm:.4g})"


@dataclass
class Promises:
    """A test of a search's gradients: predicted and real changes of the loss from each evaluation to the next.

    The change of a smooth loss is near the predictions by the slopes at both ends of a step, or between them. Steps
    along which the slope changes sign are not tested, because they may cross a minimum.
    """

    losses: list[float] = field(default_factory=list)
    steps: list[tuple[float, float, float]] = field(default_factory=list, repr=False)
    """For each step: the change predicted at its start, the change predicted at its end, and the real change."""
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

    def held(self, lower: Vector, upper: Vector, layout: ParameterLayout) -> str:
        """Return a sentence about parameters whose bounds prevent a lower loss, or an empty string."""
        if self._best is None:
            return ""
        best, gradient = self._best.parameters, self._best.gradient
        outwards = ((best <= lower) & (gradient > 0.0)) | ((best >= upper) & (gradient < 0.0))
        names = [name for name, marks in layout.unravel(np.where(outwards, 1.0, 0.0)).items() if marks.any()]
        found = " and ".join(names) + (" is at a bound" if len(names) == 1 else " are at bounds")
        return f" {found}, beyond which the loss falls further: widen them, if that makes sense." if names else ""

    @property
    def kept(self) -> tuple[int, int]:
        """Return the number of steps that contradict their gradients, and of all tested steps."""
        first, last, change = np.array(self.steps or np.zeros((0, 3))).T
        least, most = np.minimum(np.abs(first), np.abs(last)), np.maximum(np.abs(first), np.abs(last))
        felt = max(FELT * (max(self.losses) - min(self.losses)), ROUND_OFF * max(map(abs, self.losses)))
        tells = (np.sign(first) == np.sign(last)) & (np.maximum(most, np.abs(change)) > felt)
        along = np.sign(first) * change
        broken = (along < least / WRONG) | (along > most * WRONG)
        return int(np.count_nonzero(tells & broken)), int(np.count_nonzero(tells))

    @property
    def misled(self) -> bool:
        broken, told = self.kept
        return broken >= max(FEW, MISLED * told)

    def stays(self, converged: bool) -> bool:
        """Return True if the loss has stopped falling at a large part of the first loss: it fell by less than `FELT`
        over the last third of the evaluations."""
        best, before = min(self.losses), min(self.losses[: -max(len(self.losses) // 3, 1)], default=np.inf)
        stopped = len(self.losses) >= LEAST and before - best < FELT * abs(best)
        return best > FELT * self.losses[0] and (converged or stopped)

    def doubt(self, estimator: object, optimiser: object, converged: bool, is_run: bool, held: str = "") -> "Doubt":
        """Judge a search. ``estimator``: None for the problem's gradient; ``converged``: the optimiser's test was met;
        ``is_run``: the loss is of a simulation's run; ``held``: sentence of `held`."""
        by_direction, is_exact = isinstance(optimiser, LineSearch), estimator is None or isinstance(estimator, Exact)
        misled, stays = self.misled and (is_exact or not by_direction), not held and self.stays(converged)
        to_try = ["another start"]
        if misled:
            broken, told = self.kept
            said = f" The gradient disagrees with what steps did: in {broken} of {told} that tell, the loss changed by"
            said += " less than a tenth of what it promised, or by more than ten times as much."
            if is_run and is_exact:
                said += " certify says up to which step of the run it is of use; beyond that, search with the gradient"
                return Doubt(misled, stays, f"{said} AdjointViscosity() and the optimiser LineSearch, or elsewhere.")
            to_try += [] if is_run else ["differences, to check it"]
        elif stays:
            said = f" The loss has stayed at {min(self.losses) / self.losses[0]:.0%} of the first one, maybe in a wrong"
            said += " valley."
            to_try += ["fewer steps"] if is_run else []
            if is_run and is_exact:
                pair = "the gradient AdjointViscosity() with the optimiser LineSearch"
                said += f" Try {', or '.join(to_try)}; or {pair}, where certify says that the exact one is of no use."
                return Doubt(misled, stays, said)
        else:
            return Doubt(misled, stays, held)
        to_try += [] if by_direction else ["the optimiser LineSearch, which steps over dents"]
        return Doubt(misled, stays, f"{said} Try {', or '.join(to_try)}.")


@dataclass(frozen=True)
class Doubt:
    """The verdict on a search; ``words``: sentences of doubt with advice, empty without doubts."""

    misled: bool
    stays: bool
    words: str


@dataclass
class CountedEnsemble:
    """An `Ensemble` for a search, which counts the runs that averages leave out, and warns only the first time."""

    ensemble: Any
    left_out: int = 0

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        with warnings.catch_warnings():
            if self.left_out:
                warnings.simplefilter("ignore", LeftOutWarning)
            found = self.ensemble.estimate(problem, parameters, observe)
        self.left_out += found.left_out
        return found


@dataclass
class Evaluator:
    """The optimiser's function of a vector, which first replays the log, and later computes and appends to the log."""

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

    def __post_init__(self) -> None:
        if isinstance(self.estimator, Ensemble):
            self.estimator = CountedEnsemble(self.estimator)

    @property
    def left_out(self) -> int:
        return self.estimator.left_out if isinstance(self.estimator, CountedEnsemble) else 0

    def count_update(self) -> None:
        self.updates += 1

    def __call__(self, vector: Vector) -> tuple[float, Vector]:
        """Return the loss and its gradient (size,) at a vector (size,)."""
        if self.logged < len(self.log):
            return self._noted(self._replay(vector), replayed=True)
        return self._noted(self._kept(self._compute(vector)), replayed=False)

    def attempt(self, vector: Vector) -> tuple[float, Vector] | None:
        """Return loss and gradient at a vector; if the run fails, return None, and log an infinite loss and gradient
        0."""
        replayed = self.logged < len(self.log)
        if replayed:
            evaluation = self._replay(vector)
        else:
            try:
                evaluation = self._kept(self._computed(vector))
            except REFUSED:
                evaluation = self._kept(LoggedEvaluation(vector.copy(), math.inf, np.zeros_like(vector)))
        if math.isfinite(evaluation.loss):
            return self._noted(evaluation, replayed)
        self.logged += 1
        self.refused += 1
        return None

    def _kept(self, evaluation: LoggedEvaluation) -> LoggedEvaluation:
        self.log.append(evaluation)
        return evaluation

    def _noted(self, evaluation: LoggedEvaluation, replayed: bool) -> tuple[float, Vector]:
        self.logged += 1
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
        """Return the losses at vectors (size,), infinite for runs that diverge and parameters out of range. Trial
        losses enter the log with gradient 0, but not the history."""
        known = [self._replay(vector, k).loss for k, vector in enumerate(vectors[: len(self.log) - self.logged])]
        left = vectors[len(known) :]
        found: list[float] = []

        def keep(loss: Any) -> None:
            number = as_one_number("The problem's loss", loss)
            self.log.append(LoggedEvaluation(left[len(found)].copy(), number, np.zeros_like(left[0])))
            found.append(number)

        points, problem = [self.layout.unravel(vector) for vector in left], self.problem
        if callable(getattr(problem, "value", None)):
            made: Any = problem
            trials = [Point(point, loss_if_diverged=math.inf, errors=REFUSED) for point in points]
            evaluated(made, trials, InProcess(), on_result=lambda _, one: keep(one.loss))
        else:  # it always computes its gradient too
            for point in points:
                try:
                    keep(self._evaluated(point)[0])
                except REFUSED:
                    keep(math.inf)
        self.logged += len(vectors)
        return [loss if math.isfinite(loss) else math.inf for loss in (*known, *found)]

    def _evaluated(self, parameters: dict[str, Any]) -> tuple[Any, Mapping[str, Any]]:
        return loss_and_gradient(self.problem.value_and_gradient(parameters, gradient=self.estimator))

    def _replay(self, vector: Vector, ahead: int = 0) -> LoggedEvaluation:
        """Return the next logged evaluation, or an entry further ``ahead``; raise `InputError` if its vector
        differs."""
        evaluation = self.log.read(self.logged + ahead)
        changed = vector.view(np.uint64) != evaluation.parameters.view(np.uint64)
        if changed.any():
            raise InputError(
                f"This run asks for evaluation {len(self.history)} at another {self._names_of(changed)} than "
                "the run being resumed, so that its start, bounds, optimiser, machine or number of "
                "threads differ; give the former ones, or another checkpoint folder. "
                f"The former run's evaluations {self.log.fate}."
            )
        return evaluation

    def _compute(self, vector: Vector) -> LoggedEvaluation:
        """Evaluate the problem; after the first evaluation, errors get advice about the search."""
        try:
            return self._computed(vector)
        except InputError as error:
            if not self.history:
                raise
            raise ComputationError(
                f"In evaluation {len(self.history)} the search tried impossible parameters: {error} Try a "
                f"smaller learning rate, or bounds on the parameters. The {len(self.history)} evaluations before "
                f"{self.log.fate}."
            ) from error
        except DivergedError as error:
            if not self.history:
                raise
            raise error.with_advice(self._shorter(error.advice, vector)) from error

    def _computed(self, vector: Vector) -> LoggedEvaluation:
        loss, gradients = self._evaluated(self.layout.unravel(vector))
        evaluation = LoggedEvaluation(
            vector.copy(), as_one_number("The problem's loss", loss), self._ravelled(gradients)
        )
        self._require_finite(evaluation)
        return evaluation

    def _shorter(self, advice: str, vector: Vector) -> str:
        best = min(self.history, key=lambda record: record.loss)
        told = [f"{advice}, a smaller learning rate or scale, or bounds on the parameters"]
        least = f"the least loss before is {best.loss:.4g}"
        if vector.size <= 6:  # else the sentence is too long
            told.append(f"the search had come to {_in_words(self.layout.unravel(vector))}")
            least = f"{least} at {_in_words(best.parameters)}"
        return "; ".join([*told, least])

    def _ravelled(self, gradients: Mapping[str, Any]) -> Vector:
        """Check names and shapes of a gradient, and return it as a vector (size,)."""
        wanted = dict(zip(self.layout.names, self.layout.shapes, strict=True))
        found = {name: np.shape(gradient) for name, gradient in gradients.items()}
        if found != wanted:
            raise InputError(
                f"The problem gave gradients of shapes {found} for parameters of shapes {wanted}; a gradient "
                "has the names and the shapes of the parameters."
            )
        return self.layout.ravel({name: as_numbers(f"The gradient of '{name}'", gradients[name]) for name in wanted})

    def _require_finite(self, evaluation: LoggedEvaluation) -> None:
        broken = ~(np.abs(evaluation.gradient) <= GREATEST_GRADIENT)
        if math.isfinite(evaluation.loss) and not broken.any():
            return
        if math.isfinite(evaluation.loss):
            what = (
                f"the gradient with respect to {self._names_of(broken)} is not finite or beyond {GREATEST_GRADIENT:g}"
            )
        else:
            names = self._names_of(np.ones_like(broken))
            what = f"the loss is {evaluation.loss} as a function of {names}"
        if not self.history:
            raise ComputationError(
                f"At the start {what}; begin elsewhere, look at the loss, or take a shorter horizon."
            )
        raise ComputationError(
            f"In evaluation {len(self.history)} {what}; try a smaller learning rate, bounds on the "
            f"parameters, or a shorter horizon. The {len(self.history)} evaluations before {self.log.fate}."
        )

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
