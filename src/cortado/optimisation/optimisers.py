"""The optimisers: each an object that holds its settings and its algorithm.

An optimiser is deterministic: the points at which it evaluates depend on its settings and on the losses and gradients
before, and on nothing else. Resuming (`cortado.optimisation.optimise`) rests on this; an optimiser with random numbers
must draw them from a seed of its own.
"""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any

import numpy as np

from cortado.arrays import is_whole, require_at_most
from cortado.calls import face, keep_own, quoted
from cortado.device.threads import require
from cortado.errors import InputError, shown
from cortado.optimisation.search import (
    Iterate,
    Optimiser,
    Outcome,
    ParameterLayout,
    PerParameter,
    Search,
    Vector,
    require_fraction,
    require_names,
    require_positive,
)

MOST_TRIALS = 1_000
"""Most trials of an update; more are taken for a mistake, as each is a run."""
GROWTH = 3.0
"""How much longer than the best length the longest one may be at the next update."""
SMALL = 0.01
"""Part of the first gradient above which the end of L-BFGS is no optimum."""
MOST_MEMORY = 1_000
"""Most past updates that L-BFGS keeps; more are taken for a mistake, as some ten suffice."""

__all__ = ["LBFGS", "Adam", "GradientDescent", "LineSearch", "Optimiser", "Outcome", "Search"]


