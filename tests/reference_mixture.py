"""Slow twin of the mixing of several fluids (Cahn-Hilliard) in plain NumPy: all pairs, straight from the equations.

It takes complex numbers too, as `reference` does.
"""

import numpy as np

from cortado.discretise.smoothing import SmoothingKernel
from reference import slope, value

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
