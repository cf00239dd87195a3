"""Triangle surfaces of fluid: one surface around all particles, or a sphere around each particle."""

from dataclasses import dataclass
from functools import cache
from itertools import product
from math import inf
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import BandLauncher
from cortado.device.threads import usable_cores
from cortado.discretise.shapes import Points
from cortado.errors import ComputationError
from cortado.pictures.tracing.near_particles import (
    MODULE,
    Floats,
    NearParticles,
    Particles,
    Vec2s,
    Vec3s,
    near_particles,
    sum_near,
)
from cortado.pictures.tracing.surface_net import level_blocks, net_of, normals_of, smoothed, triangles_of

NEIGHBOURS = 24
"""Number of particles that are averaged for the colour of a surface point."""
ROUND = 10_000
"""Greatest number of spheres with 128 triangles each. If there are more spheres, each sphere has 32 triangles."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in 3-D. Seen from outside, the corners of a triangle run counterclockwise."""

    points: Points
    """Positions of the vertices (p, 3) [m]."""
    triangles: np.ndarray
    """Indices of the vertices of each triangle (t, 3)."""
    normals: Points
    """Outward unit normals at the vertices (p, 3)."""
    colours: Points
    """Linear colours of the vertices (p, 3)."""
    velocities: Points | None = None
    """Velocities of the vertices (p, 3) [m/s], or None for solids and for unknown velocities."""


def nearest_colours(points: Points, positions: Points, colours: Points, spacing: float) -> Points:
    """Return the mean colours (p, 3) of the particles nearest to points (p, d) [m]."""
    from scipy.spatial import cKDTree

    distances, which = cKDTree(positions).query(points, k=min(NEIGHBOURS, len(positions)), workers=usable_cores())
    distances, which = distances.reshape(len(points), -1), which.reshape(len(points), -1)
    weights = np.exp((distances[:, :1] ** 2 - distances**2) / (0.95 * spacing) ** 2)
    return np.einsum("pk,pkc->pc", weights, colours[which]) / weights.sum(axis=1)[:, None]


def spheres(positions: Points, colours: Points, spacing: float) -> Mesh:
    """Make a sphere around each particle at ``positions`` (n, 3) [m] with ``colours`` (n, 3)."""
    corners, triangles = _sphere(2 if len(positions) <= ROUND else 1)
    n, k = len(positions), len(corners)
    points = (positions[:, None] + 0.5 * spacing * corners).reshape(-1, 3)
    triangles = (k * np.arange(n)[:, None, None] + triangles).reshape(-1, 3).astype(np.int32)
    return Mesh(points, triangles, np.tile(corners, (n, 1)), np.repeat(colours, k, axis=0))


@cache
def _sphere(levels: int) -> tuple[Points, np.ndarray]:
    """Return vertices (k, 3) and triangles of a unit sphere: an octahedron, divided ``levels`` times."""
    octants = np.array([np.diag(signs) for signs in product((1.0, -1.0), repeat=3)])
    triangles = np.array([one if np.linalg.det(one) > 0.0 else one[[0, 2, 1]] for one in octants]) + 0.0  # no -0
    for _ in range(levels):
        a, b, c = triangles.transpose(1, 0, 2)
        ab, bc, ca = ((p + q) / np.linalg.norm(p + q, axis=1)[:, None] for p, q in ((a, b), (b, c), (c, a)))
        parts = (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)
        triangles = np.concatenate([np.stack(part, axis=1) for part in parts])
    corners, numbers = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    return corners, numbers.reshape(-1, 3)


REACH = 3.0
"""Support radius of the kernel for the fluid's density [spacings]."""
REACH_OF_COLOURS = 2.25
"""Support radius of the kernel for the fluid's colour [spacings]."""
ROUNDS, ROUNDS_OF_LIGHT = 36, 9
CUBE_WIDTHS = (30_000, 0.375), (60_000, 0.45), (inf, 0.55)
"""Greatest number of particles, and width [spacings] of the lattice cubes for at most so many particles."""
WeightedLook = wp.types.vector(6, wp.float32)
MOST_CELLS = 1 << 26
"""Greatest number of cells in the grid that finds near particles."""
CLEAREST = wp.constant(wp.float32(1.0e-3))
"""Small value [1/m] that `tint` adds to scattering and absorption before the logarithm."""
WITHIN, ASIDE = wp.constant(wp.float32(10.62)), wp.constant(wp.float32(1.93))
DROP, SHEET = wp.constant(wp.float32(0.82)), wp.constant(wp.float32(0.74))
"""Factors that reduce the volumes of isolated particles and of particles in thin sheets."""
FILLED = wp.constant(wp.vec3(0.45, 0.6, 0.85))
"""Fraction of space that particles fill: around isolated particles, in thin sheets, and in bulk fluid."""
FULL = wp.constant(wp.float32(2.84))
"""Weighted number of neighbours above which a particle is not in a thin sheet."""


@dataclass(frozen=True)
class LiquidSurface:
    points: wp.array
    triangles: wp.array
    """Vertices of triangles in one array (3 t,)."""
    normals: wp.array
    colours: wp.array
    media: wp.array
    """Scattering and absorption coefficients at the vertices (p,) as vec2 [1/m]."""
    neighbours: wp.array
    """Indices of the adjacent vertices of each vertex (p,), for `smoothed`."""

    def softened(self, light: wp.array, launch: BandLauncher) -> wp.array:
        everywhere = wp.ones(len(light), dtype=wp.float32, device=launch.device)
        return smoothed(light, self.neighbours, everywhere, ROUNDS_OF_LIGHT, launch)


