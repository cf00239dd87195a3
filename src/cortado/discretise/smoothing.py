"""Smoothing kernels W and their gradients, in NumPy, as functions of the separation x, the distance r and the support
radius h.

With q = r / h, s = x / h, the dimensionless kernel w(q) and the normalisation sigma [1 / m^d]:

    W = sigma w(q),    grad W = (sigma / h) f(q) s,

where f(q) = w'(q) / q is finite at q = 0. Cubic spline: Monaghan (1992). Wendland C2 and C4: Dehnen and Aly (2012). The
Warp versions are in `cortado.discretise.smoothing_functions`.

The module also computes constants of the rest lattice from a smoothing kernel, the spacing [m], the support radius [m]
and the dimension.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import pi
from typing import Any

import numpy as np

from cortado.errors import InputError


@dataclass(frozen=True)
class SmoothingKernel:
    """A radial smoothing kernel w(q) of the ratio q of distance to support radius, for q from 0 to 1."""

    name: str
    normalisations: tuple[float, float]
    """Dimensionless normalisations of the kernel in 2-D and in 3-D."""
    value: Callable[[np.ndarray], np.ndarray]
    """The function w(q)."""
    gradient_factor: Callable[[np.ndarray], np.ndarray]
    """The function w'(q) / q."""

    def __reduce__(self) -> tuple[Any, ...]:
        return smoothing_kernel, (self.name,)

    def normalisation(self, dimension: int, support: float) -> float:
        return self.normalisations[dimension - 2] / support**dimension

    def weight(self, distance: np.ndarray, dimension: int, support: float) -> np.ndarray:
        q = np.minimum(np.asarray(distance, dtype=np.float64) / support, 1.0)
        return self.normalisation(dimension, support) * self.value(q)

    def gradient(self, separation: np.ndarray, support: float) -> np.ndarray:
        """Return the gradient of the kernel [1 / m^(d+1)] at separations (n, d) [m]."""
        q = np.minimum(np.linalg.norm(separation, axis=-1, keepdims=True) / support, 1.0)
        return self.normalisation(separation.shape[-1], support) / support**2 * self.gradient_factor(q) * separation


CUBIC_SPLINE = SmoothingKernel(
    "cubic_spline",
    (40 / (7 * pi), 8 / pi),
    lambda q: np.where(q <= 0.5, 6 * q * q * (q - 1) + 1, 2 * (1 - q) ** 3),
    lambda q: np.where(q <= 0.5, 18 * q - 12, -6 * (1 - q) ** 2 / np.maximum(q, 0.5)),
)
WENDLAND_C2 = SmoothingKernel(
    "wendland_c2", (7 / pi, 21 / (2 * pi)), lambda q: (1 - q) ** 4 * (1 + 4 * q), lambda q: -20 * (1 - q) ** 3
)
WENDLAND_C4 = SmoothingKernel(
    "wendland_c4",
    (9 / pi, 495 / (32 * pi)),
    lambda q: (1 - q) ** 6 * (1 + 6 * q + 35 / 3 * q**2),
    lambda q: -56 / 3 * (1 + 5 * q) * (1 - q) ** 5,
)
KERNELS = {kernel.name: kernel for kernel in (CUBIC_SPLINE, WENDLAND_C2, WENDLAND_C4)}


def smoothing_kernel(name: str) -> SmoothingKernel:
    if name not in KERNELS:
        raise InputError(f"kernel is {name!r}, but must be one of {', '.join(KERNELS)}.")
    return KERNELS[name]


SKIN = 0.03
"""Extra radius of neighbour lists, relative to the support radius."""
SLACK = 1e-4
"""Relative amount by which the density of the rest lattice is below the rest density. At the rest density, the
derivative of the pressure by the density would depend on round-off."""
RATE_LIMIT = 1.5
"""Greatest allowed value of `greatest_rate`. Pressure iterations converge if the rate is below 2."""


def lattice_offsets(spacing: float, support: float, dimension: int) -> np.ndarray:
    """Return separations (m, d) [m] within the support radius of a lattice point, including the point itself."""
    reach = range(-int(support / spacing) - 1, int(support / spacing) + 2)
    offsets = spacing * np.array(list(itertools.product(reach, repeat=dimension)), dtype=np.float64)
    return offsets[np.linalg.norm(offsets, axis=1) < support]


def _waves(spacing: float, dimension: int, count: int = 25) -> np.ndarray:
    """Return the wave vectors of the lattice (count^d, d) [rad/m], from 0 to the wave vector of the shortest wave."""
    return np.array(list(itertools.product(np.linspace(0.0, np.pi / spacing, count), repeat=dimension)))


