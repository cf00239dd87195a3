"""The gradient of a loss averaged over an ensemble, by finite differences or as the mean of other estimators'
gradients."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from cortado.errors import InputError, shown
from cortado.gradients.ensemble_members import Ensemble
from cortado.gradients.estimator import Differentiable, Estimate, GradientEstimator, checked_estimate, checked_estimator
from cortado.gradients.filters import AdjointViscosity
from cortado.gradients.left_out import remaining
from cortado.gradients.points import Point
from cortado.rollout.rollout import Observer
from cortado.scene.parameters.values import Arrays, Values

SMOOTHING = AdjointViscosity(order=2)
MOST_NUMBERS = 64
"""Components that differences are taken along at most: each costs two runs a sample."""


@dataclass(frozen=True)
class RandomizedSmoothing(Ensemble):
    """Central differences, averaged over an ensemble of parameters and first states: the reference for long runs.

    Formula: for parameters u of N numbers, each in units of its spread h,

        g = mean over samples of sum_k (L(u + r q_k) - L(u - r q_k)) / (2 r) q_k,   r = sqrt(N),

    with q_1 ... q_N an orthonormal basis, rotated at random in every sample, and first positions perturbed, in the same
    way on both sides of a difference. It is the gradient of the loss averaged over the ball of an `Ensemble`, of radius
    h sqrt(N) (randomised smoothing, in antithetic and orthogonal directions).

    Bias: features of the loss that are narrower than the spread are averaged out, as intended. Noise: the
    ``standard_error`` of the `Estimate`. Cost: 2 N forward runs a sample, so that it is for a few dozen numbers at
    most.

    Runs that diverge: their differences are left out, up to a quarter of all, and the sum over the others of the sample
    is scaled by N over their number. So the mean keeps its size, and has no bias from this as long as no direction
    diverges more often than others.
    """

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """``observe`` is not called, as there are no adjoints."""
        ensemble = self.around(problem, parameters)
        numbers = len(ensemble.spreads)
        if numbers > MOST_NUMBERS:
            raise InputError(
                f"the parameters are {numbers} numbers, but must be at most {MOST_NUMBERS}, as the simulation "
                "is run twice for each: take fewer, such as one gravity for all steps, or another estimator."
            )
        self.require_memory(2 * numbers * self.samples, numbers)
        directions, r = [], np.sqrt(numbers)

        def points() -> Iterator[Point]:
            yield Point(ensemble.values)
            for _ in range(self.samples):
                for q in ensemble.rotation():
                    displacement = ensemble.displacement()
                    directions.append(q)
                    yield ensemble.sample(r * q, displacement)
                    yield ensemble.sample(-r * q, displacement)

        at_them, *runs = self.evaluated(problem, points(), None)
        kept = remaining(runs, len(directions), "differences")
        found = np.zeros((self.samples, numbers))
        for k in np.flatnonzero(kept):
            found[k // numbers] += (runs[2 * k].loss - runs[2 * k + 1].loss) / (2.0 * r) * directions[k]
        counts = kept.reshape(self.samples, numbers).sum(axis=1)
        found = found[counts > 0] * (numbers / counts[counts > 0, None])
        gradient, error = (ensemble.named(one / ensemble.spreads) for one in mean_and_error(found))
        left_out = 2 * int(np.count_nonzero(~kept))
        return Estimate(at_them.loss, gradient, error, len(found) - 1, left_out)


@dataclass(frozen=True)
class EnsembleMean(Ensemble):
    """The mean of another estimator's gradients over an ensemble of parameters and first states.

    Formula: g = mean over points of the ensemble of the estimator's gradient there. It is the gradient of the loss that
    `RandomizedSmoothing` differentiates, as far as the estimator is right, and its cost does not depend on the number
    of parameters. The mean of `Exact` gradients of long runs is useless, as the largest few of them dominate it.

    Bias: that of the estimator; and where the loss is as small as the effect of the perturbed first positions, that
    effect. Noise: the ``standard_error`` of the `Estimate`. Cost: ``samples`` times that of the estimator, and a
    forward run.

    Samples that diverge: they are left out with the other one of their antithetic pair, up to a quarter of all pairs,
    so that what remains is as symmetric about the parameters as before; half a pair would shift the mean to its side.
    """

    samples: int = 4
    """An even number, as samples are drawn in antithetic pairs."""
    estimator: GradientEstimator = SMOOTHING
    """The estimator whose gradients are averaged."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_pairs(self.samples)
        checked_estimator(self.estimator)

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """``observe`` is called with the adjoints of one sample after the other."""
        ensemble = self.around(problem, parameters)
        displaced = ensemble.start.size if self.position_noise else 0
        self.require_memory(self.samples, 2 * len(ensemble.spreads) + displaced)

        def points() -> Iterator[Point]:
            yield Point(ensemble.values)
            for _ in range(self.samples // 2):
                u, displacement = ensemble.offset(), ensemble.displacement()
                yield ensemble.sample(u, displacement, self.estimator)
                yield ensemble.sample(-u, -displacement, self.estimator)

        at_them, *samples = self.evaluated(problem, points(), observe)
        kept = np.repeat(remaining(samples, self.samples // 2, "antithetic pairs"), 2)
        checked = [checked_estimate(samples[k], ensemble.values) for k in np.flatnonzero(kept)]
        numbers = np.array([joined(one.gradient, ensemble.values) for one in checked])
        gradient, error = (ensemble.named(one) for one in self.combined(numbers))
        return Estimate(at_them.loss, gradient, error, len(numbers) // 2 - 1, len(samples) - len(checked))

    def combined(self, gradients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The average (numbers,) of the gradients of the samples (samples, numbers), and its standard error: that of
        the means of antithetic pairs, which follow each other."""
        return mean_and_error((gradients[::2] + gradients[1::2]) / 2.0)


def require_pairs(samples: int) -> None:
    """Raises `InputError` unless there are two antithetic pairs of samples or more, to know how they scatter."""
    if samples % 2 or samples < 4:
        raise InputError(f"samples is {shown(samples)}, but must be an even number of at least 4.")


def mean_and_error(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean of the rows and its standard error, also of numbers whose squares overflow; no number where one is
    infinite."""
    size = np.abs(samples).max(initial=0.0)
    unit = size if 0.0 < size < np.inf else 1.0
    with np.errstate(invalid="ignore"):
        return samples.mean(axis=0), unit * (samples / unit).std(axis=0, ddof=1) / np.sqrt(len(samples))


def joined(gradient: Arrays, names: Iterable[str]) -> np.ndarray:
    """The gradient with respect to these parameters as one vector."""
    return np.concatenate([gradient[name].ravel() for name in names])
