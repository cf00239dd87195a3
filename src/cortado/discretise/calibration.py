"""Constants of a filled neighbourhood on the lattice of the rest spacing, in float64."""

import itertools
from functools import cache

import numpy as np

from cortado.discretise.smoothing import SmoothingKernel


def lattice_offsets(spacing: float, support: float, dimension: int) -> np.ndarray:
    """Separations (m, d) [m] between a lattice point and all points within the support, itself included."""
    reach = range(-int(support / spacing) - 1, int(support / spacing) + 2)
    offsets = spacing * np.array(list(itertools.product(reach, repeat=dimension)), dtype=np.float64)
    return offsets[np.linalg.norm(offsets, axis=1) < support]


SKIN = 0.03
"""How far neighbour lists reach beyond the support radius, relative to it: density is also taken at predicted
positions."""

SLACK = 1e-4
"""How far the lattice stays below the rest density, relative.

At the rest density exactly, every particle of a block that starts as a lattice sits on the kink of the pressure clamp:
round-off would choose the pressure's derivative, and no finite difference could confirm it.
"""


def rest_volume(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """V_0 = (1 - SLACK) / sum_j W_ij [m^d]: with the mass rho_0 V_0 the lattice has the rest density less the slack."""
    distances = np.linalg.norm(lattice_offsets(spacing, support, dimension), axis=1)
    return float((1.0 - SLACK) / kernel.weight(distances, dimension, support).sum())


def pressure_stiffness(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """k = delta dt^2 (Solenthaler and Pajarola 2009):

    delta = 1 / (beta (S . S + sum_j G_ij . G_ij)), beta = 2 m^2 dt^2 / rho_0^2, S = sum_j G_ij,

    lowered where the pressure iteration would diverge with it: where its `greatest_rate` is above `RATE_LIMIT`.
    """
    gradients = kernel.gradient(lattice_offsets(spacing, support, dimension), support)
    total = gradients.sum(axis=0)
    volume = rest_volume(kernel, spacing, support, dimension)
    prototype = 1.0 / (2.0 * volume**2 * (total @ total + (gradients**2).sum()))
    rate = greatest_rate(kernel, spacing, support, dimension)
    return float(prototype * min(1.0, RATE_LIMIT / rate))


RATE_LIMIT = 1.5
"""Greatest `greatest_rate` that is let through; the iteration converges below 2, and the margin is for particles off
the lattice."""


@cache
def greatest_rate(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """By what factor one iteration with the prototype's delta overcorrects the worst pressure wave on the lattice.

    A pressure wave exp(i k . x) moves the particles so that their density answers with delta times |S(k)|^2 / (2 sum_j
    G_j . G_j), where S(k) = sum_j G_j sin(k . x_j): the iteration converges where that is below 2. It is 1.4 for the
    cubic spline with a support of 2 spacings in 3-D, and 3.7 with 3 spacings.
    """
    offsets = lattice_offsets(spacing, support, dimension)
    gradients = kernel.gradient(offsets, support)
    waves = np.array(list(itertools.product(np.linspace(0.0, np.pi / spacing, 25), repeat=dimension)))
    answers = np.sin(waves @ offsets.T) @ gradients
    return float((answers**2).sum(axis=1).max() / (2.0 * (gradients**2).sum()))


def shear_factor(kernel: SmoothingKernel, separations: np.ndarray, support: float) -> np.ndarray:
    """F = x . G / (|x|^2 + 0.01 h^2) of diffusion at separations (m, d) [m], (m,)."""
    squares = (separations**2).sum(axis=1)
    return (separations * kernel.gradient(separations, support)).sum(axis=1) / (squares + 0.01 * support**2)


def wall_response(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """sum_j G_j . G_j [1 / m^(2 d + 2)]: what a wall's own answer is measured by, see
    `cortado.solvers.pcisph.relaxation`."""
    return float((kernel.gradient(lattice_offsets(spacing, support, dimension), support) ** 2).sum())


@cache
def lattice_laplacian_correction(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """What the Laplacian 2 V sum_j (u_i - u_j) F_ij must be multiplied with to be that of a parabola on the lattice.

    Without it second derivatives are 1 to 8 % small at any resolution, mostly by the 0.01 h^2 of F.
    """
    offsets = lattice_offsets(spacing, support, dimension)
    volume = rest_volume(kernel, spacing, support, dimension) / (1.0 - SLACK)
    return float(-1.0 / (volume * (shear_factor(kernel, offsets, support) * offsets[:, 0] ** 2).sum()))


@cache
def circulation_factor(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """mu = -(V / d) sum_j x_j . G_j of the lattice [-]: what a sum of V v_ij x G_ij is there of the curl of v."""
    offsets = lattice_offsets(spacing, support, dimension)
    volume = rest_volume(kernel, spacing, support, dimension) / (1.0 - SLACK)
    return float(-volume * (offsets * kernel.gradient(offsets, support)).sum() / dimension)


@cache
def laplacian_rate(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """The greatest eigenvalue [1 / m2] of the Laplacian on the lattice, without its sign."""
    offsets = lattice_offsets(spacing, support, dimension)
    laplacian_correction = lattice_laplacian_correction(kernel, spacing, support, dimension)
    volume = rest_volume(kernel, spacing, support, dimension) / (1.0 - SLACK)
    weights = -2.0 * volume * laplacian_correction * shear_factor(kernel, offsets, support)
    waves = np.array(list(itertools.product(np.linspace(0.0, np.pi / spacing, 25), repeat=dimension)))
    return float(((1.0 - np.cos(waves @ offsets.T)) @ weights).max())


@cache
def pairwise_rate(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """The same [1 / m2] of what the pairwise viscous force applies to velocities on the lattice,

    2 (d + 2) V sum_j F_ij x_ij x_ij^T / |x_ij|^2 (v_i - v_j):

    in a wave of compression it is about three times that of the Laplacian.
    """
    offsets = lattice_offsets(spacing, support, dimension)
    squares = (offsets**2).sum(axis=1)
    volume = rest_volume(kernel, spacing, support, dimension) / (1.0 - SLACK)
    weights = -2.0 * (dimension + 2) * volume * shear_factor(kernel, offsets, support)
    matrices = (weights / np.where(squares > 0.0, squares, np.inf))[:, None] * _products(offsets)
    waves = np.array(list(itertools.product(np.linspace(0.0, np.pi / spacing, 13), repeat=dimension)))
    answers = (1.0 - np.cos(waves @ offsets.T)) @ matrices
    return float(np.linalg.eigvalsh(answers.reshape(-1, dimension, dimension)).max())


@cache
def stress_control(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """C = 4 / (3 m_2) of `cortado.sph.stress_kernels` [-], with the second moment m_2 = V sum_j (-a_j) x_j^2 along an
    axis of the lattice, grad W = a x."""
    return 4.0 / (3.0 * circulation_factor(kernel, spacing, support, dimension))


@cache
def stress_rate(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """The same [1 / m2] of viscosity as a stress (`cortado.sph.stress_kernels`): in a wave of compression, the greatest
    of 2 |g|^2 + C (sum_j 2 s_j (1 - cos k . x_j) - m_2 |g|^2) with g = sum_j s_j x_j sin(k . x_j) / m_2."""
    offsets = lattice_offsets(spacing, support, dimension)
    offsets = offsets[np.any(offsets != 0.0, axis=1)]
    volume = rest_volume(kernel, spacing, support, dimension) / (1.0 - SLACK)
    slopes = (offsets * kernel.gradient(offsets, support)).sum(axis=1) / (offsets**2).sum(axis=1)
    second = circulation_factor(kernel, spacing, support, dimension)
    control = stress_control(kernel, spacing, support, dimension)
    phases = np.array(list(itertools.product(np.linspace(0.0, np.pi / spacing, 25), repeat=dimension))) @ offsets.T
    squares = ((np.sin(phases) @ (-volume * slopes[:, None] * offsets) / second) ** 2).sum(axis=1)
    remainders = (1.0 - np.cos(phases)) @ (-2.0 * volume * slopes) - second * squares
    return float((2.0 * squares + control * remainders).max())


def _products(vectors: np.ndarray) -> np.ndarray:
    """x x^T of vectors (m, d), (m, d^2)."""
    return (vectors[:, :, None] * vectors[:, None, :]).reshape(len(vectors), -1)


DIFFUSION_SAFETY = 0.5
"""Part of the lattice's limit on a step of diffusion that is taken; the rest is for particles off the lattice
(eigenvalues were at most 1.08 times those of the lattice on random particles) and for fractions that stray out of [0,
1]."""


def diffusion_limit(
    kernel: SmoothingKernel,
    spacing: float,
    support: float,
    dimension: int,
    greatest_mobility: float,
    interface_width: float,
    curvature: float,
    density_ratio: float,
) -> float:
    """The longest explicit step [s] of Cahn-Hilliard diffusion, infinite without mobility:

    dt = safety 2 / (M l (eps^2 l + max f'')),   l the greatest eigenvalue of the Laplacian.

    Beside a particle ``density_ratio`` times as heavy a light one diffuses up to (1 + ratio) / 2 times as fast.
    """
    rate = laplacian_rate(kernel, spacing, support, dimension) * 0.5 * (1.0 + density_ratio)
    speed = greatest_mobility * rate * (interface_width**2 * rate + curvature)
    return 2.0 * DIFFUSION_SAFETY / speed if speed > 0.0 else np.inf
