"""Smoothing kernels W(r; h) with a support radius h and their gradients, in NumPy.

With q = r / h, s = x / h and the normalisation sigma [1 / m^d]:

    W = sigma w(q),    grad W = (sigma / h) f(q) s,

where f(q) = w'(q) / q is finite at q = 0. Cubic spline: Monaghan (1992). Wendland C2 and C4: Dehnen and Aly (2012). The
Warp versions are in `cortado.discretise.smoothing_functions`. Constants of the rest lattice are functions of a
smoothing kernel, the spacing [m], the support radius [m] and the dimension, 2 or 3.
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
    """A radial kernel in the dimensionless form w(q), 0 <= q <= 1."""

    name: str
    normalisations: tuple[float, float]
    """sigma h^d in 2-D and 3-D."""
    value: Callable[[np.ndarray], np.ndarray]
    """w(q)"""
    gradient_factor: Callable[[np.ndarray], np.ndarray]
    """f(q) = w'(q) / q"""

    def __reduce__(self) -> tuple[Any, ...]:
        return smoothing_kernel, (self.name,)

    def normalisation(self, dimension: int, support: float) -> float:
        """Return sigma [1 / m^d]."""
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
    """Return the smoothing kernel with this name; raise `InputError` for an unknown name."""
    if name not in KERNELS:
        raise InputError(f"kernel is {name!r}, but must be one of {', '.join(KERNELS)}.")
    return KERNELS[name]


SKIN = 0.03
"""Extra radius of neighbour lists, relative to the support radius, for densities at predicted positions."""
SLACK = 1e-4
"""Relative amount by which the lattice's density is below the rest density. At exactly the rest density every lattice
particle would be on the kink of the pressure clamp, where round-off chooses the derivative."""
RATE_LIMIT = 1.5
"""Bound on `greatest_rate`, below the limit of convergence, 2, for particles off the lattice."""


def lattice_offsets(spacing: float, support: float, dimension: int) -> np.ndarray:
    """Return separations (m, d) [m] between a lattice point and all points within the support, including itself."""
    reach = range(-int(support / spacing) - 1, int(support / spacing) + 2)
    offsets = spacing * np.array(list(itertools.product(reach, repeat=dimension)), dtype=np.float64)
    return offsets[np.linalg.norm(offsets, axis=1) < support]


def _waves(spacing: float, dimension: int, count: int = 25) -> np.ndarray:
    """Return wave vectors (count^d, d) [rad/m] of one octant, up to the shortest waves on the lattice."""
    return np.array(list(itertools.product(np.linspace(0.0, np.pi / spacing, count), repeat=dimension)))


