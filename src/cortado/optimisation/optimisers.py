"""The optimisers: each an object that holds its settings and its algorithm.

An optimiser is deterministic: the points at which it evaluates depend on its settings and on the losses and gradients
before, and on nothing else. Resuming (`cortado.optimisation.optimise`) rests on this; an optimiser with random numbers
must draw them from a seed of its own.
"""

from dataclasses import dataclass

import numpy as np

from cortado.arrays import is_whole
from cortado.errors import InputError
from cortado.optimisation.line_search import LineSearch
from cortado.optimisation.replay_log import ParameterLayout, Vector
from cortado.optimisation.search import (
    Optimiser,
    Outcome,
    PerParameter,
    Search,
    all_updates_made,
    require_fraction,
    require_names,
    require_positive,
)

__all__ = ["LBFGS", "Adam", "GradientDescent", "LineSearch", "Optimiser", "Outcome", "Search"]


@dataclass(frozen=True)
class Adam:
    """Adam: steps along the mean of recent gradients, divided by the root of the mean of their squares.

    A step changes a component by at most about its learning rate, whatever the size of the gradient. Bounds
    are kept by projection after each update. There is no test of convergence: all the iterations are made.

    Source: D. P. Kingma and J. Ba, "Adam: a method for stochastic optimization", ICLR 2015, Algorithm 1.
    Raises InputError for settings out of range.
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
        require_fraction("beta1", self.beta1)
        require_fraction("beta2", self.beta2)
        require_positive("epsilon", self.epsilon)

    def check(self, layout: ParameterLayout) -> None:
        """Raise InputError if the learning rates are not those of these parameters."""
        require_names("learning_rate", self.learning_rate, layout)

    def minimise(self, search: Search) -> Outcome:
        """Make `search.iterations` updates; one gradient each, and one evaluation of the last iterate."""
        learning_rate = search.layout.spread(self.learning_rate)
        theta = search.start
        m, v = np.zeros_like(theta), np.zeros_like(theta)
        for t in range(1, search.iterations + 1):
            _, g = search.evaluate(theta)
            m = self.beta1 * m + (1.0 - self.beta1) * g
            v = self.beta2 * v + (1.0 - self.beta2) * g**2
            m_hat = m / (1.0 - self.beta1**t)
            v_hat = v / (1.0 - self.beta2**t)
            theta = search.project(theta - learning_rate * m_hat / (np.sqrt(v_hat) + self.epsilon))
            search.updated()
        return all_updates_made("Adam", search, theta)


@dataclass(frozen=True)
class GradientDescent:
    """Gradient descent with a heavy ball: x_{k+1} = P(x_k - learning_rate g_k + momentum (x_k - x_{k-1})).

    P projects onto the bounds. There is no test of convergence: all the iterations are made.

    Source: B. T. Polyak, "Some methods of speeding up the convergence of iteration methods", USSR
    Computational Mathematics and Mathematical Physics 4(5), 1964; plain gradient descent with momentum 0.
    Raises InputError for settings out of range.
    """

    learning_rate: PerParameter
    """One number, or one per parameter by name [unit of the parameter^2 / unit of the loss]."""
    momentum: float = 0.0
    """In [0, 1) [-]."""

    def __post_init__(self) -> None:
        require_positive("learning_rate", self.learning_rate)
        require_fraction("momentum", self.momentum)

    def check(self, layout: ParameterLayout) -> None:
        """Raise InputError if the learning rates are not those of these parameters."""
        require_names("learning_rate", self.learning_rate, layout)

    def minimise(self, search: Search) -> Outcome:
        """Make `search.iterations` updates; one gradient each, and one evaluation of the last iterate."""
        learning_rate = search.layout.spread(self.learning_rate)
        before = x = search.start
        for _ in range(search.iterations):
            _, g = search.evaluate(x)
            x, before = search.project(x - learning_rate * g + self.momentum * (x - before)), x
            search.updated()
        return all_updates_made("Gradient descent", search, x)


@dataclass(frozen=True)
class LBFGS:
    """L-BFGS-B: a quasi-Newton method with bounds and a line search of one or more evaluations an iteration.

    For smooth losses; it reaches tight optima in few evaluations, and stops early where the gradient is
    noisy. It works on (x - start) / scale, and divides the loss by the greatest component of its first
    gradient in these coordinates, so that the first trial step is at most about `scale` long, whatever the
    unit of the loss.

    Its sums over components are BLAS's: beyond some 10^4 components their last bits, and with them resuming
    bit for bit, depend on the number of BLAS threads. A resumed run that comes out otherwise is refused.

    Source: R. H. Byrd, P. Lu, J. Nocedal and C. Zhu, SIAM Journal on Scientific Computing 16(5), 1995, as in
    `scipy.optimize.minimize(method="L-BFGS-B")`.
    Raises InputError for settings out of range.
    """

    memory: int = 10
    """Number of past updates that make up the approximate Hessian."""
    tolerance: float = 0.0
    """Converged when the greatest component of the projected gradient is this fraction of the first one [-]."""
    scale: PerParameter = 1.0
    """A change worth trying, one number or one per parameter by name [unit of the parameter]."""

    def __post_init__(self) -> None:
        if not is_whole(self.memory) or self.memory < 1:
            raise InputError(f"The memory of L-BFGS must be an integer of at least 1, not {self.memory!r}.")
        require_fraction("The tolerance of L-BFGS", self.tolerance)
        require_positive("scale", self.scale)

    def check(self, layout: ParameterLayout) -> None:
        """Raise InputError if the scales are not those of these parameters."""
        require_names("scale", self.scale, layout)

    def minimise(self, search: Search) -> Outcome:
        """Make at most `search.iterations` updates, of one or more evaluations each."""
        from scipy.optimize import minimize

        scale = search.layout.spread(self.scale)
        loss_start, gradient_start = search.evaluate(search.start)
        unit = _greatest_projected(search, search.start, gradient_start, scale)
        if unit == 0.0:
            return Outcome(search.start, True, "L-BFGS has nothing to do: the gradient at the start is zero.")

        def physical(y: Vector) -> Vector:
            return search.project(search.start + scale * y)

        def scaled(y: Vector) -> tuple[float, Vector]:
            known = not y.any()
            loss, gradient = (loss_start, gradient_start) if known else search.evaluate(physical(y))
            return loss / unit, scale * gradient / unit

        found = minimize(
            scaled,
            np.zeros_like(search.start),
            jac=True,
            method="L-BFGS-B",
            bounds=_scaled_bounds(search, scale),
            callback=lambda _: search.updated(),
            options={
                "maxcor": self.memory,
                "ftol": 0.0,
                "gtol": self.tolerance,
                "maxiter": search.iterations,
                "maxfun": int(np.iinfo(np.int32).max),
            },
        )
        return Outcome(physical(found.x), found.status == 0, _LBFGS_MESSAGES[found.status].format(found.nit))


_LBFGS_MESSAGES = {
    0: "L-BFGS converged after {} iterations: the gradient is small or the loss has stopped falling.",
    1: "L-BFGS made all its {} iterations without converging; more may lower the loss further.",
    2: "L-BFGS stopped after {} iterations, because no step along its direction lowers the loss: either it "
    "is at an optimum to rounding, or the loss is too rough for its gradient; then try Adam from here.",
}


def _scaled_bounds(search: Search, scale: Vector) -> list[tuple[float, float]] | None:
    """The bounds on (x - start) / scale, as scipy takes them; None if there are none at all."""
    if np.isinf(search.lower).all() and np.isinf(search.upper).all():
        return None
    lower, upper = (search.lower - search.start) / scale, (search.upper - search.start) / scale
    return list(zip(lower.tolist(), upper.tolist(), strict=True))


def _greatest_projected(search: Search, x: Vector, gradient: Vector, scale: Vector) -> float:
    """The greatest component, in units of `scale`, of the gradient without what points out of the bounds."""
    outwards = ((x <= search.lower) & (gradient > 0.0)) | ((x >= search.upper) & (gradient < 0.0))
    return float(np.max(np.abs(np.where(outwards, 0.0, scale * gradient))))


def __dir__() -> list[str]:
    return __all__
