"""Optimisers: gradient descent, Adam, L-BFGS and a line search.

An optimiser must choose points only from its settings and from earlier losses and gradients, because a resumed search
replays the logged evaluations. Random numbers must come from a seed in the settings.
"""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any

import numpy as np

from cortado.arrays import as_number, is_whole, require_at_most
from cortado.calls import face, keep_own, quoted
from cortado.device.threads import require
from cortado.errors import InputError, shown
from cortado.optimisation.search import Optimiser, Outcome, ParameterLayout, Search, Vector

PerParameter = float | Mapping[str, float]
HALVINGS = 10
"""Greatest number of times that a refused step is halved before the search ends."""
GROWTH = 3.0
"""Longest trial step of the line search, relative to the best step of the previous update."""
SMALL = 0.01
"""Greatest ratio of the last to the first gradient for which L-BFGS reports convergence."""

__all__ = ["LBFGS", "Adam", "GradientDescent", "LineSearch", "Optimiser", "Outcome", "Search"]


def require_positive(name: str, values: PerParameter) -> None:
    for value in values.values() if isinstance(values, Mapping) else [values]:
        number = as_number(value)
        if number is None or number <= 0.0:
            raise InputError(f"{name} must be a positive, finite number, not {shown(value)}.")


def require_fraction(name: str, value: float) -> None:
    number = as_number(value)
    if number is None or not 0.0 <= number < 1.0:
        raise InputError(f"{name} must be a number in [0, 1), not {shown(value)}.")


def require_names(name: str, values: PerParameter, layout: ParameterLayout) -> None:
    if isinstance(values, Mapping) and set(values) != set(layout.names):
        said = f"{name} is given for {quoted(values)}, but the optimised parameters are {quoted(layout.names)}"
        raise InputError(f"{said}; give a number for each optimised parameter, or one number for all.")


class Iterate:
    def __init__(self, search: Search):
        self._search, self.x = search, search.start
        self.loss, self.gradient = search.evaluate(search.start)

    def move(self, target: Vector) -> float:
        """Move to ``target`` (size,), or halve the step until a run succeeds. Return the fraction of the step."""
        self._search.updated()
        part, tried = 1.0, target
        found = self._search.attempt(tried)
        while found is None:
            part /= 2.0
            tried = self._search.project(self.x + part * (target - self.x))
            found = self._search.attempt(tried) if part > 0.5**HALVINGS else self._search.evaluate(tried)
        self.x, (self.loss, self.gradient) = tried, found
        return part

    def outcome(self, name: str) -> Outcome:
        return Outcome(self.x, False, f"{name} made all its {self._search.iterations} updates.")


@dataclass(frozen=True)
class Adam:
    """Adam: steps along the mean of recent gradients, divided by the root mean square of the gradients.

    A step changes a component by at most about the learning rate, for gradients of any size. Every update ends with a
    projection onto the bounds. If the run after a step diverges, Adam halves the step and the learning rate, at most 10
    times, and resets the two means to 0. Adam has no convergence test and makes all iterations.

    Source: D. P. Kingma and J. Ba, "Adam: a method for stochastic optimization", ICLR 2015, Algorithm 1. Raises
    InputError for settings out of range.

    ``learning_rate`` is a number, or one number for each parameter by name [unit of the parameter]. ``beta1`` and
    ``beta2`` are the decay factors of the mean gradient and of the mean squared gradient, in [0, 1) [-]. ``epsilon`` is
    added to the root of the mean squared gradient to avoid a division by 0 [unit of the gradient].

    Example: ``found = cortado.optimise(problem, start, cortado.optimisers.Adam(0.1), iterations=50)``
    """

    learning_rate: PerParameter
    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-8

    def __post_init__(self) -> None:
        require_positive("learning_rate", self.learning_rate)
        keep_own(self, "learning_rate")
        require_fraction("beta1", self.beta1)
        require_fraction("beta2", self.beta2)
        require_positive("epsilon", self.epsilon)

    def check(self, layout: ParameterLayout) -> None:
        require_names("learning_rate", self.learning_rate, layout)

    def minimise(self, search: Search) -> Outcome:
        learning_rate = search.layout.spread(self.learning_rate)
        theta = Iterate(search)
        m, v, t = np.zeros_like(theta.x), np.zeros_like(theta.x), 0
        for _ in range(search.iterations):
            g, t = theta.gradient, t + 1
            m = self.beta1 * m + (1.0 - self.beta1) * g
            v = self.beta2 * v + (1.0 - self.beta2) * g**2
            m_hat = m / (1.0 - self.beta1**t)
            v_hat = v / (1.0 - self.beta2**t)
            new_theta = search.project(theta.x - learning_rate * m_hat / (np.sqrt(v_hat) + self.epsilon))
            part = theta.move(new_theta)
            if part < 1.0:
                learning_rate, m, v, t = part * learning_rate, np.zeros_like(m), np.zeros_like(v), 0
        return theta.outcome("Adam")


