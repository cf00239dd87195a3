"""Standard errors of a least-squares estimate if residuals are correlated within a frame and from frame to frame.

Near the estimate, the residuals are r = e - J t with the noise e (frames, m), the Jacobian J (frames, m, parameters)
and the error t of the estimate. The m numbers of a frame are not independent: neighbouring pixels vary together, and so
does all light of a frame.

1. The correlation of noise at two times is exp(-dt / T), where dt is the difference of the times. The correlation time
   T is chosen to reproduce the correlation of residuals in neighbouring frames (`correlation_time`). `whitened` removes
   the correlation in time from the frames of a second fit.
2. Within a frame the noise has an arbitrary covariance C, which is the same for every frame. The covariance of the
   score J^T e is the sum

       B = sum_f J_f^T C J_f  with  C = 1 / F sum_h r_h r_h^T.

   The indices f and h run over F frames, and r_h are whitened residuals. The sum B uses F times as many samples as the
   cluster-robust sum of (J_f^T r_f)(J_f^T r_f)^T (Liang and Zeger 1986). The fitted parameters have the covariance
   N^-1 B N^-1, where N = sum_f J_f^T J_f is the Hessian.
3. The fit absorbs a part of the noise, and B is corrected for the mean of this part. The degrees of freedom of
   Student's distribution follow Satterthwaite (1946).
4. The correlation time T also has an error. The variance of an estimate is proportional to (1 + c) / (1 - c), where c
   is the correlation from frame to frame. The variance of the correlation c is (1 - c^2) / n for n independent numbers.
   To second order, this error of c makes B larger by the factor 1 + 2 / (n (1 - c)) on average.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cortado.errors import ComputationError
from cortado.optimisation.fitting.least_squares import LeastSquares, Linearised, Part, Weighting, Weights, weighted

LONGEST = 3.0
"""Greatest correlation time, relative to the duration of the measurement."""
SHORTEST = 0.05
"""Least correlation time of correlated noise, relative to the time between two frames."""


@dataclass(frozen=True)
class Products:
    S: np.ndarray
    """Products of the Jacobians of two frames and the noise covariance (F, F, p, p)."""
    K: np.ndarray
    """Products of two frames' Jacobians (F, F, p, p)."""
    gram: np.ndarray
    """Products of two frames' residuals (F, F)."""

    @classmethod
    def of(cls, J: np.ndarray, r: np.ndarray) -> "Products":
        F = len(r)
        flat = J.transpose(0, 2, 1).reshape(-1, J.shape[1])
        scores = (flat @ r.T).reshape(F, -1, F)
        S = np.einsum("fpk,gqk->fgpq", scores, scores, optimize=True) / F
        return cls(S, (flat @ flat.T).reshape(F, J.shape[2], F, -1).transpose(0, 2, 1, 3), r @ r.T)


@dataclass(frozen=True)
class ScoreCovariance:
    B: np.ndarray
    """Covariance (p, p) of the score, which is the transposed Jacobian times the noise."""
    products: Products
    lost: float
    """Mean fraction of the noise covariance that the fit absorbs."""
    samples: float
    frames: float

    def degrees_of_freedom(self, inverse: np.ndarray, direction: np.ndarray) -> float:
        """Return the degrees of freedom of the estimate along ``direction`` (p,), as in Satterthwaite (1946)."""
        F, a = len(self.products.gram), inverse @ direction
        total, spread = _moments(np.einsum("p,fgpq,q->fg", a, self.products.S, a, optimize=True), F)
        return max(min(F * total / spread * (1.0 - self.lost), self.frames * self.samples), 1.0)