@wp.func
def crowd(s: NearParticles, j: wp.int32):
    return s.volumes[j] * wp.vec2(1.0 / s.volumes[j] - 1.0, 1.0)


@wp.func
def tint(s: NearParticles, j: wp.int32):
    """Return the colour of a particle, and the logarithms of its scattering and absorption coefficients."""
    x = s.looks[j]
    return WeightedLook(x[0], x[1], x[2], wp.log(x[3] + CLEAREST), wp.log(x[4] + CLEAREST), 1.0)


crowd_near, tint_near = sum_near(crowd, wp.vec2), sum_near(tint, WeightedLook)


@wp.kernel(module=MODULE, enable_backward=False)
def find_weights(first: wp.int32, s: NearParticles, reach: wp.float32, points: Vec3s, weights: Floats):
    """Points in thin sheets get small smoothing weights (Löschner et al. 2023)."""
    v = first + wp.tid()
    near = crowd_near(s, points[v], reach)
    x = wp.min(near[0] / wp.max(near[1], 1.0e-9) / FULL, 1.0)
    weights[v] = x * x * x * (x * (6.0 * x - 15.0) + 10.0)


@wp.kernel(module=MODULE, enable_backward=False)
def find_looks(first: wp.int32, s: NearParticles, reach: wp.float32, points: Vec3s, colours: Vec3s, media: Vec2s):
    v = first + wp.tid()
    near = tint_near(s, points[v], reach)
    if near[5] <= 1.0e-6:
        near = tint_near(s, points[v], 2.0 * reach)
    weight = wp.max(near[5], 1.0e-9)
    colours[v] = wp.vec3(near[0], near[1], near[2]) / weight
    media[v] = wp.vec2(wp.exp(near[3] / weight) - CLEAREST, wp.exp(near[4] / weight) - CLEAREST)


@wp.func
def place(s: NearParticles, j: wp.int32):
    x = s.places[j] - s.lower
    return wp.vec4(x[0], x[1], x[2], 1.0)


place_near = sum_near(place, wp.vec4)


@wp.kernel(module=MODULE, enable_backward=False)
def find_sizes(first: wp.int32, s: NearParticles, reach: wp.float32, volumes: Floats):
    """Particles in thin sheets get smaller volumes."""
    i = first + wp.tid()
    near = place_near(s, s.places[i], reach)
    off = (wp.vec3(near[0], near[1], near[2]) / near[3] - s.places[i] + s.lower) / s.spacing
    fill = near[3] / WITHIN * wp.exp(ASIDE * wp.dot(off, off))
    thin = wp.lerp(DROP, SHEET, wp.min(fill / FILLED[0], 1.0))
    dense = wp.clamp((fill - FILLED[1]) / (FILLED[2] - FILLED[1]), 0.0, 1.0)
    volumes[i] = s.volumes[i] * wp.lerp(thin, 1.0, dense)


Level = tuple[Any, wp.array]
"""A density as `Blocks`, and the indices of the blocks that may contain the surface."""


def liquid_level(particles: Particles, spacing: float, launch: BandLauncher, least: float = 0.0) -> tuple[Level, Any]:
    """Return the density of fluid. The cubes of the lattice are at least ``least`` particle spacings wide."""
    reach, ends = REACH * spacing, _shown(particles, spacing, launch)
    cube = max(next(width for most, width in CUBE_WIDTHS if len(particles) <= most), least)
    s = near_particles(particles, ends, spacing, reach, launch)
    volumes, whole = wp.empty_like(s.volumes), s.volumes
    launch(find_sizes, len(volumes), s=s, reach=reach, volumes=volumes)
    s.volumes = volumes
    level = level_blocks(s, ends, cube * spacing, reach, launch)
    s.volumes = whole
    return level, s


def liquid_surface(
    particles: Particles, spacing: float, launch: BandLauncher, least: float = 0.0, level: Level | None = None
) -> LiquidSurface:
    """Return a smooth surface with thin sheets (Löschner et al. 2023), or raise `ComputationError` if there is none."""
    device, reach = launch.device, REACH * spacing
    if level is None:
        level, s = liquid_level(particles, spacing, launch, least)
    else:
        s = near_particles(particles, _shown(particles, spacing, launch), spacing, reach, launch)
    net = net_of(*level, launch)
    points, count = net.points, len(net.points)
    if not count:
        raise ComputationError("The fluid has no surface to draw, as the particles are too far from each other.")
    weights, colours = wp.empty(count, dtype=wp.float32, device=device), wp.empty_like(points)
    media = wp.empty(count, dtype=wp.vec2, device=device)
    launch(find_weights, count, s=s, reach=reach, points=points, weights=weights)
    points = smoothed(points, net.neighbours, weights, ROUNDS, launch)
    launch(find_looks, count, s=s, reach=REACH_OF_COLOURS * spacing, points=points, colours=colours, media=media)
    triangles, normals = triangles_of(net, points, launch), normals_of(net, points, launch)
    return LiquidSurface(points, triangles, normals, colours, media, net.neighbours)


def _shown(particles: Particles, spacing: float, launch: BandLauncher) -> tuple[Points, Points]:
    lower, upper = particles.ends(launch)
    if np.prod((upper - lower) / spacing + 1.0) <= MOST_CELLS:
        return lower, upper
    middle = np.quantile(particles.places.numpy(), 0.5, axis=0, method="nearest")
    reach = 0.5 * MOST_CELLS ** (1.0 / 3.0) * spacing
    return np.maximum(lower, middle - reach), np.minimum(upper, middle + reach)
