"""Policies that change the adjoint between two backward steps of another policy."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from cortado.errors import InputError, shown
from cortado.parameter_values import Values
from cortado.particles import State
from cortado.policies.exact import Exact
from cortado.policies.policy import AdjointPolicy, Differentiable, Estimate, Filtered
from cortado.policies.strength import sufficient
from cortado.rollout import Observer, Rollout, StepDerivative
from cortado.solvers.adjoint_filters import FIELDS, AdjointNorms, Average, Drag, Limit

EXACT = Exact()


@dataclass(frozen=True)
class AdjointSmoothing(AdjointPolicy):
    """The adjoint, blended after each backward step with its average over neighbours: an eddy viscosity of the adjoint.

    Formula: for each field a of the adjoint, over the fluid neighbours of the state that it belongs to,

        a_i <- a_i + strength sum_j w_ij (a_j - a_i),   w_ij = W_ij / max(s_i, s_j),   s_i = sum_j W_ij.

    The weights are symmetric and add up to 1 at most: sum_i a_i is kept, the square norm does not grow. What grows
    exponentially in an adjoint lives at the scale of particles, the answer to a control at that of the fluid: a step
    damps a wave of length l by about strength (2 pi / l)^2 s_W^2 / 2, s_W^2 being the second moment of W.

    Then each vector of a is cut to ``limit`` root mean squares over all particles: now and then an adjoint grows at a
    few particles faster than a smoothing can spread it, and would drown the rest.

    Bias: a little of the long waves is damped too, more with a greater strength. Losses of single particles, which have
    no long waves, get no good gradient. Cost: a sum over neighbours a field and step; with "auto" several ways back
    through one run (see `policies.strength`).
    """

    strength: float | Literal["auto"] = "auto"
    """0 is the base policy bit for bit; "auto" twice the smallest at which the adjoint does not grow exponentially,
    reported as ``strength`` of the `Estimate`."""
    fields: tuple[str, ...] = FIELDS
    """Of "positions" and "velocities"."""
    limit: float = 4.0
    """Greatest vector of a particle, in root mean squares over all; infinite for none. Not applied with a strength of
    0."""
    base: AdjointPolicy = EXACT
    """Whose backward steps these are."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "fields", tuple(self.fields))
        if not (isinstance(self.limit, (int, float, np.number)) and self.limit >= 1.0):
            raise InputError(f"limit is {shown(self.limit)}, but must be a number of at least 1.")
        if not self.fields or not set(self.fields) <= set(FIELDS):
            raise InputError(f"fields is {shown(self.fields)}, but must be some of {', '.join(FIELDS)}.")
        number = isinstance(self.strength, (int, float, np.number)) and 0.0 <= self.strength <= 1.0
        if not (number or self.strength == "auto"):
            raise InputError(f'strength is {shown(self.strength)}, but must be a number from 0 to 1, or "auto".')

    def derivative(self, rollout: Rollout) -> "SmoothedStep":
        return SmoothedStep(self.base.derivative(rollout), rollout, self)

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        passage = problem.passage(parameters)
        derivative = passage.derivative(self)
        assert isinstance(derivative, SmoothedStep)
        if self.strength == "auto":
            rollout = passage.rollout
            norms = AdjointNorms(rollout.solver, rollout.steps)

            def history(strength: float) -> np.ndarray:
                derivative.set_strength(strength)
                passage.back(derivative, norms)
                return norms.numpy()

            time_step = float(rollout.parameters.time_step.numpy()[0])
            derivative.set_strength(sufficient(history, time_step))
        return Estimate(passage.loss, passage.back(derivative, observe), strength=derivative.strength)


class SmoothedStep(Filtered):
    """The backward step of `AdjointSmoothing`."""

    def __init__(self, base: StepDerivative, rollout: Rollout, policy: AdjointSmoothing):
        super().__init__(base)
        self._average, self._limit = Average(base.solver, policy.fields), Limit(base.solver, policy.fields)
        self._parameters = rollout.parameters
        self._times = policy.limit
        self.set_strength(0.0 if policy.strength == "auto" else float(policy.strength))

    def set_strength(self, strength: float) -> None:
        """From now on."""
        self.strength = strength
        self._average.set_strength(strength)
        self._limit.set_times(self._times if strength > 0.0 else np.inf)

    def filter(self, bar: State) -> None:
        self._average(bar, self._parameters)
        self._limit(bar)


@dataclass(frozen=True)
class Damped(AdjointPolicy):
    """The adjoint, with that of velocities damped after each backward step.

    Formula: v^ <- exp(-rate dt) v^. Bias: what happened earlier counts less, by exp(-rate time); long waves suffer as
    much as short ones. Cost: next to nothing over its base.
    """

    rate: float
    """[1 / s]"""
    base: AdjointPolicy = EXACT
    """Whose backward steps these are."""

    def __post_init__(self) -> None:
        if not (isinstance(self.rate, (int, float, np.number)) and np.isfinite(self.rate) and self.rate >= 0.0):
            raise InputError(f"rate is {shown(self.rate)}, but must be a number of at least 0, in 1/s.")

    def derivative(self, rollout: Rollout) -> StepDerivative:
        return _DampedStep(self.base.derivative(rollout), rollout, self.rate)


class _DampedStep(Filtered):
    def __init__(self, base: StepDerivative, rollout: Rollout, rate: float):
        super().__init__(base)
        self._drag, self._parameters = Drag(base.solver, rate), rollout.parameters

    def filter(self, bar: State) -> None:
        self._drag(bar, self._parameters)