def rest_volume(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return the particle volume [m^d] with which the rest lattice is less dense than the rest density by `SLACK`."""
    distances = np.linalg.norm(lattice_offsets(spacing, support, dimension), axis=1)
    return float((1.0 - SLACK) / kernel.weight(distances, dimension, support).sum())


def _filled(
    kernel: SmoothingKernel, spacing: float, support: float, dimension: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return `lattice_offsets`, the kernel's gradients at the offsets (m, d), and the volume at rest density [m^d]."""
    offsets = lattice_offsets(spacing, support, dimension)
    volume = rest_volume(kernel, spacing, support, dimension) / (1.0 - SLACK)
    return offsets, kernel.gradient(offsets, support), volume


def pressure_stiffness(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return PCISPH's stiffness times the squared time step [m2] (Solenthaler and Pajarola 2009)."""
    gradients = kernel.gradient(lattice_offsets(spacing, support, dimension), support)
    total = gradients.sum(axis=0)
    volume = rest_volume(kernel, spacing, support, dimension)
    prototype = 1.0 / (2.0 * volume**2 * (total @ total + (gradients**2).sum()))
    return float(prototype * min(1.0, RATE_LIMIT / greatest_rate(kernel, spacing, support, dimension)))


@cache
def greatest_rate(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return the overcorrection of a pressure iteration for the worst wave. Iterations converge for values below 2."""
    offsets = lattice_offsets(spacing, support, dimension)
    gradients = kernel.gradient(offsets, support)
    answers = np.sin(_waves(spacing, dimension) @ offsets.T) @ gradients
    return float((answers**2).sum(axis=1).max() / (2.0 * (gradients**2).sum()))


def shear_factor(kernel: SmoothingKernel, separations: np.ndarray, support: float) -> np.ndarray:
    """Return F = x . G / (|x|^2 + 0.01 h^2) (m,) [1 / m^(d + 2)] at separations x, with the kernel's gradient G."""
    squares = (separations**2).sum(axis=1)
    return (separations * kernel.gradient(separations, support)).sum(axis=1) / (squares + 0.01 * support**2)


def wall_response(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return the sum of the kernel's squared gradient over the lattice [1 / m^(2 d + 2)]."""
    return float((kernel.gradient(lattice_offsets(spacing, support, dimension), support) ** 2).sum())


@cache
def lattice_laplacian_correction(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return the factor [-] that makes the Laplacian with `shear_factor` exact for a parabola on the lattice."""
    offsets, _, volume = _filled(kernel, spacing, support, dimension)
    return float(-1.0 / (volume * (shear_factor(kernel, offsets, support) * offsets[:, 0] ** 2).sum()))


@cache
def circulation_factor(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return the ratio of the SPH estimate of a curl to the exact curl on the lattice [-]."""
    offsets, gradients, volume = _filled(kernel, spacing, support, dimension)
    return float(-volume * (offsets * gradients).sum() / dimension)


@cache
def laplacian_rate(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return the largest magnitude of an eigenvalue [1 / m2] of the corrected Laplacian on the lattice."""
    offsets, _, volume = _filled(kernel, spacing, support, dimension)
    correction = lattice_laplacian_correction(kernel, spacing, support, dimension)
    weights = -2.0 * volume * correction * shear_factor(kernel, offsets, support)
    return float(((1.0 - np.cos(_waves(spacing, dimension) @ offsets.T)) @ weights).max())


@cache
def pairwise_rate(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return the greatest eigenvalue of the pairwise viscous force on the lattice [1 / m2]."""
    offsets, _, volume = _filled(kernel, spacing, support, dimension)
    squares = (offsets**2).sum(axis=1)
    weights = -2.0 * (dimension + 2) * volume * shear_factor(kernel, offsets, support)
    products = (offsets[:, :, None] * offsets[:, None, :]).reshape(len(offsets), -1)
    matrices = (weights / np.where(squares > 0.0, squares, np.inf))[:, None] * products
    answers = (1.0 - np.cos(_waves(spacing, dimension, 13) @ offsets.T)) @ matrices
    return float(np.linalg.eigvalsh(answers.reshape(-1, dimension, dimension)).max())


@cache
def stress_control(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return the damping coefficient of the viscous stress on the lattice [-] (`cortado.sph.stress_kernels`)."""
    return 4.0 / (3.0 * circulation_factor(kernel, spacing, support, dimension))


@cache
def stress_rate(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return the greatest eigenvalue of the viscous stress force [1 / m2] (`cortado.sph.stress_kernels`)."""
    offsets, gradients, volume = _filled(kernel, spacing, support, dimension)
    others = np.any(offsets != 0.0, axis=1)
    offsets, gradients = offsets[others], gradients[others]
    slopes = (offsets * gradients).sum(axis=1) / (offsets**2).sum(axis=1)
    second = circulation_factor(kernel, spacing, support, dimension)
    phases = _waves(spacing, dimension) @ offsets.T
    squares = ((np.sin(phases) @ (-volume * slopes[:, None] * offsets) / second) ** 2).sum(axis=1)
    remainders = (1.0 - np.cos(phases)) @ (-2.0 * volume * slopes) - second * squares
    return float((2.0 * squares + stress_control(kernel, spacing, support, dimension) * remainders).max())
