"""Differences along what a surrogate gradient says: first and zeroth order together."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cortado.arrays import require_at_most, require_whole
from cortado.errors import ComputationError
from cortado.gradients.ensemble import EnsembleMean, joined, mean_and_error, require_pairs
from cortado.gradients.ensemble_members import MOST_SAMPLES, Ensemble, Sampler
from cortado.gradients.estimator import Differentiable, Estimate, GradientEstimator, checked_estimator
from cortado.gradients.filters import AdjointViscosity
from cortado.gradients.left_out import remaining
from cortado.gradients.points import Point
from cortado.rollout.rollout import Observer
from cortado.scene.parameters.values import Arrays, Values

SURROGATE = AdjointViscosity()


@dataclass(frozen=True)
class Guided(Ensemble):
    """The mean of a surrogate's gradients over an ensemble, each of its parts scaled by differences of the loss.

    Formula: in units of the spreads, the mean of the surrogate's gradients is cut along the first axis of each
    parameter, the steps or knots, into equal parts: p_1 ... p_K are their directions, of length 1, and

        g = sum_k D_k p_k,   D_k = mean over samples of (L(u + r_k p_k) - L(u - r_k p_k)) / (2 r_k),   r_k = sqrt(N_k),

    where N_k is how many numbers of part k are not 0; first positions are perturbed in the same way on both sides. So g
    is the projection of the smoothed gradient on the span of the parts (guided evolution strategies, Maheswaranathan
    et al. 2019, without their search outside of the span).

    Bias: what the surrogate does not point at is missed; but sizes, over time too, are those of the smoothed loss.
    Noise: the ``standard_error`` of the `Estimate` is that of the D_k and of the directions p_k together, with degrees
    of freedom by Welch and Satterthwaite. Cost: ``samples`` gradients of the surrogate and 1 + 2 K ``differences``
    forward runs, however many numbers a parameter has.

    Runs that diverge: as in `EnsembleMean` for the surrogate's; a sample of the differences is left out as a whole, up
    to a quarter of them, so that all D_k are means over the same samples. With fewer than 4 none can be left out.
    """

    samples: int = 4
    """Gradients of the surrogate, an even number."""
    parts: int = 4
    """Of each parameter; fewer where it has fewer rows, and one for a vector or a number."""
    differences: int = 2
    """Samples of each difference."""
    surrogate: GradientEstimator = SURROGATE
    """The estimator whose gradients give the directions."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_pairs(self.samples)
        require_whole("parts", self.parts, 1)
        require_whole("differences", self.differences, 2)
        for name in ("parts", "differences"):
            require_at_most(name, getattr(self, name), MOST_SAMPLES)
        checked_estimator(self.surrogate)

    def estimate(self, problem: Differentiable, parameters: Values, observe: Observer | None = None) -> Estimate:
        """``observe`` is called with the adjoints of the surrogate's samples."""
        ensemble = self.around(problem, parameters, draw=1)
        surrogate = EnsembleMean(
            self.spread, self.samples, self.position_noise, self.seed, self.surrogate, executor=self.executor
        ).estimate(problem, parameters, observe)
        assert surrogate.standard_error is not None and surrogate.degrees_of_freedom is not None
        parts, turns = self._parts(ensemble, surrogate.gradient, surrogate.standard_error)
        self.require_memory(2 * self.differences * len(parts), 0)
        reach = [np.sqrt(np.count_nonzero(part)) for part in parts]

        def points() -> Iterator[Point]:
            for _ in range(self.differences):
                displacement = ensemble.displacement()
                for r, part in zip(reach, parts, strict=True):
                    yield ensemble.sample(r * part, displacement)
                    yield ensemble.sample(-r * part, displacement)

        runs = self.evaluated(problem, points(), None)
        kept = remaining(runs, self.differences, "samples of the differences")
        pairs = np.array([one.loss for one in runs]).reshape(self.differences, len(parts), 2)[kept]
        slopes = (pairs[..., 0] - pairs[..., 1]) / (2.0 * np.array(reach))
        sizes, size_errors = mean_and_error(slopes)
        along, across = (np.reshape(rows, (-1, len(ensemble.spreads))) for rows in (parts, turns))
        errors = np.array([size_errors @ np.abs(along), np.abs(sizes) @ across])
        gradient, error = (ensemble.named(one / ensemble.spreads) for one in (sizes @ along, np.hypot(*errors)))
        freedom = _freedom(errors, (len(pairs) - 1, surrogate.degrees_of_freedom))
        left_out = surrogate.left_out + len(runs) // self.differences * int(np.count_nonzero(~kept))
        return Estimate(surrogate.loss, gradient, error, freedom, left_out)

    def _parts(self, ensemble: Sampler, gradient: Arrays, error: Arrays) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """(numbers,) each, of length 1, in spreads: the gradient on one part of one parameter, 0 elsewhere; and its
        standard error. Parts without a gradient are left out."""
        places = np.concatenate([_places(value, self.parts) for value in ensemble.values.values()])
        firsts = np.cumsum([0, *(value.size for value in ensemble.values.values())])
        places += self.parts * np.repeat(np.arange(len(firsts) - 1), np.diff(firsts))
        whole, errors = (ensemble.spreads * joined(one, ensemble.values) for one in (gradient, error))
        greatest = np.abs(whole).max()
        if not np.isfinite(greatest):
            raise ComputationError(
                f"The gradient of {self.surrogate!r} is not finite, so that Guided has no direction; take another "
                "surrogate, or fewer steps."
            )
        whole, errors = (one / (greatest or 1.0) for one in (whole, errors))  # so that no square overflows
        lengths = {k: np.linalg.norm(whole[places == k]) for k in np.unique(places)}
        parts, turns = (
            [np.where(places == k, one, 0.0) / length for k, length in lengths.items() if length]
            for one in (whole, errors)
        )
        return parts, turns


def _places(value: np.ndarray, parts: int) -> np.ndarray:
    """(size,) for each number of a parameter, the part that its row belongs to; 0 for a vector and a number."""
    rows = len(value) if value.ndim > 1 else 1
    return np.repeat(np.arange(rows) * parts // rows, value.size // rows)


def _freedom(errors: np.ndarray, freedoms: tuple[float, float]) -> float:
    """Degrees of freedom of the sum of two errors (2, numbers) that have their own (Welch 1947)."""
    shares = (errors**2).sum(axis=1) / max((errors**2).sum(), np.finfo(float).tiny)
    return float(1.0 / max((shares**2 / freedoms).sum(), 1.0 / sum(freedoms)))