def rest_volume(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return V_0 = (1 - SLACK) / sum_j W_ij [m^d]: with the mass rho_0 V_0 the lattice has the density (1 - SLACK)
    rho_0."""
    distances = np.linalg.norm(lattice_offsets(spacing, support, dimension), axis=1)
    return float((1.0 - SLACK) / kernel.weight(distances, dimension, support).sum())


def _filled(
    kernel: SmoothingKernel, spacing: float, support: float, dimension: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the `lattice_offsets` (m, d) [m], the gradients of W there (m, d) [1 / m^(d + 1)], and the volume V [m^d]
    with which the lattice has exactly the rest density."""
    offsets = lattice_offsets(spacing, support, dimension)
    volume = rest_volume(kernel, spacing, support, dimension) / (1.0 - SLACK)
    return offsets, kernel.gradient(offsets, support), volume


def pressure_stiffness(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return PCISPH's stiffness k = delta dt^2 [m2] (Solenthaler and Pajarola 2009):

    delta = 1 / (beta (S . S + sum_j G_ij . G_ij)), beta = 2 m^2 dt^2 / rho_0^2, S = sum_j G_ij,

    reduced if the `greatest_rate` exceeds `RATE_LIMIT`.
    """
    gradients = kernel.gradient(lattice_offsets(spacing, support, dimension), support)
    total = gradients.sum(axis=0)
    volume = rest_volume(kernel, spacing, support, dimension)
    prototype = 1.0 / (2.0 * volume**2 * (total @ total + (gradients**2).sum()))
    return float(prototype * min(1.0, RATE_LIMIT / greatest_rate(kernel, spacing, support, dimension)))


@cache
def greatest_rate(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return the factor by which a pressure iteration with the delta of a filled neighbourhood overcorrects the worst
    pressure wave on the lattice [-].

    A pressure wave exp(i k . x) changes the density by the factor delta |S(k)|^2 / (2 sum_j G_j . G_j), where S(k) =
    sum_j G_j sin(k . x_j). The iteration converges if the factor is below 2.
    """
    offsets = lattice_offsets(spacing, support, dimension)
    gradients = kernel.gradient(offsets, support)
    answers = np.sin(_waves(spacing, dimension) @ offsets.T) @ gradients
    return float((answers**2).sum(axis=1).max() / (2.0 * (gradients**2).sum()))


def shear_factor(kernel: SmoothingKernel, separations: np.ndarray, support: float) -> np.ndarray:
    """Return F = x . G / (|x|^2 + 0.01 h^2) (m,) [1 / m^(d + 2)] at separations (m, d) [m], the factor of second
    derivatives from differences."""
    squares = (separations**2).sum(axis=1)
    return (separations * kernel.gradient(separations, support)).sum(axis=1) / (squares + 0.01 * support**2)


def wall_response(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return sum_j G_j . G_j [1 / m^(2 d + 2)], the scale of the relaxation beside walls (`solvers.pcisph.solver`)."""
    return float((kernel.gradient(lattice_offsets(spacing, support, dimension), support) ** 2).sum())


@cache
def lattice_laplacian_correction(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return the factor [-] that makes the Laplacian 2 V sum_j (u_i - u_j) F_ij exact for a parabola on the lattice;
    second derivatives without the factor are 1 to 8 % too small."""
    offsets, _, volume = _filled(kernel, spacing, support, dimension)
    return float(-1.0 / (volume * (shear_factor(kernel, offsets, support) * offsets[:, 0] ** 2).sum()))


@cache
def circulation_factor(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return mu = -(V / d) sum_j x_j . G_j of the lattice [-]: the sum of V v_ij x G_ij is mu times the curl of v."""
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
    """Return the greatest eigenvalue [1 / m2] on the lattice of the pairwise viscous force,

    2 (d + 2) V sum_j F_ij x_ij x_ij^T / |x_ij|^2 (v_i - v_j).
    """
    offsets, _, volume = _filled(kernel, spacing, support, dimension)
    squares = (offsets**2).sum(axis=1)
    weights = -2.0 * (dimension + 2) * volume * shear_factor(kernel, offsets, support)
    products = (offsets[:, :, None] * offsets[:, None, :]).reshape(len(offsets), -1)
    matrices = (weights / np.where(squares > 0.0, squares, np.inf))[:, None] * products
    answers = (1.0 - np.cos(_waves(spacing, dimension, 13) @ offsets.T)) @ matrices
    return float(np.linalg.eigvalsh(answers.reshape(-1, dimension, dimension)).max())


@cache
def stress_control(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return the damping C = 4 / (3 m_2) of `cortado.sph.stress_kernels` [-], with the second moment m_2 = V sum_j
    (-a_j) x_j^2 along an axis of the lattice, grad W = a x."""
    return 4.0 / (3.0 * circulation_factor(kernel, spacing, support, dimension))


@cache
def stress_rate(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """Return the greatest eigenvalue [1 / m2] on the lattice of viscosity as a stress (`cortado.sph.stress_kernels`):
    the maximum over wave vectors k of 2 |g|^2 + C (sum_j 2 s_j (1 - cos k . x_j) - m_2 |g|^2), with g = sum_j s_j x_j
    sin(k . x_j) / m_2."""
    offsets, gradients, volume = _filled(kernel, spacing, support, dimension)
    others = np.any(offsets != 0.0, axis=1)
    offsets, gradients = offsets[others], gradients[others]
    slopes = (offsets * gradients).sum(axis=1) / (offsets**2).sum(axis=1)
    second = circulation_factor(kernel, spacing, support, dimension)
    phases = _waves(spacing, dimension) @ offsets.T
    squares = ((np.sin(phases) @ (-volume * slopes[:, None] * offsets) / second) ** 2).sum(axis=1)
    remainders = (1.0 - np.cos(phases)) @ (-2.0 * volume * slopes) - second * squares
    return float((2.0 * squares + stress_control(kernel, spacing, support, dimension) * remainders).max())
