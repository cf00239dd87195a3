"""Constants of a filled neighbourhood on the lattice of the rest spacing, in float64."""

import itertools

import numpy as np

from cortado.smoothing import SmoothingKernel


def lattice_offsets(spacing: float, support: float, dimension: int) -> np.ndarray:
    """Separations (m, d) [m] between a lattice point and all points within the support, itself included."""
    reach = range(-int(support / spacing) - 1, int(support / spacing) + 2)
    offsets = spacing * np.array(list(itertools.product(reach, repeat=dimension)), dtype=np.float64)
    return offsets[np.linalg.norm(offsets, axis=1) < support]


SLACK = 1e-4
"""How far the lattice stays below the rest density, relative.

At the rest density exactly, every particle of a block that starts as a lattice sits on the kink of the pressure clamp:
round-off would choose the pressure's derivative, and no finite difference could confirm it.
"""


def rest_volume(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """V_0 = (1 - SLACK) / sum_j W_ij [m^d]: with the mass rho_0 V_0 the lattice has the rest density, less the slack."""
    distances = np.linalg.norm(lattice_offsets(spacing, support, dimension), axis=1)
    return float((1.0 - SLACK) / kernel.weight(distances, dimension, support).sum())


def pressure_stiffness(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """k = delta dt^2 (report eq. 7, put right; Solenthaler and Pajarola 2009):

    delta = 1 / (beta (S . S + sum_j G_ij . G_ij)), beta = 2 m^2 dt^2 / rho_0^2, S = sum_j G_ij.
    """
    gradients = kernel.gradient(lattice_offsets(spacing, support, dimension), support)
    total = gradients.sum(axis=0)
    volume = rest_volume(kernel, spacing, support, dimension)
    return float(1.0 / (2.0 * volume**2 * (total @ total + (gradients**2).sum())))


def wall_factor(kernel: SmoothingKernel, spacing: float, support: float, dimension: int) -> float:
    """By how much the wall volumes of Akinci et al. (2012) are scaled, so that a flat wall of one layer completes the
    lattice: fluid that starts at rest beside a wall then has the rest density, and does not jump off (the factor of
    Band, Gissler, Ihmsen, Cornelis, Peer and Teschner 2018, here computed for the kernel and its support).
    """
    offsets = lattice_offsets(spacing, support, dimension)
    weights = kernel.weight(np.linalg.norm(offsets, axis=1), dimension, support)
    layer = np.rint(offsets[:, 0] / spacing).astype(int)
    missing = weights[layer < 0].sum() / weights.sum()
    of_the_layer = weights[layer == -1].sum() / weights[layer == 0].sum()
    return float(missing / of_the_layer)
