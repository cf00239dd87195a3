"""`cortado.optimise`: lower the loss of a problem, with a history, bounds, and a checkpoint to resume from.

The optimiser sees one vector; this module ravels the named parameters into it, keeps the replay log, and gives the best
parameters back.
"""

import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cortado.arrays import as_numbers, as_one_number, is_whole, require_function
from cortado.errors import ComputationError, DivergedError, InputError, shown
from cortado.executors.executor import InProcess
from cortado.gradients.points import evaluated
from cortado.io.input_files import as_path
from cortado.optimisation.differentiable import Differentiable, LossFunction, as_differentiable, loss_and_gradient
from cortado.optimisation.evaluate import Daring
from cortado.optimisation.named_optimisers import as_optimiser
from cortado.optimisation.replay_log import Evaluation, Log, MemoryLog, ParameterLayout, ReplayLog, Vector
from cortado.optimisation.result import Parameters, Record, Result
from cortado.optimisation.search import Optimiser, Search

GREATEST_GRADIENT = 1e150
# Components beyond it are refused like infinite ones: their squares, which optimisers take, overflow.
FEW = 6
# Numbers of all parameters that a sentence names at most.
REFUSED = (DivergedError, InputError)
# A trial with one of these is infinitely bad: the start had none, so the search has gone too far.


def optimise(
    problem: Differentiable | LossFunction,
    start: Mapping[str, Any],
    optimiser: Optimiser | str,
    iterations: int,
    bounds: Mapping[str, tuple[Any, Any]] | None = None,
    gradient: Any = None,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
    on_iteration: Callable[[Record], None] | None = None,
    **settings: Any,
) -> Result:
    """Lower the loss of a problem, from a start; `cortado.optimize` is the same.

    Parameters:
        problem: a `Problem`, or any object with `value_and_gradient`, or a function that takes the parameters by name
            and returns the loss and its gradient, `{"gravity": array of the parameter's shape}`.
        start: numbers or arrays of any shape by name; they are optimised together, in float64.
        optimiser: such as `cortado.optimisers.Adam(learning_rate=0.1)`; or "adam", "gradient_descent", "lbfgs" or
            "line_search", with its settings as keywords:
            `optimise(problem, start, "adam", learning_rate=0.1, iterations=50)`.
        iterations: greatest number of updates. Adam and gradient descent evaluate once more, to judge the
            last iterate.
        bounds: by name, (lower, upper), each a number, an array of the parameter's shape, or None.
        gradient: how the problem is differentiated, handed to it as it is.
        checkpoint: folder for the replay log, in which each evaluation is on the disk before the next begins.
        resume: go on with the run in `checkpoint`, bit for bit as if it had not been interrupted; begin it if
            there is none. `iterations` may then be another number.
        on_iteration: called with the `Record` of every evaluation, also of each one read from the checkpoint.
            The line search of L-BFGS may evaluate several times an iteration; all of them are recorded. The losses
            that `LineSearch` tries are in the checkpoint alone.

    Raises InputError for a start, bounds or settings that do not fit, and for a checkpoint of another run;
    ComputationError if the loss or its gradient is not finite; what came before is in the checkpoint.
    """
    if checkpoint is not None:
        checkpoint = as_path("checkpoint", checkpoint)
    require_function("on_iteration", on_iteration)
    algorithm, differentiable = as_optimiser(optimiser, settings), as_differentiable(problem)
    values = _checked_start(start)
    layout = ParameterLayout.of(values)
    vector = layout.ravel(values)
    lower, upper = _checked_bounds({} if bounds is None else bounds, layout)
    _require_within(vector, lower, upper, layout)
    algorithm.check(layout)
    _require_count(iterations)
    identity = {
        "optimiser": _description(algorithm),
        "gradient": _description(gradient),
        "problem": str(getattr(differentiable, "fingerprint", "")),
    }
    with closing(_open_log(checkpoint, resume, layout, identity)) as log:
        evaluator = _Evaluator(differentiable, gradient, layout, start, log, on_iteration)
        search = Search(evaluator, evaluator.losses, layout, vector, lower, upper, iterations, evaluator.count_update)
        outcome = algorithm.minimise(search)
    best = min(evaluator.history, key=lambda record: record.loss)
    return Result(
        parameters=_copied(best.parameters),
        loss=best.loss,
        last_parameters=_as_given(layout.unravel(outcome.last), start),
        history=tuple(evaluator.history),
        updates=evaluator.updates,
        evaluations=len(evaluator.history),
        message=outcome.message,
        converged=outcome.converged,
        problem=problem if hasattr(problem, "simulation") else None,
    )


optimize = optimise
"""The same, for those who spell it so."""


