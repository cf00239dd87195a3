"""Slow twins of the engine in plain NumPy: all pairs, no lists, straight from the equations.

They take complex numbers too, so that `complex_step` gives derivatives that share nothing with the engine's.
"""

import numpy as np

from cortado.discretise.smoothing import SmoothingKernel

STEP = 1e-30


def value(name, q):
    """w(q) of a kernel, complex allowed."""
    r = q.real
    t = np.where(r < 1, 1 - q, 0)
    if name == "cubic_spline":
        return np.where(r <= 0.5, 6 * (q**3 - q**2) + 1, 2 * t**3)
    return t**4 * (1 + 4 * q) if name == "wendland_c2" else t**6 * (1 + 6 * q + 35 / 3 * q**2)


def slope(name, q):
    """w'(q) / q of a kernel, complex allowed."""
    r = q.real
    t = np.where(r < 1, 1 - q, 0)
    if name == "cubic_spline":
        return np.where(r <= 0.5, 18 * q - 12, -6 * t**2 / np.where(r <= 0.5, 1, q))
    return -20 * t**3 if name == "wendland_c2" else -56 / 3 * (1 + 5 * q) * t**5


def blend(c, rest_density, viscosity):
    """Rest densities and viscosities (n,) of particles with mass fractions c (n, phases)."""
    return 1 / (c / rest_density).sum(1), np.exp((c * np.log(viscosity)).sum(1))


def harmonic(a):
    """(n, n) harmonic means of all pairs; 0 between two zeros."""
    total = a[:, None] + a[None, :]
    return 2 * a[:, None] * a[None, :] / np.where(total == 0, 1, total)


class Pcisph:
    """One step of corrections-to-the-letter PCISPH over all pairs, float64 or complex128."""

    def __init__(self, kernel: SmoothingKernel, dimension, support, volume, stiffness, walls, wall_weights, **options):
        self.name, self.d, self.h = kernel.name, dimension, support
        self.sigma = kernel.normalisation(dimension, support)
        self.volume, self.stiffness = volume, stiffness
        self.walls, self.wall_weights = walls, wall_weights
        self.viscosity_form = options.get("viscosity", "pairwise")
        self.sticks = options.get("sticks", False)
        self.reach, self.response = options["reach"], options["response"]
        self.stress = options.get("stress")

    def _pairs(self, x, y):
        s = x[:, None, :] - y[None, :, :]
        return s, np.sqrt((s * s).sum(-1) + 0j if np.iscomplexobj(s) else (s * s).sum(-1)) / self.h

    def weight(self, x, y):
        _, q = self._pairs(x, y)
        return self.sigma * value(self.name, q)

    def slope(self, x, y):
        """a of grad W = a (x - y)."""
        return self.sigma / self.h**2 * slope(self.name, self._pairs(x, y)[1])

    def gradient(self, x, y):
        return self.slope(x, y)[..., None] * self._pairs(x, y)[0]

    def near(self, x):
        """Which fluid and which wall particles the lists of x hold."""
        fluid = (np.abs(self._pairs(x.real, x.real)[1]) * self.h < self.reach) | np.eye(len(x), dtype=bool)
        return fluid, self._pairs(x.real, self.walls)[1] * self.h < self.reach

    def wall_density(self, x, near_walls):
        """What walls add to the density (n,) of particles [1 / m^d]."""
        return (self.weight(x, self.walls) * near_walls * self.wall_weights).sum(1)

    def density(self, x, near, near_walls):
        """Particles to the volume (n,) [1 / m^d]."""
        return (self.weight(x, x) * near).sum(1) + self.wall_density(x, near_walls)

    def step(self, x, v, gravity, mass, rest_density, viscosity, time_step, iterations):
        """``mass`` [kg], ``rest_density`` and ``viscosity`` (n,) each."""
        n = len(x)
        near, near_walls = self.near(x)
        sigma = self.density(x, near, near_walls)
        g, g_walls = self.gradient(x, x), self.gradient(x, self.walls)
        acceleration = gravity + self.viscous(x, v, sigma, g, g_walls, mass, viscosity)
        p, push = np.zeros(n, dtype=x.dtype), np.zeros_like(x)
        pull = (self.wall_weights[None, :, None] * near_walls[..., None] * g_walls).sum(1)
        lighter = self.volume * (self.weight(x, x) * near * (mass[:, None] / mass[None, :] - 1)).sum(1)
        excess = np.where(lighter.real > 0, lighter**2 / 2 / (lighter + 0.2), 0)
        delta = self.stiffness / time_step**2 / (1 + (pull * pull).sum(1) / self.response) / (1 + excess)
        for _ in range(iterations):
            v_star = v + time_step * (acceleration + push)
            x_star = x + time_step * v_star
            p = p + delta * (mass * self.density(x_star, near, near_walls) - rest_density)
            p = np.where(p.real > 0, p, 0)
            c = p / sigma**2
            force = -((c[:, None] + c[None, :])[..., None] * g).sum(1)
            force = force - (c[:, None, None] * self.wall_weights[None, :, None] * g_walls).sum(1)
            push = force / mass[:, None]
        v_new = v + time_step * (acceleration + push)
        return x + time_step * v_new, v_new

    def viscous(self, x, v, sigma, g, g_walls, mass, viscosity):
        if self.viscosity_form == "none":
            return np.zeros_like(x)
        if self.viscosity_form == "stress":
            return self.stress.acceleration(x, v, self.slope(x, x), self.slope(x, self.walls), mass, viscosity)
        fluid = (harmonic(viscosity) / sigma[None, :])[..., None] * self.phi(x, x, v[:, None] - v[None, :], g)
        total = fluid.sum(1)
        if self.sticks:
            walls = self.phi(x, self.walls, np.broadcast_to(v[:, None], g_walls.shape), g_walls)
            weights = self.volume * viscosity[:, None, None] * self.wall_weights[None, :, None]
            total = total + (weights * walls).sum(1)
        return 2 * (self.d + 2) / (mass * sigma)[:, None] * total

    def phi(self, x, y, v, g):
        s = x[:, None, :] - y[None, :, :]
        size = (s * s).sum(-1) + 0.01 * self.h**2
        return ((v * s).sum(-1) / size)[..., None] * g


