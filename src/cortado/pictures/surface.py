"""The surface of a fluid as triangles: around all particles together, or a sphere around each."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from cortado.device.cores import usable_cores
from cortado.discretise.shapes import Points

NEIGHBOURS = 24
"""Particles that a point of the surface has its colour from."""

ROUND = 10_000
"""Spheres up to which each has 128 triangles, and 32 beyond."""


@dataclass(frozen=True)
class Surface:
    """Triangles in space, outside on the side from which their corners run counter-clockwise."""

    points: Points
    """(p, 3) [m]"""
    triangles: np.ndarray
    """(t, 3) indices of points"""
    normals: Points
    """(p, 3) unit vectors outwards"""
    colours: Points
    """(p, 3) linear, from 0 to 1"""


def nearest_colours(points: Points, positions: Points, colours: Points, spacing: float) -> Points:
    """(p, 3) at points (p, d) [m]: the mean over particles at positions (n, d) [m] with colours (n, 3), of which those
    nearest by count most."""
    from scipy.spatial import cKDTree

    distances, which = cKDTree(positions).query(points, k=min(NEIGHBOURS, len(positions)), workers=usable_cores())
    distances, which = distances.reshape(len(points), -1), which.reshape(len(points), -1)
    weights = np.exp((distances[:, :1] ** 2 - distances**2) / (0.95 * spacing) ** 2)
    return np.einsum("pk,pkc->pc", weights, colours[which]) / weights.sum(axis=1)[:, None]


def spheres(positions: Points, colours: Points, spacing: float) -> Surface:
    """A sphere around each of the particles (n, 3) [m], in its colour (n, 3), that touches those next to it."""
    corners, triangles = _sphere(2 if len(positions) <= ROUND else 1)
    n, k = len(positions), len(corners)
    return Surface(
        points=(positions[:, None] + 0.5 * spacing * corners).reshape(-1, 3),
        triangles=(k * np.arange(n)[:, None, None] + triangles).reshape(-1, 3).astype(np.int32),
        normals=np.tile(corners, (n, 1)),
        colours=np.repeat(colours, k, axis=0),
    )


@cache
def _sphere(levels: int) -> tuple[Points, np.ndarray]:
    """Corners (k, 3) of a unit sphere and its triangles: an octahedron, each triangle cut into four again and again."""
    corners = [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]
    triangles = [(a, b, c) if s > 0 else (a, c, b) for a, b, c, s in _octants()]
    for _ in range(levels):
        middles: dict[tuple[int, int], int] = {}

        def middle(i: int, j: int, known: dict[tuple[int, int], int] = middles) -> int:
            key = (min(i, j), max(i, j))
            if key not in known:
                known[key] = len(corners)
                between = np.add(corners[i], corners[j])
                corners.append(tuple(between / np.linalg.norm(between)))
            return known[key]

        triangles = [
            four
            for a, b, c in triangles
            for ab, bc, ca in [(middle(a, b), middle(b, c), middle(c, a))]
            for four in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        ]
    return np.array(corners), np.array(triangles)


def _octants() -> list[tuple[int, int, int, int]]:
    """The three corners of each face of an octahedron, and the sign of the way round."""
    return [(i, 2 + j, 4 + k, (-1) ** (i + j + k)) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
