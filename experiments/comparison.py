"""The distance between two gradients, and the growth rate of a norm."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Gradient = Mapping[str, ArrayLike]
WINDOWS = 4
"""Parts of a history at most, from whose slopes the standard error of the whole slope is computed."""


@dataclass(frozen=True)
class Comparison:
    """The distance of a gradient from the true one, all components of all parameters as one vector."""

    relative_l2: float
    """|estimate - true| / |true|"""
    cosine: float
    """The cosine of the angle between them."""
    norm_ratio: float
    """|estimate| / |true|"""


def compare(estimate: Gradient, true: Gradient) -> Comparison:
    """Compare a gradient with the true one, with respect to the same parameters."""
    a, b = (np.concatenate([np.ravel(g[name]) for name in true]).astype(np.float64) for g in (estimate, true))
    size = np.linalg.norm(b)
    with np.errstate(divide="ignore", invalid="ignore"):
        return Comparison(
            relative_l2=float(np.linalg.norm(a - b) / size),
            cosine=float(a @ b / size / np.linalg.norm(a)),
            norm_ratio=float(np.linalg.norm(a) / size),
        )


@dataclass(frozen=True)
class Growth:
    """The growth of a norm that is multiplied by exp(rate) in each step."""

    rate: float
    """e-folds a step: the slope of a line fitted to the norm's logarithm."""
    error: float
    """Its standard error, from the slopes of `WINDOWS` parts."""

    def __str__(self) -> str:
        return f"{self.rate:.4f} ± {self.error:.4f} per step"


def growth(steps: ArrayLike, norms: ArrayLike) -> Growth:
    """The growth of norms (k,) over steps (k,), nan where there are fewer than 4; zeros and infinities are left out."""
    x, sizes = np.asarray(steps, dtype=float), np.asarray(norms, dtype=float)
    shown = np.isfinite(sizes) & (sizes > 0.0)
    x, y = x[shown], np.log(sizes[shown])
    parts = min(WINDOWS, len(x) // 2)
    if parts < 2:
        return Growth(np.nan, np.nan)
    slopes = [_slope(*part) for part in zip(np.array_split(x, parts), np.array_split(y, parts), strict=True)]
    return Growth(_slope(x, y), float(np.std(slopes, ddof=1) / np.sqrt(parts)))


def _slope(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    return float(np.polyfit(x, y, 1)[0])
