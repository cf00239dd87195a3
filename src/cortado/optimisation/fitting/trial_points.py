"""Jacobians at the trial points of a search, which only run forward: slopes of what interpolates their residuals.

A search knows the Jacobian where it begins, and then the residuals at one point after another. Kriging interpolates
them all (Sacks, Welch, Mitchell and Wynn 1989): a linear function, and noise of the covariance of Matérn with index 7/2
that goes through what it leaves. The slopes of the interpolant are the estimate of the Jacobian. Near points tell the
slopes between them, far ones the curvature, as far as the residuals are smooth, which their likelihood says.
"""

from collections.abc import Sequence

import numpy as np

from cortado.optimisation.fitting.least_squares import LeastSquares, Linearised, Weighting

HARD_BY = 1e-3
"""Of the size of the residuals: by so much they change up to the points that stand for the first Jacobian."""
MOST = 5
"""Points for each coefficient of a linear function, at which they become too many."""
WIDTHS = (0.1, 1.0, 3.0)
"""Of the covariance, from rough to smooth residuals, relative to the greatest distance between two points."""
ROUND_OFF = 1e-12
"""Of a variance."""
TINY = 1e-300
"""In the place of 0 below a fraction."""


class TrialPoints:
    """Points with their residuals, in coordinates in which the first Jacobian is orthonormal: it knows no units."""

    def __init__(self, problem: LeastSquares, weights: Sequence[Weighting], at: Linearised):
        J, r = problem.stacked(at, weights)
        self._metric = np.asarray(np.linalg.qr(J, mode="r"))
        self._scales = [weight.scale for weight in weights]
        self._points, self._residuals = [at.u], [at.residuals]
        changes = HARD_BY * np.linalg.norm(r) / np.maximum(np.linalg.norm(J, axis=0), TINY)
        for k, change in enumerate(changes):
            moved = [r + change * J[..., k] for r, J in zip(at.residuals, at.jacobians, strict=True)]
            self.add(at.u + change * np.eye(len(at.u))[k], moved)

    def add(self, u: np.ndarray, residuals: list[np.ndarray]) -> int:
        """A point that was run; returns its number."""
        self._points.append(u)
        self._residuals.append(residuals)
        return len(self._points) - 1

    @property
    def are_many(self) -> bool:
        """Whether to begin anew from the lowest, before they take too much memory."""
        return len(self._points) >= MOST * (len(self._points[0]) + 1)

    def linearised(self, number: int) -> Linearised:
        """At one of the points."""
        x = np.array(self._points) @ self._metric.T
        parts = [np.array(part) for part in zip(*self._residuals, strict=True)]
        flat = [part.reshape(len(x), -1) / scale for part, scale in zip(parts, self._scales, strict=True)]
        products = np.sum([part @ part.T for part in flat], axis=0)
        weights = self._metric.T @ slope_weights(x, products, number)
        jacobians = [np.tensordot(part, weights, (0, 1)) for part in parts]
        return Linearised(self._points[number], self._residuals[number], jacobians)


def slope_weights(x: np.ndarray, products: np.ndarray, number: int) -> np.ndarray:
    """(d, points) weights of the values at points ``x`` (points, d), whose sums are the slopes at one of the points of
    what interpolates them. ``products`` (points, points) of the values at two points, summed over all residuals."""
    from scipy.spatial.distance import cdist

    points, d = x.shape
    size = max(float(cdist(x, x).max()), TINY)
    x = (x - x[number]) / size
    linear, apart = np.column_stack([np.ones(points), x]), cdist(x, x)
    width = _most_likely_width(apart, linear, products)
    system = np.block([[_covariance(apart / width), linear], [linear.T, np.zeros((d + 1, d + 1))]])
    near = apart[:, [number]] / width
    of_noise = (3.0 + 3.0 * near + near**2) * np.exp(-near) / 15.0 * x / width**2
    slopes = np.vstack([of_noise, np.zeros(d), np.eye(d)])
    return np.asarray(np.linalg.lstsq(system, slopes)[0][:points].T / size)


def _covariance(apart: np.ndarray) -> np.ndarray:
    """Of the noise at points that are so many widths apart."""
    smooth = (1.0 + apart + 0.4 * apart**2 + apart**3 / 15.0) * np.exp(-apart)
    return smooth + ROUND_OFF * np.eye(len(apart))


def _most_likely_width(apart: np.ndarray, linear: np.ndarray, products: np.ndarray) -> float:
    """That with the greatest likelihood of the contrasts that no linear function changes; a single one tells none."""
    from scipy.linalg import null_space

    contrasts = null_space(linear.T)
    count = contrasts.shape[1]
    if count < 2:
        return 1.0
    found = contrasts.T @ products @ contrasts

    def deviance(width: float) -> float:
        K = contrasts.T @ _covariance(apart / width) @ contrasts
        variance = float(np.trace(np.linalg.solve(K, found)))
        return count * np.log(max(variance, TINY)) + float(np.linalg.slogdet(K)[1])

    return min(WIDTHS, key=deviance)
