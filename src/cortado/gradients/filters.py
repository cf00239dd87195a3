"""Estimators that change the adjoint between two backward steps of another estimator."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from cortado.device.state import State
from cortado.errors import InputError, shown
from cortado.gradients.adjoint_filters import FIELDS, AdjointNorms, Average, Drag, Limit
from cortado.gradients.estimator import AdjointEstimator, Differentiable, Estimate, Filtered, ForwardPass
from cortado.gradients.exact import Exact
from cortado.gradients.strength import sufficient
from cortado.parameters.values import Arrays, Values
from cortado.rollout import BackwardStep, Observer, Rollout

EXACT = Exact()


@dataclass(frozen=True)
class AdjointViscosity(AdjointEstimator):
    """The adjoint, blended after each backward step with its average over neighbours: an eddy viscosity of the adjoint.

    Formula: for each field a of the adjoint, over the fluid neighbours of the state that it belongs to,

        a_i <- a_i + strength sum_j w_ij (a_j - a_i),   w_ij = W_ij / max(s_i, s_j, W(h / 2)),   s_i = sum_j W_ij.

    The weights are symmetric and add up to 1 at most: sum_i a_i is kept, the square norm does not grow. What grows
    exponentially in an adjoint lives at the scale of particles, the response to a parameter at that of the fluid: a
    step damps a wave of length l by about strength (2 pi / l)^2 s_W^2 / 2, s_W^2 being the second moment of W.

    Then each vector of a is limited to ``limit`` root mean squares over all particles: now and then the adjoint of a
    few particles grows faster than the average can spread it, and would dominate the rest.

    Long waves are damped too, a little, and most of all the gradient with respect to early steps. With
    an ``order`` of 2 the gradients g(s) and g(2 s) of two strengths, neither of which grows exponentially, are
    extrapolated to a strength of 0 (Richardson): g = 2 g(s) - g(2 s).

    Bias: the short waves of the adjoint are lost, and of the long ones a part that falls as s^order. Noise: with the
    second order up to 3 times as much, so that it is for means over several runs (`EnsembleMean`). The gradient of a
    loss of single particles, which has no long waves, is poor. Cost: ``order`` reverse passes, with one more sum over
    neighbours for each field and step; with "auto" some more reverse passes through the same run (see
    `gradients.strength`), which a search saves by `tuned`.
    """

    strength: float | Literal["auto"] = "auto"
    """s, up to 1 / ``order``; 0 is the base estimator bit for bit; "auto" is ``order`` + 1 times the smallest at which
    the adjoint does not grow exponentially, at most 1 / ``order``; it is the ``strength`` of the `Estimate`."""
    fields: tuple[str, ...] = FIELDS
    """Of "positions" and "velocities"."""
    limit: float = 4.0
    """Greatest vector of a particle, in root mean squares over all; infinite for none. Not applied with a strength of
    0."""
    order: int = 1
    """1, or 2 for an extrapolation. As the base of another estimator this one is not extrapolated."""
    base: AdjointEstimator = EXACT
    """The estimator whose adjoint is filtered."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "fields", tuple(self.fields))
        if not (isinstance(self.limit, (int, float, np.number)) and self.limit >= 1.0):
            raise InputError(f"limit is {shown(self.limit)}, but must be a number of at least 1.")
        if not self.fields or not set(self.fields) <= set(FIELDS):
            raise InputError(f"fields is {shown(self.fields)}, but must be some of {', '.join(FIELDS)}.")
        if type(self.order) is not int or self.order not in (1, 2):
            raise InputError(f"order is {shown(self.order)}, but must be 1 or 2.")
        number = isinstance(self.strength, (int, float, np.number)) and 0.0 <= self.strength * self.order <= 1.0
        if not (number or self.strength == "auto"):
            most = shown(1.0 / self.order)
            wanted = f'a number from 0 to {most} with an order of {self.order}, or "auto"'
            raise InputError(f"strength is {shown(self.strength)}, but must be {wanted}.")

    @property
    def batches(self) -> bool:
        return self.strength != "auto" and self.base.batches

    def derivative(self, rollout: Rollout) -> "ViscousStep":
        if self.strength == "auto":
            raise InputError('strength is "auto", but must be a number where it is the base of another estimator.')
        return ViscousStep(self.base.derivative(rollout), rollout, self)

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """``observe`` is called with the adjoints of the smaller strength."""
        forward_pass = problem.forward_pass(parameters)
        strength = self._sufficient(forward_pass) if self.strength == "auto" else float(self.strength)
        gradient = self._back(forward_pass, strength, observe)
        if strength > 0.0 and self.order == 2:
            twice = self._back(forward_pass, 2.0 * strength)
            gradient = {name: 2.0 * once - twice[name] for name, once in gradient.items()}
        return Estimate(forward_pass.loss, gradient, strength=strength)

    def tuned(self, problem: Differentiable, parameters: Values) -> "AdjointViscosity":
        """The same with the strength that "auto" finds here, for use at parameters nearby."""
        if self.strength != "auto":
            return self
        return replace(self, strength=self._sufficient(problem.forward_pass(parameters)))

    def _back(self, forward_pass: ForwardPass, strength: float, observe: Observer | None = None) -> Arrays:
        """The gradient with one strength."""
        derivative = forward_pass.derivative(replace(self, strength=0.0, order=1))
        assert isinstance(derivative, ViscousStep)
        derivative.set_strength(strength)
        return forward_pass.back(derivative, observe)

    def _sufficient(self, forward_pass: ForwardPass) -> float:
        rollout = forward_pass.rollout
        if rollout.solver.layout.batch is not None:
            raise InputError(
                'strength is "auto", but must be a number for a batch: take that of tuned() for one scene.'
            )
        norms = AdjointNorms(rollout.solver, rollout.steps)

        def history(strength: float) -> np.ndarray:
            self._back(forward_pass, strength, norms)
            return norms.numpy()

        time_step = float(rollout.parameters["time_step"].numpy()[0])
        return min((self.order + 1) * sufficient(history, time_step), 1.0 / self.order)


