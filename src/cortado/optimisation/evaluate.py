"""`cortado.evaluate`: a problem at many points that do not depend on one another, such as a population of a search."""

from collections.abc import Iterable, Mapping

import numpy as np

from cortado.arrays import as_one_number, require_function, require_methods, require_table
from cortado.calls import public
from cortado.errors import InputError, shown, warn
from cortado.executors import Executor, InProcess, OnResult, checked_executor
from cortado.gradients import Estimate, GradientEstimator
from cortado.gradients.estimator import NO_RUN, Differentiable, Point, checked_estimator, evaluated, without_runs
from cortado.scene.parameter_values import Values
from cortado.words import counted


@public
def evaluate(
    problem: Differentiable,
    points: Iterable[Values],
    gradient: GradientEstimator | None = None,
    executor: Executor | None = None,
    loss_if_diverged: float | None = None,
    on_result: OnResult | None = None,
) -> list[Estimate]:
    """The loss of a problem at many points, in their order, with the same bits wherever they are computed.

    Parameters:
        problem: a `Problem`, or one in other coordinates (`cortado.optimisation.transforms.Transformed`).
        points: the parameters of each point, by name. They are taken as they are needed.
        gradient: how the gradient is computed at each point, such as `gradients.Exact()`; left out, the ``gradient`` of
            each `Estimate` is empty, and points are run forward only.
        executor: where they are computed, see `cortado.executors`; one after the other in this process if left out.
        loss_if_diverged: the loss of a point that has no run, as it diverges or a parameter is out of its range, such
            as infinity for a search that leaves it aside. Left out, it is NaN, and a `CortadoWarning` says how many
            such points there are, and what became of the first of them. The gradient of such a point is NaN, and its
            `Estimate.diverged` has the error.
        on_result: called with the number of a point and its `Estimate` as they arrive, in whatever order.

    Raises the error of the first point that has another one; and that of the first point where no point has a run,
    unless they are given a loss.
    """
    require_function("on_result", on_result, "the number of a point", "its Estimate")
    require_methods("problem", problem, ("value",), "a cortado.Problem")
    if not isinstance(points, Iterable) or isinstance(points, (str, bytes, Mapping)):
        raise InputError(f"points is {shown(points)}, but must be a list of parameters by name.")
    if loss_if_diverged is not None:
        loss_if_diverged = as_one_number("loss_if_diverged", loss_if_diverged)
    chosen = checked_executor(InProcess() if executor is None else executor)
    estimator = None if gradient is None else checked_estimator(gradient)
    loss = np.nan if loss_if_diverged is None else loss_if_diverged
    made = (Point(_by_name(values), estimator, loss, NO_RUN) for values in points)
    found = evaluated(problem, made, chosen, on_result=on_result)
    lost = {number: one.diverged for number, one in enumerate(found) if one.diverged is not None}
    if lost and loss_if_diverged is None:
        first, error = next(iter(lost.items()))
        if len(lost) == len(found):
            raise error
        said = without_runs([*lost.values()], counted(len(found), "point"))
        sentence = f"{said}, and their losses are NaN. The first of them is point {first}: {error}"
        warn(sentence)
    return found


def _by_name(point: Values) -> Values:
    require_table("a point", point, "{'gravity': value}")
    return point
