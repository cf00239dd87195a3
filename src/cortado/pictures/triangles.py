"""Triangles in space: their sides, normals and edges."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points

Numbers = NDArray[np.int64]
SAME = 1e-9
"""Of the size of all: how near vertices are that are one."""
SHARP = 0.8
"""Cosine of the angle between the normals of two triangles below which the edge between them is sharp."""


def merged(vertices: Points, corners: Numbers) -> tuple[Points, Numbers, NDArray[np.bool_]]:
    """The same triangles with one vertex where there were several, and which are kept: those that have an area."""
    whole = np.rint((vertices - vertices.min(axis=0)) / (SAME * np.ptp(vertices, axis=0).max()))
    _, first, number = np.unique(whole, axis=0, return_index=True, return_inverse=True)
    found = number.reshape(-1)[corners]
    has_area = (found[:, 0] != found[:, 1]) & (found[:, 1] != found[:, 2]) & (found[:, 2] != found[:, 0])
    return vertices[first], found[has_area], has_area


def sides_of(corners: Numbers) -> Numbers:
    """(3 t, 2) the sides of triangles (t, 3), those across each corner in turn."""
    return corners[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2)


def lengths_of(vertices: Points, sides: Numbers) -> Points:
    """(s,) how long sides (s, 2) are [m]."""
    return np.asarray(np.linalg.norm(vertices[sides[:, 0]] - vertices[sides[:, 1]], axis=1))


def across_of(vertices: Points, corners: Numbers) -> Points:
    """(t, 3) normals of triangles, outwards, as long as twice the area of each [m2]."""
    a, b, c = vertices[corners].transpose(1, 0, 2)
    return np.asarray(np.cross(b - a, c - a))


def unit(vectors: NDArray[Any]) -> Points:
    """Vectors (..., 3), each 1 long, but for those of no length."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))


def cosines_of(vertices: Points, corners: Numbers) -> Points:
    """(t, 3) of the angle between the normals of each triangle and the one beyond the side across each corner; -1 where
    there is not one beyond it."""
    flat = unit(across_of(vertices, corners))
    _, which, counts = np.unique(np.sort(sides_of(corners), axis=1), axis=0, return_inverse=True, return_counts=True)
    which = which.reshape(-1)
    summed = np.stack([np.bincount(which, np.repeat(flat[:, k], 3)) for k in range(3)], axis=1)
    return np.where(counts == 2, 0.5 * (summed**2).sum(axis=1) - 1.0, -1.0)[which].reshape(-1, 3)