@dataclass(frozen=True)
class Adam:
    """Adam: steps along the mean of recent gradients, divided by the root of the mean of their squares.

    A step changes a component by at most about its learning rate, whatever the size of the gradient. Bounds
    are kept by projection after each update. Where a step leads to a run that diverges, it is halved until it does not,
    at most 10 times, and the learning rate with it for all that follow. The means begin anew, as they would lead there
    again. There is no test of convergence: all the iterations are made.

    Source: D. P. Kingma and J. Ba, "Adam: a method for stochastic optimization", ICLR 2015, Algorithm 1.
    Raises InputError for settings out of range.

    ``learning_rate``: by name or for all, in the units of the parameters; ``beta1`` and ``beta2``: memory of the two
    means; ``epsilon``: added to the root.

    Example: ``found = cortado.optimise(problem, start, cortado.optimisers.Adam(0.1), iterations=50)``
    """

    learning_rate: PerParameter
    """One number, or one per parameter by name [unit of the parameter]."""
    beta1: float = 0.9
    """Decay of the mean gradient, in [0, 1) [-]."""
    beta2: float = 0.999
    """Decay of the mean squared gradient, in [0, 1) [-]."""
    epsilon: float = 1e-8
    """Covers the division where the gradient has always been 0, the step is then 0 [unit of the gradient]."""

    def __post_init__(self) -> None:
        require_positive("learning_rate", self.learning_rate)
        keep_own(self, "learning_rate")
        require_fraction("beta1", self.beta1)
        require_fraction("beta2", self.beta2)
        require_positive("epsilon", self.epsilon)

    def check(self, layout: ParameterLayout) -> None:
        """Raise `InputError` if the learning rates are not those of these parameters."""
        require_names("learning_rate", self.learning_rate, layout)

    def minimise(self, search: Search) -> Outcome:
        """Make `search.iterations` updates by Adam, with one gradient each, and evaluate the last iterate."""
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

    P projects onto the bounds. Where a step leads to a run that diverges, it is halved until it does not, at most 10
    times, and the learning rate with it for all that follow; the ball stops. There is no test of convergence: all the
    iterations are made.

    Source: B. T. Polyak, "Some methods of speeding up the convergence of iteration methods", USSR
    Computational Mathematics and Mathematical Physics 4(5), 1964; plain gradient descent with momentum 0.
    Raises InputError for settings out of range.

    Example: ``found = cortado.optimise(problem, start, cortado.optimisers.GradientDescent(0.01), iterations=50)``
    """

    learning_rate: PerParameter
    """One number, or one per parameter by name [unit of the parameter^2 / unit of the loss]."""
    momentum: float = 0.0
    """In [0, 1) [-]."""

    def __post_init__(self) -> None:
        require_positive("learning_rate", self.learning_rate)
        keep_own(self, "learning_rate")
        require_fraction("momentum", self.momentum)

    def check(self, layout: ParameterLayout) -> None:
        """Raise `InputError` if the learning rates are not those of these parameters."""
        require_names("learning_rate", self.learning_rate, layout)

    def minimise(self, search: Search) -> Outcome:
        """Make `search.iterations` updates by gradient descent, with one gradient each; evaluate the last iterate."""
        learning_rate = search.layout.spread(self.learning_rate)
        at, before = Iterate(search), search.start
        for _ in range(search.iterations):
            x, g = at.x, at.gradient
            part = at.move(search.project(x - learning_rate * g + self.momentum * (x - before)))
            learning_rate, before = part * learning_rate, x if part == 1.0 else at.x
        return at.outcome("Gradient descent")


@dataclass(frozen=True)
class LBFGS:
    """L-BFGS-B: a quasi-Newton method with bounds and a line search of one or more evaluations an iteration.

    For smooth losses; it reaches tight optima in few evaluations, and stops early where the gradient is
    noisy. It works on (x - start) / scale, and divides the loss by the greatest component of its first
    gradient in these coordinates. So the first trial step is at most about `scale` long, whatever the unit of the loss.

    Where a trial leads to a run that diverges, the line search gets the loss and the slope of a parabola there. This
    parabola has the loss and the slope of the last iterate, and rises where its slope promised to fall. The next trial
    is then about a quarter as long, and the approximate Hessian knows nothing of it.

    Its sums over components are BLAS's: beyond some 10^4 components their last bits, and with them resuming
    bit for bit, depend on the number of BLAS threads. A resumed run with other bits is refused.

    Source: R. H. Byrd, P. Lu, J. Nocedal and C. Zhu, SIAM Journal on Scientific Computing 16(5), 1995, as in
    `scipy.optimize.minimize(method="L-BFGS-B")`.
    Raises InputError for settings out of range.

    ``memory``: of how many updates the curvature is estimated; ``tolerance``: of the greatest component of the scaled
    gradient, below which the search has converged.

    Example: ``found = cortado.optimise(problem, start, cortado.optimisers.LBFGS(scale=0.5), iterations=20)``
    """

    memory: int = 10
    """Number of past updates that make up the approximate Hessian, at most 1,000."""
    tolerance: float = 0.0
    """Converged when the greatest component of the projected gradient is this fraction of the first one [-]."""
    scale: PerParameter = 1.0
    """A change worth trying, one number or one per parameter by name [unit of the parameter]."""

    def __post_init__(self) -> None:
        if not is_whole(self.memory) or self.memory < 1:
            raise InputError(f"The memory of L-BFGS must be an integer of at least 1, not {shown(self.memory)}.")
        require_at_most("The memory of L-BFGS", self.memory, MOST_MEMORY)
        require_fraction("The tolerance of L-BFGS", self.tolerance)
        require_positive("scale", self.scale)
        keep_own(self, "scale")

    def check(self, layout: ParameterLayout) -> None:
        """Raise `InputError` if the scales are not those of these parameters, or there is no memory for the updates."""
        require_names("scale", self.scale, layout)
        numbers = 2.0 * self.memory * layout.size + 11.0 * self.memory**2
        require({f"{self.memory:,} past updates": 8.0 * numbers}, "take fewer of them, by memory")

    def minimise(self, search: Search) -> Outcome:
        """Make at most `search.iterations` updates by L-BFGS, of one or more evaluations each."""
        from scipy.optimize import minimize

        scale = search.layout.spread(self.scale)
        loss_start, gradient_start = search.evaluate(search.start)
        unit = _greatest_projected(search, search.start, gradient_start, scale)
        if unit == 0.0:
            return Outcome(search.start, True, "L-BFGS has nothing to do: the gradient at the start is zero.")

        def physical(y: Vector) -> Vector:
            return search.project(search.start + scale * y)

        def in_units(loss: float, gradient: Vector) -> tuple[float, Vector]:
            return loss / unit, scale * gradient / unit

        base = tried = _Trial(np.zeros_like(search.start), *in_units(loss_start, gradient_start))

        def scaled(y: Vector) -> tuple[float, Vector]:
            nonlocal tried
            found = search.attempt(physical(y)) if y.any() else (loss_start, gradient_start)
            if found is None:
                return base.rising(y)
            tried = _Trial(y.copy(), *in_units(*found))
            return tried.loss, tried.gradient

        def updated(_: Vector) -> None:
            nonlocal base
            base = tried
            search.updated()

        found = minimize(
            scaled,
            np.zeros_like(search.start),
            jac=True,
            method="L-BFGS-B",
            bounds=_scaled_bounds(search, scale),
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
        ended = _lbfgs_in_words(found.status, found.nit, left)
        return Outcome(physical(found.x), found.status == 0 and left < SMALL, ended)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A point of L-BFGS's coordinates (size,), with its loss and its gradient (size,)."""

    y: Vector
    loss: float
    gradient: Vector

    def rising(self, y: Vector) -> tuple[float, Vector]:
        """Return a loss and a gradient at y, where the run diverged. Along the way from here they follow a parabola
        f + s t - 2 s t^2 to t = 1, with its minimum at t = 1 / 4. The loss here is f, and s < 0 is its slope."""
        return self.loss - float(self.gradient @ (y - self.y)), -3.0 * self.gradient


