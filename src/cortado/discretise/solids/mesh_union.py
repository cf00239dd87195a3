"""The surface of what parts of a mesh hold together, cut where they meet, in float64."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.discretise.solids.triangle_tree import Numbers

LYING = 10.0
"""In the distance at which one looks at what is beside a triangle: triangles nearer than that lie on it."""
THIN = 1e-15
"""Of the width of a triangle: what is thinner is left out of it."""


def outer_surface(
    corners: Points, pairs: Numbers, holds: Callable[[Points], NDArray[np.bool_]], reach: float
) -> tuple[Points, Points]:
    """Triangles (n, 3, 3) [m], pieces of triangles (k, 3, 3) [m], and the weight (n,) of each in integrals over the
    surface of what ``holds`` holds: 0 where both sides of it are inside or outside, less than 1 where several triangles
    lie on each other.

    Args:
        corners: of all triangles, counterclockwise as seen from outside.
        pairs: (m, 2) of triangles, all those that may meet beside their own edges.
        holds: (n,) which points (n, 3) [m] are inside.
        reach: how far from a triangle one looks at what is beside it [m].
    """
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    pairs = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
    met, starts = np.unique(pairs[:, 0], return_index=True)
    whole = np.setdiff1d(np.arange(len(corners)), met)
    pieces, counts = [corners[whole]], [np.ones(len(whole))]
    for number, others in zip(met, np.split(pairs[:, 1], starts)[1:], strict=True):
        piece, count = _cut(corners[number], corners[others], reach)
        pieces.append(piece)
        counts.append(count)
    found = np.concatenate(pieces)
    across = np.cross(found[:, 1] - found[:, 0], found[:, 2] - found[:, 0])
    size = np.linalg.norm(across, axis=1)
    beside = reach * across / np.where(size > 0.0, size, 1.0)[:, None]
    middles = found.mean(axis=1)
    ends = holds(middles - beside).astype(np.float64) - holds(middles + beside)
    return found, ends / np.concatenate(counts)


def _cut(corners: Points, others: Points, reach: float) -> tuple[Points, Points]:
    """Pieces (n, 3, 3) of a triangle (3, 3), none of which others (m, 3, 3) cross, and how many triangles (n,), itself
    included, lie no further from the middle of each than ``reach``."""
    side, normal = corners[1] - corners[0], np.cross(corners[1] - corners[0], corners[2] - corners[0])
    if not normal.any():
        return np.zeros((0, 3, 3)), np.zeros(0)
    first, last = side / np.linalg.norm(side), normal / np.linalg.norm(normal)
    frame = np.stack([first, np.cross(last, first), last])
    own, placed = (corners - corners[0]) @ frame.T, (others - corners[0]) @ frame.T
    lying = placed[(np.abs(placed[..., 2]) <= LYING * reach).all(axis=1)]
    segments = np.concatenate([_sides(own[None]), _through(placed), _sides(lying)])
    lower, upper = own[:, :2].min(axis=0), own[:, :2].max(axis=0)
    meets = (segments.min(axis=1) <= upper).all(axis=1) & (segments.max(axis=1) >= lower).all(axis=1)
    flat = _pieces(segments[meets], lower[0], upper[0])
    middles = flat.mean(axis=1)
    flat = flat[_within(own, middles)[0]]
    middles, counts = flat.mean(axis=1), np.ones(len(flat))
    for one in lying:
        inside, heights = _within(one, middles)
        counts += inside & (np.abs(heights) <= reach)
    return corners[0] + flat @ frame[:2], counts


def _sides(triangles: Points) -> Points:
    """(3 n, 2, 2) those of triangles (n, 3, 3), seen from above."""
    return np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2)[..., :2].reshape(-1, 2, 2)


def _through(triangles: Points) -> Points:
    """(m, 2, 2) where triangles (n, 3, 3) cross the plane at height 0."""
    heights, following = triangles[..., 2], np.roll(triangles, -1, axis=1)
    crossed = (heights > 0.0) != (following[..., 2] > 0.0)
    along = (heights / np.where(crossed, heights - following[..., 2], 1.0))[..., None]
    return (triangles + along * (following - triangles))[crossed][:, :2].reshape(-1, 2, 2)


def _within(triangle: Points, points: Points) -> tuple[NDArray[np.bool_], Points]:
    """(n,) whether points (n, 2) are in a triangle (3, 3), seen from above, and (n,) how high it is there."""
    a, b, c = triangle
    across = (b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0]
    if across == 0.0:
        return np.zeros(len(points), dtype=bool), np.zeros(len(points))
    away = points - a[:2]
    to_b = (away[:, 0] * (c - a)[1] - away[:, 1] * (c - a)[0]) / across
    to_c = (away[:, 1] * (b - a)[0] - away[:, 0] * (b - a)[1]) / across
    return (to_b >= 0.0) & (to_c >= 0.0) & (to_b + to_c <= 1.0), a[2] + to_b * (b - a)[2] + to_c * (c - a)[2]


def _pieces(segments: Points, lower: float, upper: float) -> Points:
    """(n, 3, 2) triangles, counterclockwise, between segments (s, 2, 2) in columns from one place to another along the
    first axis: a new one begins where a segment begins or ends, or where two cross."""
    order = np.argsort(segments[:, :, 0], axis=1)[..., None]
    (start, below), (end, above) = np.moveaxis(np.take_along_axis(segments, order, axis=1), (1, 2), (0, 1))
    leans = end > start
    start, below, end = start[leans], below[leans], end[leans]
    slope = (above[leans] - below) / (end - start)
    places = [segments[:, :, 0].ravel(), np.array([lower, upper])]
    for i in range(len(start)):
        steeper = slope[i + 1 :] - slope[i]
        apart = (below[i] - slope[i] * start[i]) - (below[i + 1 :] - slope[i + 1 :] * start[i + 1 :])
        crossed = apart / np.where(steeper == 0.0, np.nan, steeper)
        places.append(
            crossed[(crossed > np.maximum(start[i], start[i + 1 :])) & (crossed < np.minimum(end[i], end[i + 1 :]))]
        )
    columns = np.unique(np.concatenate(places))
    columns = columns[(columns >= lower) & (columns <= upper)]
    found = [np.zeros((0, 3, 2))]
    for left, right in pairwise(columns):
        if right - left <= THIN * (upper - lower):
            continue
        spans = (start <= left) & (end >= right)
        heights = below[spans, None] + slope[spans, None] * (np.array([left, right]) - start[spans, None])
        heights = heights[np.argsort(heights.sum(axis=1), kind="stable")]
        corners = np.stack(np.broadcast_arrays(np.array([left, right]), heights), axis=-1)
        low, high = corners[:-1], corners[1:]
        found.append(np.stack([low[:, 0], low[:, 1], high[:, 1]], axis=1))
        found.append(np.stack([low[:, 0], high[:, 1], high[:, 0]], axis=1))
    return np.concatenate(found)
