"""Slow twins of terms in NumPy, over all pairs: viscosity as a stress, surface tension by curvature, and mixing
(Cahn-Hilliard), straight from the equations; the first two for complex numbers too."""

from dataclasses import dataclass

import numpy as np

import reference
from cortado.discretise.smoothing import SmoothingKernel
from reference import slope, value

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
    """Of a scene.

    Each particle i has weights s_ij of what is around it, at separations x_ij and with relative velocities v_ij. Its
    velocity gradient G_i fits v_ij = G_i x_ij best; what it dissipates, per volume,

        E_i = mu_i (2 D_i : D_i + C sum_j s_ij |v_ij - G_i x_ij|^2),   D_i = (G_i + G_i^T) / 2,

    is the power of the force f = -1/2 d(sum_i E_i) / dv.
    """

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
        pull = self.pulls(x, v, slopes, wall_slopes, viscosity)[0]
        return -self.volume / mass[:, None] * (pull.sum(1) - pull[:, : len(x)].sum(0))

    def pulls(self, x, v, slopes, wall_slopes, viscosity, wall_velocity=np.zeros_like):
        """What each particle's stress pulls neighbours with, (n, n + b, d), and places (n, b, d) on the walls, which
        have the velocities ``wall_velocity(places)``."""
        places = None
        weights, apart = -self.volume * slopes, x[:, None] - x[None, :]
        moving, fluidity = v[:, None] - v[None, :], 1 / (viscosity + LEAST_VISCOSITY)
        thin = np.broadcast_to(fluidity, weights.shape)
        if self.feet is not None:
            wall_weights, falls = self._contact(x, wall_slopes)
            weights, apart = np.concatenate([weights, wall_weights], 1), np.concatenate([apart, falls], 1)
            places = x[:, None] - falls
            moving = np.concatenate([moving, v[:, None] - wall_velocity(places)], 1)
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
        return (mu[:, None] * weights)[..., None] * (sheared + self.control * rest), places

    def _contact(self, x, wall_slopes):
        """Weights (n, b) of walls without slip, and separations (n, b, d) from the points of the surface below."""
        depths = np.sqrt((self.feet**2).sum(1))
        normals = self.feet / depths[:, None]
        above = ((x[:, None] - self.walls - self.feet) * normals).sum(-1)
        held = np.where(above.real > self.closest, above, self.closest)
        across = np.where((above + depths).real > 0, above + depths, 0)
        weights = -self.volume * self.wall_weights * wall_slopes * across / held
        return weights, np.where(above.real > 0, above, 0)[..., None] * normals


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


FLOOR = 1e-3
"""Width of the smooth kink that keeps the degenerate mobility above zero."""


class Mixture:
    """Explicit Euler steps of mass fractions c (n, K) on particles that stay where they are."""

    def __init__(self, kernel: SmoothingKernel, dimension, support, volume, box=None, **options):
        self.name, self.d, self.h, self.volume = kernel.name, dimension, support, volume
        self.sigma = kernel.normalisation(dimension, support)
        self.box = np.full(dimension, np.inf) if box is None else np.asarray(box, dtype=float)
        self.alpha, self.mobility, self.eps = options["alpha"], options["mobility"], options["eps"]
        self.form = options.get("form", "constant")
        self.well = options.get("energy", "double_well")
        self.laplacian_correction = options.get("laplacian_correction", 1.0)

    def pairs(self, x, n=0.0):
        """F (n, n) and the volumes V / n_i; ``n`` (n,) is what walls add to the number density."""
        s = x[:, None, :] - x[None, :, :]
        periodic = np.where(np.isfinite(self.box), self.box, 0)
        s = s - periodic * np.round(s.real / self.box)
        size = (s * s).sum(-1)
        q = np.sqrt(size) / self.h
        density = self.volume * (self.sigma * value(self.name, q)).sum(1) + n
        pull = (
            self.laplacian_correction * self.sigma / self.h**2 * slope(self.name, q) * size / (size + 0.01 * self.h**2)
        )
        return pull, self.volume / density

    def exchange(self, s, volumes, pull, u):
        """B(s, V; u) (n, K)."""
        weights = (volumes[None, :] * s[:, None] + volumes[:, None] * s[None, :]) * pull
        return u * weights.sum(1)[:, None] - weights @ u

    def potential(self, c, mass, volumes, pull):
        squares = c * c
        bulk = c if self.well == "miscible" else c - 3 * squares + 2 * squares * c
        bulk = self.alpha * (bulk - bulk.mean(1, keepdims=True))
        return bulk - self.eps**2 / mass[:, None] * self.exchange(mass, volumes, pull, c)

    def mobilities(self, c):
        if self.form == "constant":
            return self.mobility + 0 * c[:, 0]
        z = (c.sum(1) ** 2 - (c * c).sum(1)) / 2
        return self.mobility * (z + np.sqrt(z * z + FLOOR**2)) / 2

    def step(self, x, c, mass, time_step, substeps=1, n=0.0):
        pull, volumes = self.pairs(x, n)
        for _ in range(substeps):
            mu = self.potential(c, mass, volumes, pull)
            c = c + time_step / mass[:, None] * self.exchange(mass * self.mobilities(c), volumes, pull, mu)
        return c

    def energy(self, x, c, mass, n=0.0):
        """The discrete free energy whose gradient the potential is; never rises while dt is below its limit."""
        pull, volumes = self.pairs(x, n)
        squares = c * c
        well = squares.sum(1) / 2 if self.well == "miscible" else (squares * (1 - c) ** 2).sum(1) / 2
        return self.alpha * (mass * well).sum() - self.eps**2 / 2 * (c * self.exchange(mass, volumes, pull, c)).sum()
