"""Triangles in space cut into small ones, without gaps between them."""

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.pictures.triangles import Numbers, lengths_of, merged, sides_of


def refined(vertices: Points, corners: Numbers, longest: float) -> tuple[Points, Numbers, Numbers]:
    """Triangles (t, 3) of vertices (v, 3) [m] cut into smaller ones, and of which triangle each is a part, (p,).

    Every side has a power of two of equal parts, as many as it needs to have none longer than ``longest`` [m], so that
    triangles beside each other fit; other sides of the parts are at most the square root of 2 longer.
    """
    parts = _parts(lengths_of(vertices, sides_of(corners)), longest).reshape(-1, 3)
    thin = (parts.min(axis=1) == 1) & (np.sort(parts, axis=1)[:, 1] > 1)
    found = [_halved(vertices, corners[~thin], np.flatnonzero(~thin), longest)]
    turned = (np.argmin(parts, axis=1)[:, None] + np.arange(3)) % 3  # so that the short side is across the first corner
    corners, parts = (np.take_along_axis(one, turned, axis=1) for one in (corners, parts))
    for second, first in np.unique(parts[thin, 1:], axis=0):
        which = np.flatnonzero(thin & (parts[:, 1:] == (second, first)).all(axis=1))
        found.append(_in_strips(vertices[corners[which]], which, first, second))
    starts = np.cumsum([0, *(len(one) for one, _, _ in found)])
    joined = [numbers + start for (_, numbers, _), start in zip(found, starts, strict=False)]
    parents = np.concatenate([one for _, _, one in found])
    vertices, corners, kept = merged(np.concatenate([one for one, _, _ in found]), np.concatenate(joined))
    return vertices, corners, parents[kept]


def _parts(lengths: Points, longest: float) -> Numbers:
    """Into how many parts a side is cut."""
    return 2 ** np.ceil(np.log2(np.maximum(lengths / longest, 1.0))).astype(np.int64)


def _halved(vertices: Points, corners: Numbers, parents: Numbers, longest: float) -> tuple[Points, Numbers, Numbers]:
    """Triangles, each of whose long sides is cut in two again and again."""
    while len(corners):
        sides, which = np.unique(np.sort(sides_of(corners), axis=1), axis=0, return_inverse=True)
        is_long = _parts(lengths_of(vertices, sides), longest) > 1
        if not is_long.any():
            break
        middles = np.full(len(sides), -1)
        middles[is_long] = len(vertices) + np.arange(is_long.sum())
        vertices = np.concatenate([vertices, vertices[sides[is_long]].mean(axis=1)])
        corners, parents = _cut(corners, middles[which.reshape(-1, 3)], parents)
    return vertices, corners, parents


def _cut(corners: Numbers, middles: Numbers, parents: Numbers) -> tuple[Numbers, Numbers]:
    """Triangles (t, 3) in parts: ``middles`` (t, 3) is the new vertex of the side across each corner, or -1."""
    count, found, own = (middles >= 0).sum(axis=1), [], []

    def add(which: NDArray[np.bool_], *parts: tuple[Numbers, Numbers, Numbers]) -> None:
        for part in parts:
            found.append(np.stack(part, axis=1)[which])
            own.append(parents[which])

    for k in range(3):
        (a, b, c), (x, y, z) = np.roll(corners, -k, axis=1).T, np.roll(middles, -k, axis=1).T
        add((count == 1) & (x >= 0), (a, b, x), (a, x, c))
        add((count == 2) & (x < 0), (a, z, y), (z, b, y), (b, c, y))
        if k == 0:
            add(count == 0, (a, b, c))
            add(count == 3, (a, z, y), (z, b, x), (y, x, c), (x, y, z))
    return np.concatenate(found), np.concatenate(own)


def _in_strips(triangles: Points, parents: Numbers, first: int, second: int) -> tuple[Points, Numbers, Numbers]:
    """Thin triangles (t, 3, 3) [m], cut across their long sides: that from the first corner to the second into
    ``first`` parts, that to the third into ``second`` parts."""
    tip, *ends = triangles.transpose(1, 0, 2)
    rows = [tip + (k / n) * (end - tip) for n, end in zip((first, second), ends, strict=True) for k in range(1, n + 1)]
    vertices = np.stack([tip, *rows], axis=1)
    own, i, j = list[tuple[int, int, int]](), 0, 0
    while i < first or j < second:
        here, there = i, first + j if j else 0
        if j == second or (i < first and (i + 1) * second <= (j + 1) * first):
            i += 1
            own.append((here, i, there))
        else:
            j += 1
            own.append((here, first + j, there))
    starts = (1 + first + second) * np.arange(len(triangles))
    corners = (starts[:, None, None] + np.array(own)).reshape(-1, 3)
    return vertices.reshape(-1, 3), corners, np.repeat(parents, len(own))