@dataclass(frozen=True)
class GradientDescent:
    """Gradient descent with a heavy ball: x_{k+1} = P(x_k - learning_rate g_k + momentum (x_k - x_{k-1})).

    In this formula, x_k are the parameters after k updates, g_k is the gradient at x_k, and P projects onto the bounds.
    If the run after a step diverges, the step and the learning rate are halved, at most 10 times, and the momentum term
    is reset to 0. Gradient descent has no convergence test and makes all iterations.

    Source: B. T. Polyak, "Some methods of speeding up the convergence of iteration methods", USSR Computational
    Mathematics and Mathematical Physics 4(5), 1964. With momentum 0 the method is plain gradient descent. Raises
    InputError for settings out of range.

    ``learning_rate`` is a number, or one number for each parameter by name [unit of the parameter^2 / unit of the
    loss]. ``momentum`` is the factor of the previous step, in [0, 1) [-].

    Example: ``found = cortado.optimise(problem, start, cortado.optimisers.GradientDescent(0.01), iterations=50)``
    """

    learning_rate: PerParameter
    momentum: float = 0.0

    def __post_init__(self) -> None:
        require_positive("learning_rate", self.learning_rate)
        keep_own(self, "learning_rate")
        require_fraction("momentum", self.momentum)

    def check(self, layout: ParameterLayout) -> None:
        require_names("learning_rate", self.learning_rate, layout)

    def minimise(self, search: Search) -> Outcome:
        learning_rate = search.layout.spread(self.learning_rate)
        at, before = Iterate(search), search.start
        for _ in range(search.iterations):
            x, g = at.x, at.gradient
            part = at.move(search.project(x - learning_rate * g + self.momentum * (x - before)))
            learning_rate, before = part * learning_rate, x if part == 1.0 else at.x
        return at.outcome("Gradient descent")


