"""Numbers with their standard errors, and fits."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, log10, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Estimate:
    """A number and its standard error; as text ``0.0473 ± 0.0012``."""

    value: float
    error: float

    @classmethod
    def of(cls, samples: ArrayLike) -> Estimate:
        """The mean of independent samples; the error of a single sample is nan."""
        found = np.asarray(samples, dtype=float)
        if len(found) < 2:
            return cls(float(found[0]), float("nan"))
        return cls(float(found.mean()), float(found.std(ddof=1)) / sqrt(len(found)))

    def over(self, other: Estimate) -> Estimate:
        """The ratio, of numbers with independent errors."""
        ratio = self.value / other.value
        return Estimate(ratio, abs(ratio) * float(np.hypot(self.error / self.value, other.error / other.value)))

    def __str__(self) -> str:
        if not np.isfinite(self.error) or self.error <= 0.0:
            return f"{self.value:.3g}"
        size = max(abs(self.value), self.error)
        power = floor(log10(size)) if not 1e-3 <= size < 1e5 else 0
        value, error = self.value / 10.0**power, self.error / 10.0**power
        decimals = max(0, 1 - floor(log10(error)))
        text = f"{value:.{decimals}f} ± {error:.{decimals}f}"
        return f"({text})e{power}" if power else text


@dataclass(frozen=True)
class Line:
    """y = slope x + offset."""

    slope: Estimate
    offset: Estimate

    @classmethod
    def through(cls, x: ArrayLike, y: ArrayLike) -> Line:
        """A line fitted by least squares; the errors assume equal variances, and need at least three points."""
        x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        if len(x) < 3:
            slope, offset = np.polyfit(x, y, 1)
            return cls(Estimate(float(slope), float("nan")), Estimate(float(offset), float("nan")))
        (slope, offset), covariance = np.polyfit(x, y, 1, cov=True)
        errors = np.sqrt(np.diag(covariance))
        return cls(Estimate(float(slope), float(errors[0])), Estimate(float(offset), float(errors[1])))


def growth_rate(steps: ArrayLike, sizes: ArrayLike) -> float:
    """lambda of sizes ~ exp(lambda step), by least squares over their logarithms; nan with fewer than three."""
    steps, sizes = np.asarray(steps, dtype=float), np.asarray(sizes, dtype=float)
    return float(np.polyfit(steps, np.log(sizes), 1)[0]) if len(steps) >= 3 else float("nan")


def geometric_mean(values: ArrayLike) -> float:
    """The geometric mean of positive values; a value that underflowed to 0 counts as 1e-300."""
    return float(np.exp(np.log(np.maximum(values, 1e-300)).mean()))


def norms(vectors: ArrayLike) -> NDArray[np.float64]:
    """Euclidean norms (frames,) of (frames, n, d); inf where a square overflows."""
    with np.errstate(over="ignore", invalid="ignore"):
        found = np.sqrt((np.asarray(vectors) ** 2).sum(axis=(1, 2)))
    return np.where(np.isnan(found), np.inf, found)
