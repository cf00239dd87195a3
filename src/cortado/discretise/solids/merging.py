"""Triangles that share vertices, out of triangles as files have them, each with vertices of its own."""

import numpy as np

from cortado.discretise.shapes import Points
from cortado.discretise.solids.triangle_tree import Numbers


def merged(vertices: Points, triangles: Numbers, tolerance: float = 0.0) -> tuple[Points, Numbers]:
    """Triangles (k, 3) between vertices (m, 3) that are at different places, or further apart than a tolerance.

    Left out are those that have a vertex twice, what comes once more, and pairs that are back to back, as where two
    bodies touch.
    """
    vertices, names = _distinct(vertices)
    if tolerance > 0.0:
        vertices, names = _further_apart(vertices, names, tolerance)
    triangles = names[triangles]
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    turned = np.take_along_axis(triangles, (triangles.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    once = np.sort(np.unique(turned, axis=0, return_index=True)[1])
    _, found, counts = np.unique(np.sort(turned[once], axis=1), axis=0, return_inverse=True, return_counts=True)
    return vertices, triangles[once[counts[found.ravel()] == 1]]


def _distinct(vertices: Points) -> tuple[Points, Numbers]:
    """Vertices at different places, and which of them each of those that are given is."""
    order = np.lexsort(vertices.T)
    new = np.append(True, (np.diff(vertices[order], axis=0) != 0.0).any(axis=1))
    names = np.empty(len(vertices), dtype=np.int64)
    names[order] = np.cumsum(new) - 1
    return vertices[order[new]], names


def _further_apart(vertices: Points, names: Numbers, tolerance: float) -> tuple[Points, Numbers]:
    """The same with one vertex in the place of several that are no further apart than a tolerance."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    first, second = cKDTree(vertices).query_pairs(tolerance, output_type="ndarray").T
    links = coo_array((np.ones(len(first), dtype=np.int8), (first, second)), shape=(len(vertices),) * 2)
    groups = connected_components(links, directed=False)[1]
    return vertices[np.unique(groups, return_index=True)[1]], np.asarray(groups[names], dtype=np.int64)
