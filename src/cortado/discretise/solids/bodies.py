"""Which triangles of a closed mesh are one body."""

import numpy as np

from cortado.discretise.shapes import Points
from cortado.discretise.solids.edges import Edges
from cortado.discretise.solids.triangle_tree import Numbers
from cortado.errors import InputError

SAME_WAY = 1e-6
"""Angle between triangles that lie on each other, where two bodies touch."""
TOGETHER = 1e-3
"""The same as float32 may round it, where one only asks in how many directions a surface goes on."""


def bodies(edges: Edges, vertices: Points, triangles: Numbers, origin: Points, what: str) -> Numbers:
    """(k,) which body each of the triangles (k, 3) belongs to, from 0 on, where all close.

    To the same body belong those that follow one another at an edge with the solid between them. Raises `InputError`, a
    sentence that calls the mesh ``what``, at an edge from which its surface goes on in more than two directions;
    ``origin`` (3,) is that of the mesh in the file.
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
        angles, ways = _angles(vertices[edges.ends[edge]], opposite), edges.ways.ravel()[there]
        if _directions(angles, ways) > 2:
            raise InputError(
                f"{what} has an edge that more than two triangles share, at "
                f"{edges.place(int(edge), origin + vertices)}, where bodies, or two parts of one, only touch: move "
                "them apart, or let them overlap."
            )
        links.append(there[_pairs(angles, ways > 0)])
    one, other = np.concatenate(links).T // 3
    graph = coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _angles(edge: Points, opposite: Points) -> Points:
    """(m,) the angles around an edge (2, 3) at which points (m, 3) are seen, right-handed."""
    along = (edge[1] - edge[0]) / np.linalg.norm(edge[1] - edge[0])
    across = np.eye(3)[np.argmin(np.abs(along))]
    right = np.cross(along, across)
    return np.arctan2((opposite - edge[0]) @ np.cross(along, right), (opposite - edge[0]) @ right)


def _directions(angles: Points, ways: Numbers) -> int:
    """In how many directions a surface goes on from an edge that triangles share, at angles and with ways (m,): of
    those that lie on each other as many count as are left once each is taken off that goes the other way."""
    order = np.argsort(angles)
    angles, ways = angles[order], ways[order]
    groups = np.cumsum(np.diff(angles, prepend=angles[0]) > TOGETHER)
    groups[2.0 * np.pi + angles[0] - angles <= TOGETHER] = 0
    return int(np.count_nonzero(np.bincount(groups, ways)))


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