def correlation_time(J: np.ndarray, r: np.ndarray, inverse: np.ndarray, times: np.ndarray) -> float:
    """Estimate the correlation time of the noise [s], or 0 without correlation. ``inverse`` is the inverse Hessian."""
    from scipy.optimize import brentq

    products, gap = Products.of(J, r), float(np.median(np.diff(times)))
    gram, total = products.gram, float(np.trace(products.gram))
    if not total > 0.0:
        return 0.0
    taken = np.einsum("pq,khqp->hk", inverse, products.S, optimize=True)  # tr J_h N^-1 J_k^T C
    found = float(np.diag(gram, 1).sum()) / total

    def excess(logarithm: float) -> float:
        R = np.exp(-np.abs(times[:, None] - times) / np.exp(logarithm))
        V = inverse @ np.einsum("kl,klpq->pq", R, products.S, optimize=True) @ inverse
        expected = R * total / len(r) - taken @ R - (taken @ R).T + np.einsum("pq,ghqp->hg", V, products.K)
        return float(np.diag(expected, 1).sum() / np.trace(expected)) - found

    shortest, longest = np.log(SHORTEST * gap), np.log(LONGEST * (times[-1] - times[0]))
    if excess(shortest) >= 0.0:
        return 0.0
    if excess(longest) <= 0.0:
        return float(np.exp(longest))
    return float(np.exp(brentq(excess, shortest, longest, xtol=1e-3)))


def independent_frames(times: np.ndarray, correlation_time: float) -> float:
    """Return the effective number of frames, F (1 - c) / (1 + c), for a correlation c of neighbouring frames."""
    c = np.exp(-np.median(np.diff(times)) / correlation_time) if correlation_time else 0.0
    return float(len(times) * (1.0 - c) / (1.0 + c))


def score_covariance(J: np.ndarray, r: np.ndarray, inverse: np.ndarray, frames: float) -> ScoreCovariance:
    """Estimate the score's covariance from whitened residuals (F, m), Jacobians (F, m, p) and the inverse Hessian."""
    F, products = len(r), Products.of(J, r)
    B = np.einsum("ffpq->pq", products.S)
    once = np.einsum("fhpq,qr,hfrs->ps", products.K, inverse, products.S, optimize=True) / F
    twice = np.einsum("fhpq,qr,hfrs->ps", products.K, inverse @ B @ inverse, products.K, optimize=True) / F
    taken = once + once.T - twice
    total, spread = _moments(products.gram / F, F)
    size, axes = np.linalg.eigh(B)
    kept = size > 1e-14 * max(size.max(), 0.0)
    root = axes[:, kept] * np.sqrt(size[kept])
    relative = np.linalg.pinv(root) @ taken @ np.linalg.pinv(root).T
    share, along = np.linalg.eigh(0.5 * (relative + relative.T))
    share = np.clip(share, 0.0, 0.9)  # with too few frames the fit absorbs nearly everything
    grown = root @ (along / (1.0 - share)) @ along.T @ root.T
    lost, samples = float(share.mean()) if len(share) else 0.0, max(total / spread, 1.0)
    c = (F - frames) / (F + frames)
    return ScoreCovariance(grown * (1.0 + 2.0 / (F * samples * (1.0 - c))), products, lost, samples, frames)


def _moments(gram: np.ndarray, F: int) -> tuple[float, float]:
    """Return unbiased estimates of (tr C)^2 and tr C^2 for a covariance matrix C, from products of F samples."""
    trace, square = float(np.trace(gram)), float((gram**2).sum())
    if not trace > 0.0:
        return 1.0, 1.0
    spread = (square - trace**2 / F) / (1.0 + 1.0 / F - 2.0 / F**2)
    spread = max(spread, 1e-9 * trace**2)
    return max(trace**2 - 2.0 * spread / F, spread), spread


@dataclass(frozen=True, eq=False)
class FittedPart:
    part: Part
    weighting: Weighting
    residuals: np.ndarray
    """Predicted minus measured numbers (frames, m), in the unit of the observation. Ignored numbers have residual 0."""
    spread: float
    samples: float
    frames: float

    @property
    def label(self) -> str:
        return self.part.label

    @property
    def correlation_time(self) -> float:
        return self.weighting.correlation_time