def _lbfgs_in_words(status: int, iterations: int, left: float) -> str:
    """Say how L-BFGS ended, by scipy's status, and by the part of the first gradient that is left."""
    share = f"the gradient is {left:.2g} of the first one"
    if status == 1:
        return f"L-BFGS made all its {iterations} iterations without converging: {share}. More may lower the loss."
    if left < SMALL:
        how = "converged" if status == 0 else "stopped at an optimum to rounding"
        return f"L-BFGS {how} after {iterations} iterations: {share}."
    why = "the loss has stopped falling" if status == 0 else "no step along its direction lowers the loss"
    return (
        f"L-BFGS stopped after {iterations} iterations, as {why}, but {share}: the loss is too rough for it, so try "
        "LineSearch from here."
    )


def _scaled_bounds(search: Search, scale: Vector) -> list[tuple[float, float]] | None:
    """Return the bounds on (x - start) / scale as scipy takes them; None if there are none at all."""
    if np.isinf(search.lower).all() and np.isinf(search.upper).all():
        return None
    lower, upper = (search.lower - search.start) / scale, (search.upper - search.start) / scale
    return list(zip(lower.tolist(), upper.tolist(), strict=True))


def _greatest_projected(search: Search, x: Vector, gradient: Vector, scale: Vector) -> float:
    """Return the greatest component, in units of `scale`, of the gradient within the bounds."""
    outwards = ((x <= search.lower) & (gradient > 0.0)) | ((x >= search.upper) & (gradient < 0.0))
    return float(np.max(np.abs(np.where(outwards, 0.0, scale * gradient))))


