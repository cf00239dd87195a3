"""`cortado.optimise`: lower the loss of a problem, with a history, bounds, and a checkpoint to resume from.

The optimiser sees one vector; this module ravels the named parameters into it, keeps the replay log, and gives the best
parameters back.
"""

import os
import re
from collections.abc import Callable, Mapping
from contextlib import closing
from typing import Any

import numpy as np

from cortado.arrays import require_function, require_truth
from cortado.calls import public
from cortado.errors import InputError
from cortado.files.input_files import as_path
from cortado.optimisation.differentiable import LossFunction, Optimisable, as_differentiable
from cortado.optimisation.evaluator import Evaluator, as_given
from cortado.optimisation.named_optimisers import as_optimiser
from cortado.optimisation.replay_log import Log, MemoryLog, ParameterLayout, ReplayLog
from cortado.optimisation.result import Parameters, Record, Result
from cortado.optimisation.search import Optimiser, Search
from cortado.optimisation.start import checked_bounds, checked_start, require_count, require_within
from cortado.words import counted


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

    Where the run of an evaluation diverges, or a parameter is out of its range, the step there is refused: Adam and
    gradient descent go half of the way instead, or a quarter, and so on, and keep to shorter steps from then on; the
    line searches take shorter trials. `Result.refused` counts such evaluations, `Result.message` says so, and the
    checkpoint has them. `Result.left_out` counts runs that averages over ensembles left out for the same reasons, of
    which the first time alone is warned.

    Raises InputError for a start, bounds or settings that do not fit, and for a checkpoint of another run;
    DivergedError if the start diverges, or a step that was halved ten times; ComputationError where such a step has a
    parameter out of its range, or if the loss or its gradient is not finite; what came before is in the checkpoint.
    """
    if checkpoint is not None:
        checkpoint = as_path("checkpoint", checkpoint)
    require_function("on_iteration", on_iteration, "a record of the iteration")
    require_truth("resume", resume)
    algorithm, differentiable = as_optimiser(optimiser, settings), as_differentiable(problem)
    values = checked_start(start)
    layout = ParameterLayout.of(values)
    vector = layout.ravel(values)
    lower, upper = checked_bounds({} if bounds is None else bounds, layout)
    require_within(vector, lower, upper, layout)
    algorithm.check(layout)
    require_count(iterations)
    identity = {
        "optimiser": _description(algorithm),
        "gradient": _description(gradient),
        "problem": str(getattr(differentiable, "fingerprint", "")),
    }
    with closing(_open_log(checkpoint, resume, layout, identity)) as log:
        evaluator = Evaluator(differentiable, gradient, layout, start, log, on_iteration)
        search = Search(
            evaluate=evaluator,
            attempt=evaluator.attempt,
            losses=evaluator.losses,
            layout=layout,
            start=vector,
            lower=lower,
            upper=upper,
            iterations=iterations,
            updated=evaluator.count_update,
        )
        outcome = algorithm.minimise(search)
    best, is_run = min(evaluator.history, key=lambda record: record.loss), hasattr(problem, "simulation")
    held = evaluator.promises.held(lower, upper, layout)
    doubt = evaluator.promises.doubt(gradient, algorithm, outcome.converged, is_run, held)
    ended = outcome.message.replace(" converged ", " ended ") if doubt.misled else outcome.message
    return Result(
        parameters=_copied(best.parameters),
        loss=best.loss,
        last_parameters=as_given(layout.unravel(outcome.last), start),
        history=tuple(evaluator.history),
        updates=evaluator.updates,
        evaluations=len(evaluator.history),
        refused=evaluator.refused,
        left_out=evaluator.left_out,
        message=ended + doubt.words + _without_runs_in_words(evaluator.refused, evaluator.left_out),
        converged=outcome.converged and not doubt.misled,
        misled=doubt.misled,
        stays=doubt.stays,
        problem=problem if is_run else None,
    )


optimize = optimise
"""The same, for those who spell it so."""


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


def _without_runs_in_words(refused: int, left_out: int) -> str:
    """What to add to the message of a search that refused steps, and whose averages left runs out."""
    why = ["refused " + counted(refused, "step")] * bool(refused)
    why += [f"left {counted(left_out, 'run')} out of its averages"] * bool(left_out)
    return f" It {' and '.join(why)}, as runs diverged or parameters were out of their range." if why else ""


def _copied(parameters: Parameters) -> Parameters:
    """Parameters that share no array with others."""
    return {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in parameters.items()}
