"""The rows of the leaderboard: a new one is an entry in `ESTIMATORS`.

Each is made for the spread of a control and a seed, which differs from that of the truth.
"""

from collections.abc import Callable

from cortado.gradients import (
    AdjointViscosity,
    EnsembleMean,
    Exact,
    GradientEstimator,
    Guided,
    RandomizedSmoothing,
)

from .averages import MedianOfMeans, TrimmedMean

ESTIMATORS: dict[str, Callable[[float, int], GradientEstimator]] = {
    "exact": lambda spread, seed: Exact(),
    "adjoint-viscosity": lambda spread, seed: AdjointViscosity(),
    "mean-of-8": lambda spread, seed: EnsembleMean(spread, 8, seed=seed),
    "mean-of-8-exact": lambda spread, seed: EnsembleMean(spread, 8, seed=seed, estimator=Exact()),
    "mean-of-8-viscosity": lambda spread, seed: EnsembleMean(spread, 8, seed=seed, estimator=AdjointViscosity()),
    "trimmed-mean-of-8": lambda spread, seed: TrimmedMean(spread, 8, seed=seed, estimator=AdjointViscosity()),
    "median-of-means-of-8": lambda spread, seed: MedianOfMeans(spread, 8, seed=seed, estimator=AdjointViscosity()),
    "guided": lambda spread, seed: Guided(spread, seed=seed),
    "guided-2-parts": lambda spread, seed: Guided(spread, parts=2, seed=seed),
    "guided-order-2": lambda spread, seed: Guided(spread, seed=seed, surrogate=AdjointViscosity(order=2)),
    "smoothing-2": lambda spread, seed: RandomizedSmoothing(spread, 2, seed=seed),
}