@dataclass(frozen=True)
class LBFGS:
    """L-BFGS-B: a quasi-Newton method with bounds and a line search of one or more evaluations per iteration.

    L-BFGS finds accurate optima of smooth losses in few evaluations, but stops early if the gradient is noisy. The
    coordinates are (x - start) / scale for parameters x. The loss is divided by the greatest component of the first
    gradient in these coordinates. The first trial step is at most about `scale` long.

    With more than about 10^4 components the last bits of sums depend on the number of BLAS threads. Resume a large
    search with the same number of threads. A resumed run raises an error if its numbers differ from the logged numbers.

    Source: R. H. Byrd, P. Lu, J. Nocedal and C. Zhu, SIAM Journal on Scientific Computing 16(5), 1995, as in
    `scipy.optimize.minimize(method="L-BFGS-B")`. Raises InputError for settings out of range.

    ``memory`` is the number of past updates in the approximate Hessian, at most 1,000. ``tolerance`` is the convergence
    threshold for the greatest component of the projected gradient, relative to the first gradient [-]. ``scale`` is a
    typical change of a parameter, as a number or as one number for each parameter by name [unit of the parameter].

    Example: ``found = cortado.optimise(problem, start, cortado.optimisers.LBFGS(scale=0.5), iterations=20)``
    """

    memory: int = 10
    tolerance: float = 0.0
    scale: PerParameter = 1.0

    def __post_init__(self) -> None:
        if not is_whole(self.memory) or self.memory < 1:
            raise InputError(f"The memory of L-BFGS must be an integer of at least 1, not {shown(self.memory)}.")
        require_at_most("The memory of L-BFGS", self.memory, 1_000)
        require_fraction("The tolerance of L-BFGS", self.tolerance)
        require_positive("scale", self.scale)
        keep_own(self, "scale")

    def check(self, layout: ParameterLayout) -> None:
        require_names("scale", self.scale, layout)
        numbers = 2.0 * self.memory * layout.size + 11.0 * self.memory**2
        require({f"{self.memory:,} past updates": 8.0 * numbers}, "take fewer of them, by memory")

    def minimise(self, search: Search) -> Outcome:
        from scipy.optimize import minimize

        scale = search.layout.spread(self.scale)
        loss_start, gradient_start = search.evaluate(search.start)
        unit = _greatest_projected(search, search.start, gradient_start, scale)
        if unit == 0.0:
            return Outcome(search.start, True, "L-BFGS has nothing to do: the gradient at the start is zero.")

        def physical(y: Vector) -> Vector:
            return search.project(search.start + scale * y)

        base = tried = np.zeros_like(search.start), loss_start / unit, scale * gradient_start / unit

        def scaled(y: Vector) -> tuple[float, Vector]:
            nonlocal tried
            found = search.attempt(physical(y)) if y.any() else (loss_start, gradient_start)
            if found is None:  # a parabola that rises from the last iterate, with its minimum at a quarter of the way
                start, loss, gradient = base
                return loss - float(gradient @ (y - start)), -3.0 * gradient
            tried = y.copy(), found[0] / unit, scale * found[1] / unit
            return tried[1], tried[2]

        def updated(_: Vector) -> None:
            nonlocal base
            base = tried
            search.updated()

        found = minimize(
            scaled,
            np.zeros_like(search.start),
            jac=True,
            method="L-BFGS-B",
            bounds=np.column_stack([(end - search.start) / scale for end in (search.lower, search.upper)]),
            callback=updated,
            options={
                "maxcor": self.memory,
                "ftol": 0.0,
                "gtol": self.tolerance,
                "maxiter": search.iterations,
                "maxfun": int(np.iinfo(np.int32).max),
            },
        )
        left = _greatest_projected(search, physical(found.x), found.jac, np.ones_like(scale))
        share = f"the gradient is {left:.2g} times the first gradient"
        if found.status == 1:
            ended = f"made all its {found.nit} iterations without converging: {share}. More may lower the loss."
        elif left < SMALL:
            how = "converged" if found.status == 0 else "stopped at an optimum within round-off errors"
            ended = f"{how} after {found.nit} iterations: {share}."
        else:
            why = "the loss has stopped falling" if found.status == 0 else "no step along its direction lowers the loss"
            ended = f"stopped after {found.nit} iterations, as {why}, but {share}: the loss is too rough for L-BFGS."
            ended += " Continue with LineSearch from the last parameters."
        return Outcome(physical(found.x), found.status == 0 and left < SMALL, f"L-BFGS {ended}")


def _greatest_projected(search: Search, x: Vector, gradient: Vector, scale: Vector) -> float:
    outwards = ((x <= search.lower) & (gradient > 0.0)) | ((x >= search.upper) & (gradient < 0.0))
    return float(np.max(np.abs(np.where(outwards, 0.0, scale * gradient))))