@dataclass
class _Evaluator:
    """The function of one vector that the optimiser sees; replays the log, then computes and adds to it."""

    problem: Differentiable
    estimator: Any
    layout: ParameterLayout
    start: Mapping[str, Any]
    log: Log
    on_iteration: Callable[[Record], None] | None
    history: list[Record] = field(default_factory=list)
    updates: int = 0
    """Made by the optimiser so far."""
    logged: int = 0
    """Entries of the log that this run has come to: evaluations, and losses that were tried."""

    def count_update(self) -> None:
        """Called by the optimiser after each update."""
        self.updates += 1

    def __call__(self, vector: Vector) -> tuple[float, Vector]:
        """The loss and its gradient (size,) at a vector (size,)."""
        replayed = self.logged < len(self.log)
        evaluation = self._replay(vector) if replayed else self._compute(vector)
        self.logged += 1
        record = Record(
            iteration=len(self.history),
            updates=self.updates,
            loss=evaluation.loss,
            gradient_norm=math.sqrt(np.sum(evaluation.gradient**2)),
            parameters=_as_given(self.layout.unravel(vector), self.start),
            replayed=replayed,
        )
        self.history.append(record)
        if self.on_iteration is not None:
            self.on_iteration(record)
        return evaluation.loss, evaluation.gradient.copy()

    def losses(self, vectors: Sequence[Vector]) -> list[float]:
        """The losses at vectors (size,), computed in one launch if the problem can; infinite for a run that diverges,
        and for parameters that cannot be. They are in the log, with a gradient of 0, and not in the history."""
        known = [self._replay(vector, k).loss for k, vector in enumerate(vectors[: len(self.log) - self.logged])]
        left = vectors[len(known) :]
        found: list[float] = []

        def keep(loss: Any) -> None:
            number = as_one_number("The problem's loss", loss)
            self.log.append(Evaluation(left[len(found)].copy(), number, np.zeros_like(left[0])))
            found.append(number)

        points, problem = [self.layout.unravel(vector) for vector in left], self.problem
        if callable(getattr(problem, "value", None)):
            made: Any = problem
            trials = [Daring(point, errors=REFUSED) for point in points]
            evaluated(made, trials, InProcess(), on_result=lambda _, one: keep(one.loss))
        else:
            for point in points:
                keep(self._loss(point))
        self.logged += len(vectors)
        return [loss if math.isfinite(loss) else math.inf for loss in (*known, *found)]

    def _loss(self, parameters: dict[str, Any]) -> Any:
        """The loss of a problem that always computes its gradient too."""
        try:
            return self._evaluated(parameters)[0]
        except REFUSED:
            return math.inf

    def _evaluated(self, parameters: dict[str, Any]) -> tuple[Any, Mapping[str, Any]]:
        """The loss and its gradient, as the problem returns them."""
        return loss_and_gradient(self.problem.value_and_gradient(parameters, gradient=self.estimator))

    def _replay(self, vector: Vector, ahead: int = 0) -> Evaluation:
        """The logged evaluation, or the one so many ahead of it, if it is the one asked for."""
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

    def _compute(self, vector: Vector) -> Evaluation:
        """Evaluate the problem, and keep the evaluation if it is finite.

        A first evaluation that is refused has a wrong start; later ones, parameters to which the search has come.
        """
        try:
            loss, gradients = self._evaluated(self.layout.unravel(vector))
        except InputError as error:
            if not self.history:
                raise
            raise ComputationError(
                f"In evaluation {len(self.history)} the search came to parameters that cannot be: {error} Try a "
                f"smaller learning rate, or bounds on the parameters. The {len(self.history)} evaluations before "
                f"{self.log.fate}."
            ) from error
        except DivergedError as error:
            if not self.history:
                raise
            raise error.with_advice(self._shorter(error.advice, vector)) from error
        evaluation = Evaluation(vector.copy(), as_one_number("The problem's loss", loss), self._ravelled(gradients))
        self._require_finite(evaluation)
        self.log.append(evaluation)
        return evaluation

    def _shorter(self, advice: str, vector: Vector) -> str:
        """The advice of a run that diverged during a search, with where the search had come to, and the best before."""
        best = min(self.history, key=lambda record: record.loss)
        told = [f"{advice}, a smaller learning rate or scale, or bounds on the parameters"]
        least = f"the least loss before is {best.loss:.4g}"
        if vector.size <= FEW:
            told.append(f"the search had come to {_in_words(self.layout.unravel(vector))}")
            least = f"{least} at {_in_words(best.parameters)}"
        return "; ".join([*told, least])

    def _ravelled(self, gradients: Mapping[str, Any]) -> Vector:
        """The gradient as one vector, after a check of its names and shapes."""
        wanted = dict(zip(self.layout.names, self.layout.shapes, strict=True))
        found = {name: np.shape(gradient) for name, gradient in gradients.items()}
        if found != wanted:
            raise InputError(
                f"The problem gave gradients of shapes {found} for parameters of shapes {wanted}; a gradient "
                "has the names and the shapes of the parameters."
            )
        return self.layout.ravel({name: as_numbers(f"The gradient of '{name}'", gradients[name]) for name in wanted})

    def _require_finite(self, evaluation: Evaluation) -> None:
        """Raise ComputationError, with advice, if an evaluation cannot be used."""
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
        """The parameters to which the marked components (size,) of the vector belong, for a message."""
        marked = self.layout.unravel(components.astype(np.float64))
        return ", ".join(f"'{name}'" for name, marks in marked.items() if marks.any())


