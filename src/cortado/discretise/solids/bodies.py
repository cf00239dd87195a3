"""Which triangles of a closed mesh are one body."""

import numpy as np

from cortado.discretise.shapes import Points
from cortado.discretise.solids.edges import Edges
from cortado.discretise.solids.triangle_tree import Numbers

SAME_WAY = 1e-6
"""Angle between triangles that lie on each other, where two bodies touch."""


def bodies(edges: Edges, vertices: Points, triangles: Numbers) -> Numbers:
    """(k,) which body each of the triangles (k, 3) belongs to, from 0 on, where all close.

    To the same body belong those that follow one another at an edge with the solid between them.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    names, count = edges.names.ravel(), len(triangles)
    sides = np.argsort(names, kind="stable")
    first = np.append(0, np.cumsum(edges.counts))[:-1]
    two = edges.counts == 2
    links = [np.column_stack([sides[first[two]], sides[first[two] + 1]])]
    for edge in np.flatnonzero(~two):
        there = sides[first[edge] : first[edge] + edges.counts[edge]]
        opposite = vertices[triangles.ravel()[3 * (there // 3) + (there + 2) % 3]]
        ends = edges.ways.ravel()[there] > 0
        links.append(there[_pairs(_angles(vertices[edges.ends[edge]], opposite), ends)])
    one, other = np.concatenate(links).T // 3
    graph = coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _angles(edge: Points, opposite: Points) -> Points:
    """(m,) the angles around an edge (2, 3) at which points (m, 3) are seen, right-handed."""
    along = (edge[1] - edge[0]) / np.linalg.norm(edge[1] - edge[0])
    across = np.eye(3)[np.argmin(np.abs(along))]
    right = np.cross(along, across)
    return np.arctan2((opposite - edge[0]) @ np.cross(along, right), (opposite - edge[0]) @ right)


def _pairs(angles: Points, ends: np.ndarray) -> Numbers:
    """(m / 2, 2) which of the triangles around an edge (m,) bound the same solid wedge: one at which it begins and the
    next at which one ends, where ``ends`` (m,) says which do; where two lie on each other, one ends before one begins.
    """
    turned = np.mod(angles - angles[np.argmin(ends)] + 0.5 * SAME_WAY, 2.0 * np.pi)
    order = np.lexsort((~ends, np.floor(turned / SAME_WAY)))
    begun: list[int] = []
    ended: list[int] = []
    pairs = []
    for number in map(int, order):
        waiting, own = (begun, ended) if ends[number] else (ended, begun)
        if ends[number] and waiting:
            pairs.append((waiting.pop(0), number))
        else:
            own.append(number)
    return np.array([*pairs, *zip(begun, ended, strict=True)], dtype=np.int64)
