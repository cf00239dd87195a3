"""How a gradient is come by: objects to be given to `Problem.value_and_gradient`, each with its formula, bias and cost.

`Exact` is the derivative of the discrete map, `Tape` the same by other means. Where neighbouring trajectories separate
it says less and less, and others take its place: `AdjointSmoothing`, `VelocityOnly`, `Damped`, or the mean of theirs
over a cloud, `Averaged`. `Smoothed`, from forward runs alone, is what they are measured by.
"""

from cortado.gradients.adjoint_filters import AdjointNorms
from cortado.gradients.ensemble import Averaged, Smoothed
from cortado.gradients.estimator import AdjointPolicy, Differentiable, Estimate, Passage, Policy, checked_policy, tuned
from cortado.gradients.exact import Exact, Tape, VelocityOnly
from cortado.gradients.filters import AdjointSmoothing, Damped
from cortado.parameters.values import Values
from cortado.rollout import Observer

__all__ = [
    "AdjointNorms",
    "AdjointPolicy",
    "AdjointSmoothing",
    "Averaged",
    "Damped",
    "Differentiable",
    "Estimate",
    "Exact",
    "Passage",
    "Policy",
    "Smoothed",
    "Tape",
    "VelocityOnly",
    "estimate",
    "tuned",
]


def __dir__() -> list[str]:
    return __all__


def estimate(
    problem: Differentiable, parameters: Values, policy: Policy | None = None, observe: Observer | None = None
) -> Estimate:
    """What a policy, `Exact` if none is given, has to say of a problem, or an `InputError` where it is none."""
    return checked_policy(Exact() if policy is None else policy).estimate(problem, parameters, observe)
