"""Gradient estimators: objects to be given to `Problem.value_and_gradient`, each with its formula, bias and cost.

`Exact` is the derivative of the discrete map by its own adjoint, `Tape` the same by Warp's automatic differentiation.
Beyond the predictability horizon, where neighbouring trajectories diverge, that derivative is of little use, and others
take its place: `AdjointViscosity`, the mean of its gradients over an ensemble, `EnsembleMean`, or that mean with its
sizes mended by differences, `Guided`. `RandomizedSmoothing`, which needs forward
runs alone, is the reference that they are compared with.
"""

from cortado.arrays import require_function, require_methods
from cortado.calls import face
from cortado.gradients.ensembles import EnsembleMean, Guided, RandomizedSmoothing
from cortado.gradients.estimator import (
    AdjointEstimator,
    Differentiable,
    Estimate,
    Filtered,
    ForwardPass,
    GradientEstimator,
    checked_estimate,
    checked_estimator,
)
from cortado.gradients.reverse_mode import AdjointNorms, AdjointViscosity, Exact, Tape
from cortado.rollout.rollout import OBSERVED, Observer
from cortado.scene.parameter_values import Values

__all__ = [
    "AdjointEstimator",
    "AdjointNorms",
    "AdjointViscosity",
    "Differentiable",
    "EnsembleMean",
    "Estimate",
    "Exact",
    "Filtered",
    "ForwardPass",
    "GradientEstimator",
    "Guided",
    "RandomizedSmoothing",
    "Tape",
    "estimate",
]


def estimate(
    problem: Differentiable,
    parameters: Values,
    estimator: GradientEstimator | None = None,
    observe: Observer | None = None,
) -> Estimate:
    """Return the loss of a problem and its gradient by an estimator, `Exact` by default.

    Raises `InputError` where what is given is no estimator, or does not return the gradient of every parameter.

    ``parameters`` by name; ``observe`` is given the number and the state of each step.

    Example::

        found = cortado.gradients.estimate(problem, {"gravity": [0.0, -9.81]})
        print(found.loss, found.gradient["gravity"])
    """
    require_methods("problem", problem, ("value",), "a cortado.Problem")
    require_function("observe", observe, *OBSERVED)
    chosen = checked_estimator(Exact() if estimator is None else estimator)
    return checked_estimate(chosen.estimate(problem, parameters, observe), parameters, problem.simulation.batch)


__dir__ = face(globals())