@dataclass(frozen=True)
class LineSearch:
    """Descent along the gradient, as far as the best of several lengths that are tried in one launch.

    For losses that are rough, and for gradients that have the right direction and not the right size, such as those of
    long runs. A search steps over dents that are narrower than its trials, and never to where the run diverges or
    parameters are out of their range. A trial is a run without a gradient, and all trials of an update are one batch.

    Formula: with g the gradient times the scale, and unit(a) = a over its root mean square,

        d_k = unit(momentum d_{k-1} - unit(g_k)),   x_{k+1} = the best of P(x_k + r_k s scale d_k),

    over lengths s at even ratios from ``shortest`` to 1. P projects onto the bounds. The reach r is 1 at first, and
    then `GROWTH` times the length that was best, at most 1. Where no trial lowers the loss, at the bottom of a dent or
    of the valley, an update still takes the best one and sets the reach to 1, so that the search leaves dents. So the
    last iterate need not be the best. Where every trial diverges, x stays, the momentum is dropped, and the reach
    is ``shortest`` times what it was. Where the gradient of the best one diverges, as that of an ensemble may, x moves
    a part of the way, and the reach is that part of what it would be. There is no test of convergence: all the
    iterations are made.

    Raises InputError for settings out of range.

    Example: ``found = cortado.optimise(problem, start, cortado.optimisers.LineSearch(scale=0.5), iterations=20)``
    """

    scale: PerParameter = 1.0
    """The longest change worth trying, one number or one per parameter by name [unit of the parameter]."""
    trials: int = 5
    """Lengths that are tried at a time, at most 1,000."""
    shortest: float = 1.0 / 64.0
    """Shortest of these lengths, over the longest."""
    momentum: float = 0.5
    """How much of the direction before is kept, in [0, 1) [-]."""

    def __post_init__(self) -> None:
        require_positive("scale", self.scale)
        keep_own(self, "scale")
        require_fraction("momentum", self.momentum)
        require_fraction("shortest", self.shortest)
        if not is_whole(self.trials) or self.trials < 2 or self.shortest == 0.0:
            raise InputError(
                f"trials is {shown(self.trials)} and shortest {shown(self.shortest)}, but must be at least 2 and "
                "greater than 0."
            )
        require_at_most("trials", self.trials, MOST_TRIALS)

    def check(self, layout: ParameterLayout) -> None:
        """Raise `InputError` if the scales are not those of these parameters, or there is no memory for the trials."""
        require_names("scale", self.scale, layout)
        require({f"{self.trials:,} trials": 16.0 * self.trials * layout.size}, "take fewer trials")

    def minimise(self, search: Search) -> Outcome:
        """Make at most `search.iterations` updates, of a gradient and some trials each; evaluate the last iterate."""
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
    """Divide a vector (size,) by its root mean square; a vector of zeros stays."""
    greatest = np.abs(vector).max(initial=0.0)
    scaled = vector / greatest if greatest else vector
    size = np.sqrt(np.mean(scaled**2)) if greatest else 1.0
    return scaled / size


BY_NAME: dict[str, Any] = {"adam": Adam, "gradient_descent": GradientDescent, "lbfgs": LBFGS, "line_search": LineSearch}
"""The optimisers by the names that `cortado.optimise` takes."""


def as_optimiser(optimiser: Any, settings: Mapping[str, Any]) -> Optimiser:
    """Return an optimiser by its name and its settings, or the object itself; raise `InputError` for anything else."""
    if isinstance(optimiser, str):
        return _named(optimiser, settings)
    if isinstance(optimiser, type) or not isinstance(optimiser, Optimiser):
        raise InputError(
            f"The optimiser must be an object such as cortado.optimisers.Adam(learning_rate=0.1), or one of "
            f"{quoted(BY_NAME)}, not {shown(optimiser)}."
        )
    if settings:
        raise InputError(
            f"optimise was given {quoted(settings)}, but takes settings only of an optimiser that is given by its "
            "name: an object has its own."
        )
    return optimiser


def _named(name: str, settings: Mapping[str, Any]) -> Optimiser:
    """Make the optimiser of a name, with settings that must be its own and complete."""
    if name not in BY_NAME:
        raise InputError(f"The optimiser is {shown(name)}, but must be one of {quoted(BY_NAME)}, or an object.")
    known = {field.name: field.default is MISSING for field in fields(BY_NAME[name])}
    unknown = sorted(set(settings) - set(known))
    if unknown:
        raise InputError(f"{quoted(unknown)} is no setting of '{name}', whose settings are {quoted(known)}.")
    missing = [setting for setting, needed in known.items() if needed and setting not in settings]
    if missing:
        raise InputError(f"'{name}' needs {quoted(missing)}; its settings are {quoted(known)}.")
    return BY_NAME[name](**settings)


__dir__ = face(globals())