def _open_log(
    checkpoint: str | os.PathLike[str] | None, resume: bool, layout: ParameterLayout, settings: Mapping[str, str]
) -> Log:
    """The replay log on disk, or in memory if there is no checkpoint."""
    if checkpoint is not None:
        return ReplayLog(checkpoint, layout, settings, resume)
    if resume:
        raise InputError("resume=True needs the checkpoint folder of the run to resume; give checkpoint=...")
    return MemoryLog()


def _description(setting: object) -> str:
    """The repr of a setting, without the address that a plain object shows in it."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(setting))


def _checked_start(start: Mapping[str, Any]) -> dict[str, Vector]:
    """The start as float64 arrays, or InputError if there is a parameter that cannot be optimised."""
    if not isinstance(start, Mapping):
        raise InputError(f"The start is {shown(start)}, but must name its parameters, as {{'gravity': value}} does.")
    if not start:
        raise InputError("The start names no parameter to optimise; give one or more, as {'gravity': value}.")
    return {name: _checked_value(f"The start of '{name}'", value) for name, value in start.items()}


def _checked_value(what: str, value: Any) -> Vector:
    """A value as a float64 array, or InputError if it is not made of finite numbers."""
    array = as_numbers(what, value).copy()
    if array.size == 0:
        raise InputError(f"{what} has shape {array.shape}, but must have at least one number.")
    if not np.isfinite(array).all():
        raise InputError(f"{what} has components that are not finite; start from finite numbers.")
    return array


def _checked_bounds(bounds: Mapping[str, tuple[Any, Any]], layout: ParameterLayout) -> tuple[Vector, Vector]:
    """Lower and upper bounds as vectors (size,), or InputError if they do not fit the parameters."""
    if not isinstance(bounds, Mapping):
        raise InputError(f"bounds is {shown(bounds)}, but must be by name, as {{'gravity': (lower, upper)}}.")
    unknown = sorted(set(bounds) - set(layout.names), key=str)
    if unknown:
        raise InputError(
            f"Bounds are given for {', '.join(map(repr, unknown))}, which the start does not name; the "
            f"optimised parameters are {', '.join(map(repr, layout.names))}."
        )
    shapes = dict(zip(layout.names, layout.shapes, strict=True))
    sides = {name: _checked_pair(name, bounds.get(name, (None, None)), shapes[name]) for name in shapes}
    lower = layout.ravel({name: pair[0] for name, pair in sides.items()})
    upper = layout.ravel({name: pair[1] for name, pair in sides.items()})
    return lower, upper


def _checked_pair(name: str, pair: tuple[Any, Any], shape: tuple[int, ...]) -> tuple[Vector, Vector]:
    """The lower and upper bound of one parameter, each of its shape, infinite where there is none."""
    try:
        lower, upper = pair
        low = as_numbers(f"The lower bound of '{name}'", -np.inf if lower is None else lower)
        high = as_numbers(f"The upper bound of '{name}'", np.inf if upper is None else upper)
        low, high = np.broadcast_to(low, shape), np.broadcast_to(high, shape)
    except (TypeError, ValueError):
        raise InputError(
            f"The bounds of '{name}' must be (lower, upper), each None, a number or an array of shape "
            f"{shape}, not {pair!r}."
        ) from None
    if not (low <= high).all():
        raise InputError(f"The lower bound of '{name}' must not exceed the upper one; neither may be NaN.")
    return low, high


def _require_within(vector: Vector, lower: Vector, upper: Vector, layout: ParameterLayout) -> None:
    """Raise InputError if the start is outside of the bounds."""
    outside = layout.unravel(((vector < lower) | (vector > upper)).astype(np.float64))
    for name, marks in outside.items():
        if marks.any():
            raise InputError(
                f"The start of '{name}' is outside of its bounds in {int(marks.sum())} of {marks.size} "
                "components; start within the bounds, or widen them."
            )


def _require_count(iterations: int) -> None:
    """Raise InputError unless the number of iterations is a positive integer."""
    if not is_whole(iterations) or iterations < 1:
        raise InputError(f"The number of iterations must be an integer of at least 1, not {iterations!r}.")


def _in_words(parameters: Parameters) -> str:
    """Their names and values."""
    found = {name: np.array2string(np.asarray(value), precision=4) for name, value in parameters.items()}
    return ", ".join(f"{name} {' '.join(text.split())}" for name, text in found.items())


def _as_given(parameters: Mapping[str, Vector], start: Mapping[str, Any]) -> Parameters:
    """Parameters with a float wherever the user's start has a number."""
    return {
        name: float(value) if value.ndim == 0 and not isinstance(start[name], np.ndarray) else value
        for name, value in parameters.items()
    }


def _copied(parameters: Parameters) -> Parameters:
    """Parameters that share no array with others."""
    return {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in parameters.items()}
