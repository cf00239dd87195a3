"""The protocols of gradient estimators, which are given to `Problem.value_and_gradient`, and what these return."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from cortado.arrays import as_numbers, as_one_number
from cortado.errors import DivergedError, InputError, shown
from cortado.particles.state import Parameters, State
from cortado.rollout.rollout import BackwardStep, Observer, Rollout
from cortado.scene.parameters.values import Arrays, Values
from cortado.solvers.solver import Counts
from cortado.words import counted, sized


@dataclass(frozen=True)
class Estimate:
    """A loss and its gradient, with what the estimator knows about its accuracy."""

    loss: Any
    """A float, of a batch (batch,)."""
    gradient: Arrays
    """For each parameter given, an array of its shape (float64), of a batch with a first axis for the scenes."""
    standard_error: Arrays | None = None
    """Of every component of the gradient, where it is an average (`RandomizedSmoothing`, `EnsembleMean`, `Guided`)."""
    degrees_of_freedom: float | None = None
    """Of the standard error: the number of independent samples less one; of `Guided` those of its two parts."""
    left_out: int = 0
    """Runs of an ensemble that the average leaves out, as they, or runs that they belong to, diverged or are out of
    range."""
    diverged: Exception | None = None
    """Why there was no run, of a point of `cortado.evaluate`: a `DivergedError`, or an `OutOfRangeError`. Its loss and
    its gradient are then no numbers."""

    def interval(self, confidence: float = 0.95) -> tuple[Arrays, Arrays]:
        """The lower and the upper end, by parameter, of an interval for each component of the gradient.

        With this probability it contains the mean that the estimator would have over endlessly many samples: by
        Student's distribution, as the scatter is known from few samples. A bias of the estimator comes on top.

        Raises:
            InputError: the estimate is no average, or the confidence is not between 0 and 1.
        """
        if self.standard_error is None or self.degrees_of_freedom is None:
            raise InputError(
                "The estimate has no standard error, as it is no average over samples: it has no interval."
            )
        if not 0.0 < as_one_number("confidence", confidence) < 1.0:
            raise InputError(f"confidence is {confidence}, but must be between 0 and 1.")
        from scipy.stats import t as student

        reach = float(student.ppf(0.5 + 0.5 * confidence, self.degrees_of_freedom))
        errors = self.standard_error
        lower = {name: value - reach * errors[name] for name, value in self.gradient.items()}
        return lower, {name: value + reach * errors[name] for name, value in self.gradient.items()}

    def member(self, number: int, shapes: Mapping[str, tuple[int, ...]]) -> "Estimate":
        """That of one scene of a batch, with gradients of these shapes."""
        gradient = {name: bar[number].reshape(shapes[name]) for name, bar in self.gradient.items()}
        return replace(self, loss=float(self.loss[number]), gradient=gradient)

    def __repr__(self) -> str:
        error = "" if self.standard_error is None else ", with its standard error"
        loss = f"losses {self.loss.shape}" if np.ndim(self.loss) else f"loss {self.loss:.6g}"
        out = f", {counted(self.left_out, 'run')} left out" if self.left_out else ""
        return f"Estimate({loss}, gradient of {sized(self.gradient)}{error}{out})"


class ForwardPass(Protocol):
    """A forward run with its loss. Any number of reverse passes may follow, until the problem is run again."""

    @property
    def loss(self) -> float:
        """The loss of the run."""

    def back(self, estimator: "AdjointEstimator", observe: Observer | None = None) -> Arrays:
        """The gradient by an estimator; ``observe`` is called with the number and the adjoint of every state, from the
        last to the first."""


class Differentiable(Protocol):
    """What an estimator uses of a `Problem`."""

    simulation: Any

    def value(self, parameters: Values) -> float:
        """The loss, forward only."""

    def forward_pass(self, parameters: Values) -> ForwardPass:
        """A forward run that reverse passes may follow."""


@runtime_checkable
class Batchable(Protocol):
    """A problem that can be evaluated at many points in one launch."""

    def room(self, estimator: "AdjointEstimator | None" = None) -> int:
        """How many points `together` takes at a time, for a gradient by an estimator or for losses alone."""

    def together(
        self, points: Sequence[Values], estimator: "AdjointEstimator | None" = None
    ) -> list[Estimate | DivergedError]:
        """Estimates at points that have the same parameters in the same shapes, in one launch for all, each with the
        bits that it has alone; without an estimator of the loss alone. Where a particle is lost there is the error."""


class GradientEstimator(Protocol):
    """Computes a gradient, exact or approximate."""

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """The loss and its gradient; estimators that compute adjoints of states call ``observe`` with each of them."""


def checked_estimator(estimator: GradientEstimator) -> GradientEstimator:
    """The estimator; raises `InputError` for anything else, such as the class of an estimator."""
    if isinstance(estimator, type) or not hasattr(estimator, "estimate"):
        raise InputError(f"estimator is {shown(estimator)}, but must be an object such as cortado.gradients.Exact().")
    return estimator


def checked_reverse(estimator: "AdjointEstimator") -> "AdjointEstimator":
    """The estimator; raises `InputError` for anything but one that goes back through a run."""
    if not isinstance(estimator, AdjointEstimator):
        wanted = "an AdjointEstimator such as cortado.gradients.Exact()"
        raise InputError(f"estimator is {shown(estimator)}, but must be {wanted}.")
    return estimator


def checked_estimate(found: Any, parameters: Values, batch: int | None = None) -> Estimate:
    """What an estimator has returned, in float64; raises `InputError` unless it has a gradient of the shape of every
    parameter that was given, of a batch with a first axis for the scenes."""
    if not isinstance(found, Estimate):
        raise InputError(f"the estimator returned a {type(found).__name__}, but must return a gradients.Estimate.")
    loss = as_one_number("the estimate's loss", found.loss) if batch is None else as_numbers("losses", found.loss)
    gradient = {}
    for name, given in parameters.items():
        if name not in found.gradient:
            raise InputError(f"the estimate has no gradient with respect to {name}, but must have one.")
        what = f"the estimate's gradient with respect to {name}"
        gradient[name] = as_numbers(what, found.gradient[name])
        wanted = np.shape(given) if batch is None else (batch, *gradient[name].shape[1:])
        if gradient[name].shape != wanted:
            raise InputError(f"{what} has shape {gradient[name].shape}, but must be {wanted}, the parameter's.")
    return replace(found, loss=loss, gradient=gradient)


class AdjointEstimator(ABC):
    """An estimator that makes one reverse pass through one rollout, step by step."""

    @property
    def batches(self) -> bool:
        """Whether it treats each scene of a batch by itself; one of your own has to say so."""
        return False

    @abstractmethod
    def derivative(self, rollout: Rollout) -> BackwardStep:
        """The backward step for one rollout."""

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """See `GradientEstimator`."""
        forward_pass = problem.forward_pass(parameters)
        return Estimate(forward_pass.loss, forward_pass.back(self, observe))


class Filtered:
    """The backward step of another estimator, followed by a filter of the adjoint."""

    only_launches: ClassVar[bool] = False
    """Whether `filter` does nothing but launch kernels, always the same ones. Only then may a backward step be captured
    as a graph, which repeats launches, and not what Python or NumPy do between them."""

    def __init__(self, base: BackwardStep):
        self._base, self.rollout, self.solver = base, base.rollout, base.solver
        self.capturable = base.capturable and self.only_launches

    def begin(self) -> None:
        self._base.begin()

    def step(self, state: State, counts: Counts, bar: State) -> None:
        self._base.step(state, counts, bar)
        self.filter(bar)

    def parameters(self) -> Parameters:
        return self._base.parameters()

    def filter(self, bar: State) -> None:
        """Change the adjoint of the state whose step the solver has replayed last."""
        raise NotImplementedError
