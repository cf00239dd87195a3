"""Search for the parameters with the lowest loss (`optimise`), and compute losses at points (`evaluate`)."""

import os
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cortado import arrays
from cortado.calls import counted, public, sized
from cortado.errors import InputError, shown, warn
from cortado.executors import Executor, InProcess, OnResult, checked_executor
from cortado.files.disk import as_path
from cortado.gradients import Estimate, GradientEstimator
from cortado.gradients.estimator import NO_RUN, Differentiable, Point, checked_estimator, evaluated, without_runs
from cortado.lazy import on_top
from cortado.optimisation.evaluator import Evaluator, Optimisable, Parameters, Record, as_given
from cortado.optimisation.optimisers import as_optimiser
from cortado.optimisation.search import MemoryLog, Optimiser, ParameterLayout, ReplayLog, Search, Vector
from cortado.scene.parameter_values import Values, require_points

LossFunction = Callable[[dict[str, Any]], tuple[Any, Mapping[str, Any]]]
Bounds = Mapping[str, tuple[Any, Any]]
MOST_ITERATIONS = 10_000_000


@dataclass(frozen=True)
class Function:
    function: LossFunction

    @property
    def fingerprint(self) -> str:
        return str(getattr(self.function, "__qualname__", type(self.function).__qualname__))

    def value_and_gradient(self, parameters: dict[str, Any], gradient: Any = None) -> tuple[float, Mapping[str, Any]]:
        if gradient is not None:
            raise InputError("gradient is given, but must be left out, as the function returns its gradient.")
        return self.function(parameters)


def as_differentiable(problem: Any) -> Optimisable:
    if isinstance(problem, type):
        raise InputError(f"problem is the class {problem.__name__}, but must be an instance of the class.")
    if hasattr(problem, "value_and_gradient"):
        return problem
    if callable(problem):
        return Function(problem)
    said = f"problem is {shown(problem)}, but must be a cortado.Problem, an object with value_and_gradient"
    raise InputError(f"{said}, or a function that maps parameters to the loss and its gradient.")


@dataclass(frozen=True, eq=False)
class Result:
    """The best parameters of an optimisation, with its history."""

    parameters: Parameters
    """Parameters with the lowest loss."""
    loss: float
    """Lowest loss."""
    last_parameters: Parameters
    """Parameters after the last update."""
    history: tuple[Record, ...]
    """Records of all evaluations, in order."""
    updates: int
    """Number of updates by the optimiser, including updates that were replayed from the checkpoint."""
    evaluations: int
    """Number of evaluations in the history, including evaluations that were replayed from the checkpoint."""
    message: str
    """Sentence on the end of the search."""
    converged: bool
    """True if the optimiser's convergence test was met and `misled` is false. Only L-BFGS has a convergence test."""
    refused: int = 0
    """Number of steps that were refused because the run diverged or a parameter was out of range. The history does not
    contain refused steps."""
    left_out: int = 0
    """Number of failed runs that ensemble averages ignored. Replayed evaluations are not counted."""
    misled: bool = False
    """True if the gradient disagreed with the change of the loss. Do not trust such a search. `message` gives advice.
    Gradients are often wrong beyond the horizon of `cortado.certify`."""
    stays: bool = False
    """True if the lowest loss is still a large fraction of the first loss, as in a wrong local minimum."""
    problem: Any = field(default=None, repr=False)
    """The optimised `Problem`, for pictures in notebooks. None for another type of problem, and in pickled results."""

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "problem": None}

    def __repr__(self) -> str:
        found = f"loss {self.loss:.6g} after {counted(self.evaluations, 'evaluation')}"
        end = re.split("[,:;.]", self.message)[0]
        return f"Result({sized(self.parameters)}: {found}; {end})"

    def _repr_html_(self) -> str:
        losses, start = [record.loss for record in self.history], self.history[0].parameters
        page: str = on_top("result_page")(self, self.message, self.problem, start, self.parameters, losses)
        return page


def checked_start(start: Mapping[str, Any]) -> dict[str, Vector]:
    if not isinstance(start, Mapping):
        raise InputError(f"The start is {shown(start)}, but must be a dictionary, such as {{'gravity': value}}.")
    if not start:
        raise InputError("The start is empty, but must have one parameter or more, such as {'gravity': value}.")
    found = {name: arrays.as_numbers(f"The start of '{name}'", value).copy() for name, value in start.items()}
    for name, array in found.items():
        if array.size == 0:
            raise InputError(f"The start of '{name}' has shape {array.shape}, but must have at least one number.")
        if not np.isfinite(array).all():
            raise InputError(f"The start of '{name}' has components that are not finite; start from finite numbers.")
    return found