@dataclass(frozen=True)
class LineSearch:
    """Gradient descent that tries steps of several lengths and takes the step with the lowest loss.

    Use `LineSearch` for rough losses, and for gradients with the right direction but a wrong size, as in long runs.
    `LineSearch` steps over local minima that are narrower than a trial step. The search never steps to a point at which
    the run diverges or a parameter is out of range. A trial is a run without a gradient, and all trials of an update
    form one batch.

    Update k moves the parameters x_k along a direction d_k. The vector g_k is the gradient times the scale. The
    function unit(a) divides a vector a by the root mean square of its components. Each update is

        d_k = unit(momentum d_{k-1} - unit(g_k)),   x_{k+1} = the best of P(x_k + r_k s scale d_k).

    The step lengths s form a geometric sequence from ``shortest`` to 1. P projects onto the bounds. The reach r_k
    begins at 1. Each later reach is 3 times the best step length of the previous update, at most 1. If no trial lowers
    the loss, the update still takes the trial with the lowest loss, and sets the reach to 1, in order to leave narrow
    local minima. The last iterate need not be the best one.

    If every trial diverges, the parameters stay unchanged, and the reach is multiplied by ``shortest``. The line search
    has no convergence test and makes all iterations. Raises InputError for settings out of range.

    ``scale`` is the longest change of a parameter in a trial, as a number or as one number for each parameter by name
    [unit of the parameter]. ``trials`` is the number of step lengths per update, at most 1,000. ``shortest`` is the
    ratio of the shortest to the longest step length. ``momentum`` is the factor of the previous direction in the new
    direction, in [0, 1) [-].

    Example: ``found = cortado.optimise(problem, start, cortado.optimisers.LineSearch(scale=0.5), iterations=20)``
    """

    scale: PerParameter = 1.0
    trials: int = 5
    shortest: float = 1.0 / 64.0
    momentum: float = 0.5

    def __post_init__(self) -> None:
        require_positive("scale", self.scale)
        keep_own(self, "scale")
        require_fraction("momentum", self.momentum)
        require_fraction("shortest", self.shortest)
        if not is_whole(self.trials) or self.trials < 2 or self.shortest == 0.0:
            said = f"trials is {shown(self.trials)} and shortest {shown(self.shortest)}"
            raise InputError(f"{said}, but trials must be at least 2, and shortest must be greater than 0.")
        require_at_most("trials", self.trials, 1_000)

    def check(self, layout: ParameterLayout) -> None:
        require_names("scale", self.scale, layout)
        require({f"{self.trials:,} trials": 16.0 * self.trials * layout.size}, "take fewer trials")

    def minimise(self, search: Search) -> Outcome:
        scale, at, reach = search.layout.spread(self.scale), Iterate(search), 1.0
        along = np.zeros_like(at.x)
        for _ in range(search.iterations):
            along = unit(self.momentum * along - unit(at.gradient * scale))
            lengths = reach * np.geomspace(self.shortest, 1.0, self.trials)
            tried = [search.project(at.x + length * scale * along) for length in lengths]
            losses = search.losses(tried)
            best = int(np.argmin(losses))
            if np.isfinite(losses[best]):
                reach = min(GROWTH * lengths[best], 1.0) if losses[best] < at.loss else 1.0
                reach *= at.move(tried[best])
            else:
                along, reach = np.zeros_like(at.x), reach * self.shortest
                at.move(at.x)
        return at.outcome("The line search")


def unit(vector: Vector) -> Vector:
    greatest = np.abs(vector).max(initial=0.0)
    scaled = vector / greatest if greatest else vector
    size = np.sqrt(np.mean(scaled**2)) if greatest else 1.0
    return scaled / size


BY_NAME: dict[str, Any] = {"adam": Adam, "gradient_descent": GradientDescent, "lbfgs": LBFGS, "line_search": LineSearch}


def as_optimiser(optimiser: Any, settings: Mapping[str, Any]) -> Optimiser:
    if isinstance(optimiser, str):
        if optimiser not in BY_NAME:
            wanted = f"one of {quoted(BY_NAME)}, or an object"
            raise InputError(f"The optimiser is {shown(optimiser)}, but must be {wanted}.")
        known = {field.name: field.default is MISSING for field in fields(BY_NAME[optimiser])}
        if unknown := sorted(set(settings) - set(known)):
            raise InputError(f"'{optimiser}' has no setting {quoted(unknown)}; its settings are {quoted(known)}.")
        if missing := [setting for setting, needed in known.items() if needed and setting not in settings]:
            raise InputError(f"'{optimiser}' needs a value for {quoted(missing)}; its settings are {quoted(known)}.")
        made: Optimiser = BY_NAME[optimiser](**settings)
        return made
    if isinstance(optimiser, type) or not isinstance(optimiser, Optimiser):
        said = "The optimiser must be an object such as cortado.optimisers.Adam(learning_rate=0.1)"
        raise InputError(f"{said}, or one of {quoted(BY_NAME)}, not {shown(optimiser)}.")
    if settings:
        said = f"optimise was given {quoted(settings)}, but takes settings only with the name of an optimiser"
        raise InputError(f"{said}: give the settings to the optimiser object.")
    return optimiser


__dir__ = face(globals())
