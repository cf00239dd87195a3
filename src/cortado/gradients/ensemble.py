"""The gradient of a loss averaged over a cloud, from forward runs alone or from gradients that stay small."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from cortado.errors import InputError, shown
from cortado.gradients.ensemble_members import Cloud
from cortado.gradients.estimator import Differentiable, Estimate, Policy, checked_policy, tuned
from cortado.gradients.filters import AdjointSmoothing
from cortado.parameters.values import Arrays, Values
from cortado.rollout import Observer

SMOOTHING = AdjointSmoothing(order=2)
MOST_NUMBERS = 64
"""Numbers that differences may be taken along: each costs two runs a sample."""


@dataclass(frozen=True)
class Smoothed(Cloud):
    """Central differences, averaged over a cloud of parameters and first states: the reference beyond chaos.

    Formula: for parameters u of N numbers, each in units of its spread h,

        g = mean over samples of sum_k (L(u + r q_k) - L(u - r q_k)) / (2 r) q_k,   r = sqrt(N),

    with q_1 ... q_N an orthonormal basis, turned at random in every sample, and first positions perturbed, the same way
    on both sides of a difference. It is the gradient of the loss averaged over the ball of a `Cloud`, of radius
    h sqrt(N) (randomised smoothing, in antithetic and orthogonal directions).

    Bias: features of the loss narrower than the spread are lost, as they should be; noise, which `Estimate`'s
    ``standard_error`` tells. Cost: 2 N samples forward runs, so that it is for a few dozen numbers at most.
    """

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        cloud = self.around(problem, parameters)
        loss, numbers = problem.value(cloud.values), len(cloud.spreads)
        if numbers > MOST_NUMBERS:
            raise InputError(
                f"the parameters are {numbers} numbers, but must be {MOST_NUMBERS} at most, as Smoothed runs the "
                "simulation twice for each: take fewer, such as one gravity for all steps, or another policy."
            )
        found, r = np.zeros((self.samples, numbers)), np.sqrt(numbers)
        for sample in found:
            for q in cloud.rotation():
                displacement = cloud.displacement()
                ahead, behind = (cloud.at(side * q, displacement, problem.value) for side in (r, -r))
                sample += (ahead - behind) / (2.0 * r) * q
        gradient, error = (cloud.named(one / cloud.spreads) for one in _mean_and_error(found))
        return Estimate(loss, gradient, standard_error=error)


@dataclass(frozen=True)
class Averaged(Cloud):
    """Gradients of another policy, averaged over a cloud of parameters and first states: an ensemble mean.

    Formula: g = mean over points of the cloud of the policy's gradient there. It is the gradient of the loss that
    `Smoothed` differentiates, as far as the policy's are right, for any number of parameters. Of `Exact` gradients
    beyond chaos the mean is useless, as few of them drown the rest.

    Bias: that of the policy; the perturbed first positions' part of the loss, where that is small; noise, which
    `Estimate`'s ``standard_error`` tells. Cost: ``samples`` times that of the policy, and a forward run.
    """

    samples: int = 4
    """An even number, as points come in pairs of opposite ones."""
    policy: Policy = SMOOTHING
    """Whose gradients are averaged. The strength of an `AdjointSmoothing` is found once, at the parameters."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.samples % 2 or self.samples < 4:
            raise InputError(f"samples is {shown(self.samples)}, but must be an even number of at least 4.")
        checked_policy(self.policy)

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """``observe`` is given the adjoints of one point after the other."""
        cloud = self.around(problem, parameters)
        loss, policy = problem.value(cloud.values), tuned(self.policy, problem, cloud.values)
        made = partial(policy.estimate, problem, observe=observe)
        pairs = []
        for _ in range(self.samples // 2):
            u, displacement = cloud.offset(), cloud.displacement()
            pairs.append([cloud.at(side * u, side * displacement, made) for side in (1.0, -1.0)])
        means = [np.mean([_numbers(one.gradient, cloud.values) for one in pair], axis=0) for pair in pairs]
        gradient, error = (cloud.named(one) for one in _mean_and_error(np.array(means)))
        return Estimate(loss, gradient, pairs[-1][-1].strength, error)

    def tuned(self, problem: Differentiable, parameters: Values) -> "Averaged":
        """The same with a policy that is tuned here."""
        return replace(self, policy=tuned(self.policy, problem, parameters))


def _mean_and_error(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of rows, and its standard error."""
    return samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


def _numbers(gradient: Arrays, names: Iterable[str]) -> np.ndarray:
    """Of these parameters, one after another."""
    return np.concatenate([gradient[name].ravel() for name in names])