def checked_bounds(bounds: Bounds, start: Mapping[str, Vector]) -> tuple[dict[str, Vector], dict[str, Vector]]:
    """Return lower and upper bounds by name, in the shapes of the parameters. Missing bounds are infinite."""
    if not isinstance(bounds, Mapping):
        raise InputError(f"bounds is {shown(bounds)}, but must be a dictionary of pairs (lower, upper).")
    if unknown := sorted(set(bounds) - set(start), key=str):
        said = f"Bounds are given for {', '.join(map(repr, unknown))}"
        raise InputError(f"{said}, but the start has only the parameters {', '.join(map(repr, start))}.")
    least, most = dict[str, Vector](), dict[str, Vector]()
    for name, value in start.items():
        pair = bounds.get(name, (None, None))
        try:
            lower, upper = pair
            low = arrays.as_numbers(f"The lower bound of '{name}'", -np.inf if lower is None else lower)
            high = arrays.as_numbers(f"The upper bound of '{name}'", np.inf if upper is None else upper)
            low, high = np.broadcast_to(low, value.shape), np.broadcast_to(high, value.shape)
        except (TypeError, ValueError):
            said = f"The bounds of '{name}' are {pair!r}, but must be a pair (lower, upper)"
            raise InputError(f"{said} of numbers, arrays of shape {value.shape}, or None.") from None
        if not (low <= high).all():
            raise InputError(f"The lower bound of '{name}' must not exceed the upper bound, and no bound may be NaN.")
        least[name], most[name] = low, high
    for name, value in start.items():
        outside = (value < least[name]) | (value > most[name])
        if outside.any():
            said = f"{int(outside.sum())} of {outside.size} components: change the start, or widen the bounds"
            raise InputError(f"The start of '{name}' is outside of its bounds in {said}.")
    return least, most


@public
def evaluate(
    problem: Differentiable,
    points: Iterable[Values],
    gradient: GradientEstimator | None = None,
    executor: Executor | None = None,
    loss_if_diverged: float | None = None,
    on_result: OnResult | None = None,
) -> list[Estimate]:
    """Return the losses of a problem, in the order of ``points``. The results do not depend on the executor.

    Args:
        problem: a `Problem`, or a `cortado.optimisation.transforms.Transformed` problem.
        points: the parameters of each point, by name. An iterator is read only as far as needed.
        gradient: estimator of the gradient, such as `gradients.Exact()`. Without an estimator, points are only run
            forward, and the gradient of an `Estimate` is empty.
        executor: see `cortado.executors`. By default points are computed one after the other in this process.
        loss_if_diverged: the loss of a failed point, such as infinity. A point fails if its run diverges or if a
            parameter is out of range. By default the loss is NaN, and a `CortadoWarning` is given.
        on_result: function that is called with the number and the `Estimate` of each computed point, in any order.

    The gradient of a failed point is NaN, and `Estimate.diverged` holds the exception. Any other exception is
    raised. If all points fail, the error of the first point is raised, unless ``loss_if_diverged`` is given.

    Example::

        points = [{"gravity": [0.0, -g]} for g in (9.0, 9.5, 10.0)]
        losses = [found.loss for found in cortado.evaluate(problem, points)]
    """
    arrays.require_function("on_result", on_result, "the number of a point", "its Estimate")
    arrays.require_methods("problem", problem, ("value",), "a cortado.Problem")
    require_points(points, are_read=False)
    if loss_if_diverged is not None:
        loss_if_diverged = arrays.as_one_number("loss_if_diverged", loss_if_diverged)
    chosen = checked_executor(InProcess() if executor is None else executor)
    estimator = None if gradient is None else checked_estimator(gradient)

    def point(values: Values) -> Point:
        arrays.require_table("a point", values, "{'gravity': value}")
        return Point(values, estimator, np.nan if loss_if_diverged is None else loss_if_diverged, NO_RUN)

    found = evaluated(problem, map(point, points), chosen, on_result=on_result)
    lost = {number: one.diverged for number, one in enumerate(found) if one.diverged is not None}
    if lost and loss_if_diverged is None:
        first, error = next(iter(lost.items()))
        if len(lost) == len(found):
            raise error
        said = without_runs([*lost.values()], counted(len(found), "point"))
        warn(f"{said}, and the losses of these points are NaN. The first failed point is point {first}: {error}")
    return found