class SurfaceTension:
    """The acceleration of surface tension over all pairs: arrows n out of the fluid, a stress S(n), and its pull
    between each two particles. Across the surface the stress is a third of that along it."""

    def __init__(self, support, inverse, scale):
        self.h, self.inverse, self.scale = support, inverse, scale

    def acceleration(self, x, density, surface_tension):
        """(n, d) [m/s2]; ``density`` (n,) is the mass of a particle over its volume at rest."""
        s = x[:, None, :] - x[None, :, :]
        q2 = (s * s).sum(-1) / self.h**2
        weight = np.where(q2.real < 1, 1 - q2, 0) ** 2
        n = self.inverse * (weight[..., None] * s).sum(1)
        size = (n * n).sum(1)[:, None, None]
        stress = (size * np.eye(x.shape[1]) - 2 / 3 * n[:, :, None] * n[:, None, :]) / np.sqrt(1 + size)
        both = stress[:, None] + stress[None, :]
        pull = ((q2 * weight)[..., None, None] * both * s[:, :, None, :]).sum((1, 3))
        return -surface_tension * self.scale / density[:, None] * pull


class Emitter:
    """The end of steps of a scene with an emitter, whose last particles are led until they have left its nozzle."""

    def __init__(self, sample, direction, area, path):
        """``sample`` of particles, of which none is in reserve; ``path`` (steps, d) of the opening."""
        self.upstream, self.offsets = sample.upstream, sample.offsets
        self.direction, self.area, self.path = direction, area, path

    def lead(self, n, x, v, flow_rate, time_step):
        """Positions and velocities (particles, d) after step n, counted from 0, given those of free particles."""
        speed = flow_rate / self.area
        left = (self.upstream - speed * time_step * (n + 1))[:, None]
        turn = self.path[n] - self.path[max(n - 1, 0)]
        place = self.path[n] + self.offsets - left * self.direction
        first, led = len(x) - len(left), left.real > 0
        x = np.concatenate([x[:first], np.where(led, place, x[first:])])
        return x, np.concatenate([v[:first], np.where(led, turn / time_step + speed * self.direction, v[first:])])


def complex_step(function, values, directions):
    """Derivative of ``function(*values)`` along ``directions``, exact to round-off."""
    return np.imag(function(*(v + 1j * STEP * d for v, d in zip(values, directions, strict=True)))) / STEP