@dataclass(frozen=True)
class Certainty:
    hessian: np.ndarray
    """Hessian (free, free) of the weighted sum of squares."""
    covariance: np.ndarray
    """Covariance (free, free) of the fitted coordinates."""
    degrees_of_freedom: np.ndarray
    """Degrees of freedom (free,) of Student's t-distribution."""
    scores: tuple[ScoreCovariance, ...]
    parts: tuple[FittedPart, ...]

    @classmethod
    def of(cls, problem: LeastSquares, at: Linearised, weights: Weights) -> "Certainty":
        N = hessian(problem, at, weights)
        N_inverse = inverse(problem, N)
        scores, parts = list[ScoreCovariance](), list[FittedPart]()
        white, slopes = (weighted(problem.parts, weights, own) for own in (at.residuals, at.jacobians))
        for part, weight, r, own, J in zip(problem.parts, weights, at.residuals, white, slopes, strict=True):
            frames = independent_frames(part.observation.times, weight.correlation_time)
            score = score_covariance(J, own, N_inverse, frames)
            scores.append(score)
            parts.append(FittedPart(part, weight, r, spread(r), score.samples, frames))
        covariance: Any = N_inverse @ sum(score.B for score in scores) @ N_inverse
        freedom = []
        for unit in np.eye(len(at.u)):  # of a variance that is a sum over parts (Welch 1947)
            a = N_inverse @ unit
            variances = np.array([a @ score.B @ a for score in scores])
            each = np.array([score.degrees_of_freedom(N_inverse, unit) for score in scores])
            welch = variances.sum() ** 2 / (variances**2 / each).sum() if variances.any() else each.min()
            freedom.append(float(welch))
        return cls(N, covariance, np.array(freedom), tuple(scores), tuple(parts))


def noise_of(problem: LeastSquares, at: Linearised, weights: Weights) -> list[Weighting]:
    """Return weights from the residuals of a first fit. Correlated residuals have smaller weights."""
    N_inverse = inverse(problem, hessian(problem, at, weights))
    found = []
    for part, r, J, weight in zip(problem.parts, at.residuals, at.jacobians, weights, strict=True):
        times, size = part.observation.times, part.observation.noise or spread(r) or weight.scale
        time = correlation_time(weight.of(J, times), weight.of(r, times), N_inverse, times)
        J, r = Weighting(size, time).of(J, times), Weighting(size, time).of(r, times)
        # the ratio of the score's variance to that for independent residuals in a frame
        independent = np.einsum("fmp,fmp->p", J, J) * np.mean(r**2)
        pooled, has = np.einsum("fmp,hm->fhp", J, r, optimize=True), independent > 0.0
        ratios = (pooled**2).sum(axis=(0, 1))[has] / len(r) / independent[has]
        found.append(Weighting(size * np.sqrt(float(np.mean(ratios)) if has.any() else 1.0), time))
    return found


def hessian(problem: LeastSquares, at: Linearised, weights: Weights) -> np.ndarray:
    flat = (J.reshape(-1, len(at.u)) for J in weighted(problem.parts, weights, at.jacobians))
    return np.asarray(sum(J.T @ J for J in flat))


def inverse(problem: LeastSquares, N: np.ndarray) -> np.ndarray:
    """Return the inverse of the Hessian N (free, free), or raise `ComputationError` if there is none."""
    labels, size = problem.labels, np.sqrt(np.diag(N))
    if not np.isfinite(N).all():
        raise ComputationError("The derivatives are not finite: try fewer steps, or float64.")
    if not size.all():
        lost = [label for label, s in zip(labels, size, strict=True) if not s]
        raise ComputationError(f"The measurements do not depend on {', '.join(lost)}: fit only other parameters.")
    eigenvalues, axes = np.linalg.eigh(N / np.outer(size, size))
    if eigenvalues[0] < 1e-10:
        mixed = [label for label, a in zip(labels, axes[:, 0], strict=True) if abs(a) > 0.1]
        said = f"The measurements do not distinguish {' and '.join(mixed)}"
        raise ComputationError(f"{said}: fit fewer parameters, or add measurements of another quantity.")
    return np.asarray((axes / eigenvalues) @ axes.T / np.outer(size, size))


def spread(r: np.ndarray) -> float:
    """Return the root mean square of the non-zero residuals."""
    return float(np.sqrt((r**2).sum() / max(np.count_nonzero(r), 1)))
