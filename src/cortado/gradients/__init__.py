"""How a gradient is come by: objects to be given to `Problem.value_and_gradient`, each with its formula, bias and cost.

`Exact` is the derivative of the discrete map, `Tape` the same by other means. Where neighbouring trajectories separate
it says less and less, and others take its place: `AdjointViscosity`, `FrozenGeometry`, `Damped`, or the mean of theirs
over an ensemble, `EnsembleMean`. `RandomizedSmoothing`, from forward runs alone, is what they are measured by.
"""

from cortado.gradients.adjoint_filters import AdjointNorms
from cortado.gradients.ensemble import EnsembleMean, RandomizedSmoothing
from cortado.gradients.estimator import (
    AdjointEstimator,
    Differentiable,
    Estimate,
    ForwardPass,
    GradientEstimator,
    checked_estimator,
    tuned,
)
from cortado.gradients.exact import Exact, FrozenGeometry, Tape
from cortado.gradients.filters import AdjointViscosity, Damped
from cortado.parameters.values import Values
from cortado.rollout import Observer

__all__ = [
    "AdjointEstimator",
    "AdjointNorms",
    "AdjointViscosity",
    "Damped",
    "Differentiable",
    "EnsembleMean",
    "Estimate",
    "Exact",
    "ForwardPass",
    "FrozenGeometry",
    "GradientEstimator",
    "RandomizedSmoothing",
    "Tape",
    "estimate",
    "tuned",
]


def __dir__() -> list[str]:
    return __all__


def estimate(
    problem: Differentiable,
    parameters: Values,
    estimator: GradientEstimator | None = None,
    observe: Observer | None = None,
) -> Estimate:
    """What an estimator, `Exact` if none is given, has to say of a problem, or an `InputError` where it is none."""
    return checked_estimator(Exact() if estimator is None else estimator).estimate(problem, parameters, observe)
