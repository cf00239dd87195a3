"""The reference density of particles: a particle keeps the mass that its first composition has on the rest lattice.

m_i = 1 / sum_k (c_k,i / rho_0k), mass over the lattice's volume [kg / m3], with its derivatives. NumPy, float64.
"""

import numpy as np


def reference_density(fractions: np.ndarray, rest_density: np.ndarray) -> np.ndarray:
    """m (n,) [kg / m3] for mass fractions (n, phases) and rest densities (phases,) [kg / m3]."""
    return 1.0 / (fractions / rest_density).sum(axis=1)


def reference_density_tangent(
    fractions: np.ndarray, rest_density: np.ndarray, fractions_dot: np.ndarray, rest_density_dot: np.ndarray
) -> np.ndarray:
    """The derivative of m (n,) along a direction."""
    change = (fractions_dot - fractions * rest_density_dot / rest_density) / rest_density
    return -(reference_density(fractions, rest_density) ** 2) * change.sum(axis=1)


def reference_density_adjoint(
    fractions: np.ndarray, rest_density: np.ndarray, reference_density_bar: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The adjoints of fractions (n, phases) and of rest densities (phases,) for one of m (n,)."""
    by_volume = (reference_density_bar * reference_density(fractions, rest_density) ** 2)[:, None] / rest_density
    return -by_volume, (by_volume * fractions / rest_density).sum(axis=0)
