"""Slow twin of surface tension by curvature: all pairs, NumPy, real or complex."""

import numpy as np

import reference


def adjugate(M):
    """Of matrices (n, d, d): the inverse times the determinant."""
    if M.shape[1] == 2:
        (a, b), (c, d) = np.moveaxis(M, 0, -1)
        return np.moveaxis(np.array([[d, -b], [-c, a]]), -1, 0)
    rows = M[:, 0], M[:, 1], M[:, 2]
    return np.stack([np.cross(rows[k - 2], rows[k - 1]) for k in range(3)], axis=-1)


class Curvature:
    """The acceleration of surface tension by curvature, straight from its equations."""

    def __init__(self, kernel, support, volume, spacing, width, depth):
        self.kernel, self.support, self.volume, self.spacing = kernel, support, volume, spacing
        self.width, self.depth = width, depth

    def parts(self, x):
        """q (n, d) [1/m], w (n,) [-] and the curvature of the surface k (n,) [1/m]."""
        d, apart = x.shape[1], x[:, None] - x[None, :]
        distance = np.sqrt((apart * apart).sum(-1)) / self.support
        sigma = self.volume * self.kernel.normalisation(d, self.support)
        W = sigma * reference.value(self.kernel.name, distance)
        g = (sigma / self.support**2 * reference.slope(self.kernel.name, distance))[..., None] * apart
        q = W @ g.sum(1) / W.sum(1)[:, None]
        size = np.sqrt((q * q).sum(1))
        t = (self.spacing * size - 0.03) / 0.07
        t = np.where(t.real < 0, 0, np.where(t.real > 1, 1, t))
        w = t * t * (3 - 2 * t)
        e = np.where(t.real > 0, 1 / np.where(t.real > 0, size, 1), 0)[:, None] * q
        turn = e[None, :] - e[:, None]
        B = -np.einsum("j,ija,ijb->iab", w, g, apart)
        D = np.einsum("j,ija,ijb->iab", w, turn, g)
        inverse = adjugate(B)
        determinant = np.einsum("iab,iba->i", B, inverse) / d
        kappa = -np.einsum("iab,iba->i", inverse, D) / (determinant + {2: 1e-3, 3: 1e-4}[d])
        mean = W @ (w * kappa) / (W @ w + 1e-6)
        found = self.depth * mean
        divisor = np.where(found.real > -0.25, 1 + found, np.where(found.real > -0.75, 0.5 + (0.75 + found) ** 2, 0.5))
        return q, w, mean / divisor

    def acceleration(self, x, density, surface_tension):
        """(n, d) [m/s2]; ``density`` (n,) is the mass of a particle over its volume at rest."""
        q, w, k = self.parts(x)
        return (surface_tension / self.width * k * w / density)[:, None] * q
