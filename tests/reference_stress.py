"""Slow twin of viscosity as a stress, over all pairs, complex numbers allowed.

Each particle i has weights s_ij of what is around it, at separations x_ij and with relative velocities v_ij. Its
velocity gradient G_i fits v_ij = G_i x_ij best; what it dissipates, per volume,

    E_i = mu_i (2 D_i : D_i + C sum_j s_ij |v_ij - G_i x_ij|^2),   D_i = (G_i + G_i^T) / 2,

is the power of the force f = -1/2 d(sum_i E_i) / dv.
"""

from dataclasses import dataclass

import numpy as np

LEAST_VISCOSITY = 1e-12


def smoothstep(t):
    t = np.where(t.real > 0, np.where(t.real < 1, t, 1), 0)
    return 3 * t**2 - 2 * t**3


def fullness(M):
    """S (n,) of moments M (n, d, d): 1 for neighbours on all sides or on one, 0 on a line; and M, or the unit matrix
    where S is 0."""
    trace, determinant = np.trace(M, axis1=1, axis2=2), np.linalg.det(M)
    if M.shape[1] == 2:
        upper, lower = 2 * determinant, trace
    else:
        upper, lower = 3 * determinant, (trace**2 - np.trace(M @ M, axis1=1, axis2=2)) / 2
    full = smoothstep((upper / np.where(lower == 0, 1, lower) - 0.2) / 0.3)
    return full, np.where((full != 0)[:, None, None], M, np.eye(M.shape[1]))


@dataclass(frozen=True)
class Stress:
    """Of a scene."""

    volume: float
    control: float
    """C"""
    closest: float
    """From where on a wall pulls no harder [m]."""
    walls: np.ndarray
    wall_weights: np.ndarray
    feet: np.ndarray | None
    """(b, d) from wall particles to the surface [m]; None if walls slip freely."""

    def acceleration(self, x, v, slopes, wall_slopes, mass, viscosity):
        """(n, d) [m/s2] given the slopes a of grad W = a x between particles (n, n), and to those of walls (n, b)."""
        weights, apart = -self.volume * slopes, x[:, None] - x[None, :]
        moving, fluidity = v[:, None] - v[None, :], 1 / (viscosity + LEAST_VISCOSITY)
        thin = np.broadcast_to(fluidity, weights.shape)
        if self.feet is not None:
            wall_weights, falls = self._contact(x, wall_slopes)
            weights, apart = np.concatenate([weights, wall_weights], 1), np.concatenate([apart, falls], 1)
            moving = np.concatenate([moving, np.broadcast_to(v[:, None], falls.shape)], 1)
            thin = np.concatenate([thin, np.broadcast_to(fluidity[:, None], wall_weights.shape)], 1)
        M = np.einsum("ij,ija,ijb->iab", weights, apart, apart)
        full, regular = fullness(M)
        outer = np.linalg.inv(regular)
        G = np.einsum("ij,ija,ijb,ibc->iac", weights, moving, apart, outer)
        rest = moving - np.einsum("iab,ijb->ija", G, apart)
        trace = np.trace(regular, axis1=1, axis2=2)
        resistance = (weights * thin * (apart**2).sum(-1)).sum(1) / trace
        mu = full * 2 / (fluidity + resistance)
        # What moving i against a neighbour adds to half of E_i, as a force on i, and its reaction on the neighbour.
        sheared = np.einsum("iab,ibc,ijc->ija", G + G.transpose(0, 2, 1), outer, apart)
        pull = (mu[:, None] * weights)[..., None] * (sheared + self.control * rest)
        reaction = pull[:, : len(x)].sum(0)
        return -self.volume / mass[:, None] * (pull.sum(1) - reaction)

    def _contact(self, x, wall_slopes):
        """Weights (n, b) of walls without slip, and separations (n, b, d) from the points of the surface below."""
        depths = np.sqrt((self.feet**2).sum(1))
        normals = self.feet / depths[:, None]
        above = ((x[:, None] - self.walls - self.feet) * normals).sum(-1)
        held = np.where(above.real > self.closest, above, self.closest)
        across = np.where((above + depths).real > 0, above + depths, 0)
        weights = -self.volume * self.wall_weights * wall_slopes * across / held
        return weights, np.where(above.real > 0, above, 0)[..., None] * normals