@public
def optimise(
    problem: Optimisable | LossFunction,
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
    """Lower the loss of a problem, beginning at given parameters. `cortado.optimize` is the same function.

    Args:
        problem: a `Problem`, any object with `value_and_gradient`, or a function. The function takes parameters by name
            and returns the loss and its gradient, ``{"gravity": array of the parameter's shape}``.
        start: first parameters by name, numbers or arrays of any shape. All parameters are optimised
            together in float64.
        optimiser: an object such as `cortado.optimisers.Adam(learning_rate=0.1)`, or one of
            the names "adam", "gradient_descent", "lbfgs" and "line_search", with settings as keywords.
        iterations: greatest number of updates. Adam and gradient descent also evaluate the last iterate.
        bounds: lower and upper bound of each parameter by name. A bound is a number, an array in the shape of the
            parameter, or None.
        gradient: gradient estimator for the problem.
        checkpoint: folder of the replay log. Every evaluation is written to the log before the next one begins.
        resume: continue the run in ``checkpoint``, or begin a new run in an empty folder. A resumed run gives exactly
            the numbers of a run without interruption. The number of ``iterations`` may change.
        on_iteration: function that is called with the `Record` of every evaluation. The function is
            also called for evaluations from the checkpoint, but not for the trials of `LineSearch`.
        settings: settings of a named optimiser, as in
            ``optimise(problem, start, "adam", learning_rate=0.1, iterations=50)``.

    A step is refused if its run diverges or if a parameter is out of range. After a refusal, the optimiser takes a
    shorter step. Adam and gradient descent also shorten all later steps. `Result.refused` counts the refused steps.
    `Result.message` and the checkpoint also contain the refused steps.

    Raises InputError for unsuitable ``start``, ``bounds`` or settings, and for a checkpoint of another run. Raises
    DivergedError if the run at the start diverges, or after a step was halved ten times. Raises ComputationError if a
    parameter is out of range after ten halvings, or if the loss or gradient is not finite. Earlier evaluations stay in
    the checkpoint.

    Example::

        result = cortado.optimise(problem, {"gravity": [0.0, -9.0]}, "lbfgs", iterations=10)
        print(result.parameters["gravity"], result.message)
    """
    if checkpoint is not None:
        checkpoint = as_path("checkpoint", checkpoint)
    arrays.require_function("on_iteration", on_iteration, "a record of the iteration")
    arrays.require_truth("resume", resume)
    algorithm, differentiable = as_optimiser(optimiser, settings), as_differentiable(problem)
    values = checked_start(start)
    layout = ParameterLayout(tuple(values), tuple(array.shape for array in values.values()))
    lower, upper = map(layout.ravel, checked_bounds({} if bounds is None else bounds, values))
    algorithm.check(layout)
    if not arrays.is_whole(iterations) or not 1 <= iterations <= MOST_ITERATIONS:
        wanted = f"an integer of at least 1 and at most {MOST_ITERATIONS:,}"
        raise InputError(f"The number of iterations must be {wanted}, not {shown(iterations)}.")
    identity = {"optimiser": repr(algorithm), "gradient": repr(gradient)}
    identity = {what: re.sub(r" at 0x[0-9a-fA-F]+", "", text) for what, text in identity.items()}
    identity["problem"] = str(getattr(differentiable, "fingerprint", ""))
    if resume and checkpoint is None:
        raise InputError("resume=True needs the checkpoint folder of the run to resume; give checkpoint=...")
    with closing(MemoryLog() if checkpoint is None else ReplayLog(checkpoint, layout, identity, resume)) as log:
        evaluator = Evaluator(differentiable, gradient, layout, start, log, on_iteration)
        functions = evaluator, evaluator.attempt, evaluator.losses
        search = Search(*functions, layout, layout.ravel(values), lower, upper, iterations, evaluator.count_update)
        outcome = algorithm.minimise(search)
    why = ["refused " + counted(evaluator.refused, "step")] * bool(evaluator.refused)
    why += [f"left {counted(evaluator.left_out, 'run')} out of its averages"] * bool(evaluator.left_out)
    lost = f" It {' and '.join(why)}, as runs diverged or parameters were out of their range." if why else ""
    best, is_run = min(evaluator.history, key=lambda record: record.loss), hasattr(problem, "simulation")
    misled, stays, doubts = evaluator.promises.doubt(search, gradient, algorithm, outcome.converged, is_run)
    ended = outcome.message.replace(" converged ", " ended ") if misled else outcome.message
    return Result(
        parameters={name: a.copy() if isinstance(a, np.ndarray) else a for name, a in best.parameters.items()},
        loss=best.loss,
        last_parameters=as_given(layout.unravel(outcome.last), start),
        history=tuple(evaluator.history),
        updates=evaluator.updates,
        evaluations=len(evaluator.history),
        refused=evaluator.refused,
        left_out=evaluator.left_out,
        message=ended + doubts + lost,
        converged=outcome.converged and not misled,
        misled=misled,
        stays=stays,
        problem=problem if is_run else None,
    )


optimize = optimise
"""American spelling of `optimise`."""
