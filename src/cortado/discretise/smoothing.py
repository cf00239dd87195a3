"""Smoothing kernels W(r; h) of compact support h and their gradients, in NumPy.

With q = r / h, s = x / h and the normalisation sigma [1 / m^d]:

    W = sigma w(q),    grad W = (sigma / h) f(q) s,

where f(q) = w'(q) / q is finite at q = 0 for every kernel here, so that no direction is needed at r = 0.
Cubic spline: Monaghan (1992). Wendland C2 and C4: Dehnen and Aly (2012). The same in Warp, with Hessians:
`cortado.discretise.smoothing_functions`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi
from typing import Any

import numpy as np

from cortado.errors import InputError


@dataclass(frozen=True)
class SmoothingKernel:
    """A radial kernel in the dimensionless form w(q), 0 <= q <= 1."""

    name: str
    normalisations: tuple[float, float]
    """sigma h^d in two and in three dimensions."""
    value: Callable[[np.ndarray], np.ndarray]
    """w(q)."""
    gradient_factor: Callable[[np.ndarray], np.ndarray]
    """f(q) = w'(q) / q."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the kernel by its name."""
        return smoothing_kernel, (self.name,)

    def normalisation(self, dimension: int, support: float) -> float:
        """Return the normalisation sigma [1 / m^d] for a support radius [m]."""
        return self.normalisations[dimension - 2] / support**dimension

    def weight(self, distance: np.ndarray, dimension: int, support: float) -> np.ndarray:
        """Return W [1 / m^d] at distances [m], any shape."""
        q = np.minimum(np.asarray(distance, dtype=np.float64) / support, 1.0)
        return self.normalisation(dimension, support) * self.value(q)

    def gradient(self, separation: np.ndarray, support: float) -> np.ndarray:
        """Return the gradient of W [1 / m^(d+1)] at separations (n, d) [m]."""
        q = np.minimum(np.linalg.norm(separation, axis=-1, keepdims=True) / support, 1.0)
        return self.normalisation(separation.shape[-1], support) / support**2 * self.gradient_factor(q) * separation


CUBIC_SPLINE = SmoothingKernel(
    "cubic_spline",
    (40 / (7 * pi), 8 / pi),
    lambda q: np.where(q <= 0.5, 6 * q * q * (q - 1) + 1, 2 * (1 - q) ** 3),
    lambda q: np.where(q <= 0.5, 18 * q - 12, -6 * (1 - q) ** 2 / np.maximum(q, 0.5)),
)
WENDLAND_C2 = SmoothingKernel(
    "wendland_c2",
    (7 / pi, 21 / (2 * pi)),
    lambda q: (1 - q) ** 4 * (1 + 4 * q),
    lambda q: -20 * (1 - q) ** 3,
)
WENDLAND_C4 = SmoothingKernel(
    "wendland_c4",
    (9 / pi, 495 / (32 * pi)),
    lambda q: (1 - q) ** 6 * (1 + 6 * q + 35 / 3 * q**2),
    lambda q: -56 / 3 * (1 + 5 * q) * (1 - q) ** 5,
)
KERNELS = {kernel.name: kernel for kernel in (CUBIC_SPLINE, WENDLAND_C2, WENDLAND_C4)}


def smoothing_kernel(name: str) -> SmoothingKernel:
    """Return the smoothing kernel of a name; raise `InputError` where there is none."""
    if name not in KERNELS:
        raise InputError(f"kernel is {name!r}, but must be one of {', '.join(KERNELS)}.")
    return KERNELS[name]
