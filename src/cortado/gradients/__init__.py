"""Gradient estimators for `Problem.value_and_gradient`. Each class states its formula, bias and cost.

`Exact` and `Tape` suit short runs. For long runs, `AdjointViscosity` damps the adjoint, `EnsembleMean` averages
gradients, and `Guided` also corrects their size. `RandomizedSmoothing` is the reference for all estimators.
"""

from cortado.arrays import require_function, require_methods
from cortado.calls import face
from cortado.gradients.ensembles import EnsembleMean, Guided, RandomizedSmoothing
from cortado.gradients.estimator import AdjointEstimator as AdjointEstimator
from cortado.gradients.estimator import Differentiable, Estimate, GradientEstimator, checked_estimate, checked_estimator
from cortado.gradients.estimator import Filtered as Filtered
from cortado.gradients.estimator import ForwardPass as ForwardPass
from cortado.gradients.reverse_mode import AdjointNorms, AdjointViscosity, Exact, Tape
from cortado.rollout.rollout import OBSERVED, Observer
from cortado.scene.parameter_values import Values

__all__ = ["AdjointEstimator", "AdjointNorms", "AdjointViscosity", "Differentiable", "EnsembleMean", "Estimate"]
__all__ += ["Exact", "Filtered", "ForwardPass", "GradientEstimator", "Guided", "RandomizedSmoothing", "Tape"]
__all__ += ["estimate"]


def estimate(
    problem: Differentiable,
    parameters: Values,
    estimator: GradientEstimator | None = None,
    observe: Observer | None = None,
) -> Estimate:
    """Return the loss of a problem, and its gradient computed by an estimator. The default estimator is `Exact`.

    ``parameters`` are values by name. ``observe`` is called with the number and the adjoint of each state. Raises
    `InputError` if ``estimator`` is not an estimator, or if the result lacks the gradient of a parameter.

    Example::

        found = cortado.gradients.estimate(problem, {"gravity": [0.0, -9.81]})
        print(found.loss, found.gradient["gravity"])
    """
    require_methods("problem", problem, ("value",), "a cortado.Problem")
    require_function("observe", observe, *OBSERVED)
    chosen = checked_estimator(Exact() if estimator is None else estimator)
    return checked_estimate(chosen.estimate(problem, parameters, observe), parameters, problem.simulation.batch)


__dir__ = face(globals())