class ViscousStep(Filtered):
    """The backward step of `AdjointViscosity`."""

    only_launches = True

    def __init__(self, base: BackwardStep, rollout: Rollout, estimator: AdjointViscosity):
        super().__init__(base)
        self._average, self._limit = Average(base.solver, estimator.fields), Limit(base.solver, estimator.fields)
        self._parameters = rollout.parameters
        self._times = estimator.limit
        self.set_strength(float(estimator.strength))

    def set_strength(self, strength: float) -> None:
        """Set the strength of the following steps."""
        self._average.set_strength(strength)
        self._limit.set_times(self._times if strength > 0.0 else np.inf)

    def filter(self, bar: State) -> None:
        self._average(bar, self._parameters)
        self._limit(bar)


@dataclass(frozen=True)
class Damped(AdjointEstimator):
    """The adjoint, with that of velocities damped after each backward step.

    Formula: v^ <- exp(-rate dt) v^. Bias: the effect of earlier steps is reduced, by exp(-rate time), and that of long
    waves as much as that of short ones. Cost: hardly more than that of its base.
    """

    rate: float
    """[1 / s]"""
    base: AdjointEstimator = EXACT
    """The estimator whose adjoint is filtered."""

    def __post_init__(self) -> None:
        if not (isinstance(self.rate, (int, float, np.number)) and np.isfinite(self.rate) and self.rate >= 0.0):
            raise InputError(f"rate is {shown(self.rate)}, but must be a number of at least 0, in 1/s.")

    @property
    def batches(self) -> bool:
        return self.base.batches

    def derivative(self, rollout: Rollout) -> BackwardStep:
        return _DampedStep(self.base.derivative(rollout), rollout, self.rate)


class _DampedStep(Filtered):
    only_launches = True

    def __init__(self, base: BackwardStep, rollout: Rollout, rate: float):
        super().__init__(base)
        self._drag, self._parameters = Drag(base.solver, rate), rollout.parameters

    def filter(self, bar: State) -> None:
        self._drag(bar, self._parameters)
