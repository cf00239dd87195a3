"""Mirror images of fluid behind the surfaces of solids that it touches.

Drawn with them, fluid goes on behind a surface, which hides it there, and no gap is seen between the two.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from cortado.discretise.shapes import Points
from cortado.pictures.shown_solids import ShownSolid

SKIN = 0.7
"""In spacings: how far beyond a particle fluid is drawn, about."""
DEPTHS = (1.0, 0.7, 0.4, 0.1)
"""Of mirror images behind a surface, in parts of the distance of what they show; the first that a thin solid hides."""
ON_SURFACE = 0.05
"""In spacings: how near to a surface a point is on it."""
SAME_SIDE = 0.8
"""Greatest cosine between the normals of two sides of a corner."""


def mirrored(
    points: Points, solids: Sequence[ShownSolid], touching: float, spacing: float
) -> tuple[Points, np.ndarray]:
    """Mirror images (m, d) [m] of points (n, d) [m] behind solids, and which point each of them shows, (m,).

    Points have images if they are nearer to a solid than ``touching`` [m]: behind each side of it that they touch, and
    behind corners between these. Where a solid is too thin to hide fluid that is drawn there, images are nearer to the
    surface, or there are none.
    """
    dimension = points.shape[1]
    images, of = [np.zeros((0, dimension))], [np.zeros(0, dtype=int)]
    for shown in solids:
        distances = shown.solid.distance(points)
        near = np.flatnonzero((distances > 0.0) & (distances < touching))
        ways = _ways(points[near], shown, touching, spacing)
        for count in range(1, dimension + 1):
            for chosen in combinations(ways, count):
                there = np.all([way.any(axis=1) for way in chosen], axis=0)
                images.append((points[near] + np.sum(chosen, axis=0))[there])
                of.append(near[there])
    return np.concatenate(images), np.concatenate(of)


def _ways(points: Points, shown: ShownSolid, touching: float, spacing: float) -> list[Points]:
    """From each of the points (n, d) [m] to its image behind each side that it touches, (n, d) [m]; 0 where there is
    none. Sides are looked for towards the nearest point, and along the axes of the solid."""
    solid, normals, ways = shown.solid, list[Points](), list[Points]()
    for probe in touching * np.concatenate([np.zeros((1, len(shown.turn))), shown.turn.T, -shown.turn.T]):
        feet, away = solid.nearest(points + probe), solid.outward(points + probe)
        heights = ((points - feet) * away).sum(axis=1)[:, None]
        below = points - heights * away
        is_new = ((heights > 0.0) & (heights < touching))[:, 0] & (np.abs(solid.distance(below)) < ON_SURFACE * spacing)
        for other in normals:
            is_new &= (away * other).sum(axis=1) < SAME_SIDE
        way = np.zeros_like(points)
        for part in DEPTHS[::-1]:
            hidden = is_new & (solid.distance(below - (part * heights + SKIN * spacing) * away) < 0.0)
            way = np.where(hidden[:, None], -(1.0 + part) * heights * away, way)
        normals.append(np.where(is_new[:, None], away, 0.0))
        ways.append(way)
    return ways
