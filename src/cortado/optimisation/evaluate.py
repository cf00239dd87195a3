"""`cortado.evaluate`: a problem at many points that do not depend on one another, such as a population of a search."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from cortado.arrays import as_one_number, require_function
from cortado.errors import DivergedError, InputError, shown
from cortado.executors.executor import Executor, InProcess, OnResult, checked_executor
from cortado.gradients import Estimate, GradientEstimator
from cortado.gradients.estimator import Differentiable, checked_estimator
from cortado.gradients.points import Point, evaluated
from cortado.parameters.values import Values
from cortado.rollout import Observer


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
        loss_if_diverged: the loss of a point whose run diverges, such as infinity for a search that then leaves it
            aside; its gradient is not a number. Left out, such a point ends all with a `DivergedError`.
        on_result: called with the number of a point and its `Estimate` as they arrive, in whatever order.

    Raises the error of the first point that has one.
    """
    require_function("on_result", on_result)
    if not callable(getattr(problem, "value", None)):
        raise InputError(f"problem is {shown(problem)}, but must be a cortado.Problem.")
    if not isinstance(points, Iterable) or isinstance(points, (str, bytes, Mapping)):
        raise InputError(f"points is {shown(points)}, but must be a list of parameters by name.")
    if loss_if_diverged is not None:
        loss_if_diverged = as_one_number("loss_if_diverged", loss_if_diverged)
    chosen = checked_executor(InProcess() if executor is None else executor)
    estimator = None if gradient is None else checked_estimator(gradient)
    made = (Point(_by_name(values), estimator) for values in points)
    if loss_if_diverged is not None:
        made = (Daring(point.values, point.estimator, loss_if_diverged) for point in made)
    return evaluated(problem, made, chosen, on_result=on_result)


def _by_name(point: Values) -> Values:
    if not isinstance(point, Mapping):
        raise InputError(f"a point is {shown(point)}, but must be parameters by name, as {{'gravity': value}}.")
    return point


@dataclass(frozen=True)
class Daring(Point):
    """A point that may diverge."""

    loss_if_diverged: float = np.inf
    errors: tuple[type[Exception], ...] = (DivergedError,)
    """Those after which it has this loss."""

    def evaluated(self, problem: Differentiable, observe: Observer | None = None) -> Estimate:
        try:
            return super().evaluated(problem, observe)
        except self.errors:
            names = self.values if self.estimator is not None else ()
            nothing = {name: np.full(np.shape(self.values[name]), np.nan) for name in names}
            return Estimate(self.loss_if_diverged, nothing)
