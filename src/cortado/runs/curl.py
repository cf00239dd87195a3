"""The vorticity of fluid of which only positions and velocities are known."""

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.calibration import circulation_factor, rest_volume
from cortado.discretise.pairs import pairs_among
from cortado.discretise.smoothing import smoothing_kernel
from cortado.scene.scene import Scene


def vorticity(scene: Scene, positions: NDArray, velocities: NDArray) -> NDArray:
    """(n,) in the plane and (n, 3) in space [1/s]: V / mu sum_j (v_i - v_j) x grad W_ij (Monaghan 1992) of particles of
    a scene at positions (n, d) [m] with velocities (n, d) [m/s].

    It is `Simulation.quantity("vorticity")` without the division by the sum of W, which is 1 at the rest density.
    """
    x, v = np.asarray(positions, dtype=np.float64), np.asarray(velocities, dtype=np.float64)
    kernel, dimension = smoothing_kernel(scene.discretisation.kernel), scene.dimension
    spacing = scene.discretisation.spacing
    support = scene.discretisation.support * spacing
    lower, lengths = scene.container.periods(dimension)
    i, j = pairs_among(x, support, lower, lengths)
    x_ij = x[i] - x[j]
    x_ij -= np.where(lengths > 0.0, lengths, 0.0) * np.rint(x_ij / np.where(lengths > 0.0, lengths, np.inf))
    size = (kernel, spacing, support, dimension)
    factor = rest_volume(*size) / circulation_factor(*size)
    v_ij, gradient = v[i] - v[j], factor * kernel.gradient(x_ij, support)
    if dimension == 2:
        turning = (v_ij[:, 0] * gradient[:, 1] - v_ij[:, 1] * gradient[:, 0])[:, None]
    else:
        turning = np.cross(v_ij, gradient)
    found = _summed(i, turning, len(x)) + _summed(j, turning, len(x))
    return found[:, 0] if dimension == 2 else found


def _summed(of: NDArray, terms: NDArray, count: int) -> NDArray:
    """(count, k) terms (m, k) added up by the number of the particle that each is of, (m,)."""
    return np.stack([np.bincount(of, terms[:, k], minlength=count) for k in range(terms.shape[1])], axis=1)
