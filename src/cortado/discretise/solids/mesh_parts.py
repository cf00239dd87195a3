"""Bodies of a mesh that overlap, in parts within each of which none do."""

import numpy as np

from cortado.discretise.shapes import Points
from cortado.discretise.solids.mesh import Mesh
from cortado.discretise.solids.triangle_tree import Numbers, TriangleTree


def parts_of(
    mesh: Mesh, tree: TriangleTree, labels: Numbers, crossings: Numbers, some: Numbers, beside: Points
) -> tuple[tuple[Numbers, ...], int | None, int | None]:
    """The triangles of each part, none if the mesh is one part that does not cross itself; a triangle at which a body
    crosses itself, and one of a body inside another, if there are such.

    Args:
        mesh: closed.
        tree: of its triangles.
        labels: (k,) the body of each triangle.
        crossings: (m, 2) pairs of triangles that cross.
        some: (s,) triangles, of each body at least one with an area.
        beside: (s, 3) a place just outside of each of those [m].
    """
    count = int(labels.max()) + 1
    bodies = [np.flatnonzero(labels == body) for body in range(count)]
    trees = [tree] if count == 1 else [TriangleTree.of(mesh.corners[body]) for body in bodies]
    around = np.array([one.windings(beside) for one in trees])
    seen = labels[some]
    owners = _owners(np.array([_volume(mesh.corners[body]) for body in bodies]), around, seen)
    own = owners[labels[crossings]]
    within = own[:, 0] == own[:, 1]
    crossing = int(crossings[within][0, 0]) if within.any() else None
    pieces = np.unique(owners)
    if len(pieces) == 1:
        return ((np.arange(len(labels)),) if within.any() else ()), crossing, None
    around = np.array([around[owners == piece].sum(axis=0) for piece in pieces])
    inside = np.zeros((len(pieces), len(pieces)), dtype=bool)  # of the first, some place beside the second
    wholly = inside.copy()
    seen = np.searchsorted(pieces, owners[seen])
    for number in range(len(pieces)):
        places = around[:, seen == number] > 0
        inside[:, number], wholly[:, number] = places.any(axis=1), places.all(axis=1) & (places.shape[1] > 0)
    np.fill_diagonal(inside, False)
    np.fill_diagonal(wholly, False)
    first, second = np.searchsorted(pieces, own[~within]).T
    met = inside | inside.T
    met[first, second] = met[second, first] = True
    wholly[first, second] = wholly[second, first] = False
    groups = _apart(met, [int(np.count_nonzero(owners[labels] == piece)) for piece in pieces])
    parts = tuple(np.flatnonzero(np.isin(owners[labels], pieces[group])) for group in groups)
    filled = np.flatnonzero(wholly.any(axis=0))
    hidden = int(np.argmax(owners[labels] == pieces[filled[0]])) if len(filled) else None
    return (parts if len(parts) > 1 or within.any() else ()), crossing, hidden


def _owners(volumes: Points, around: Numbers, seen: Numbers) -> Numbers:
    """(bodies,) the body that each belongs to: a cavity to the least of those around it, all others to themselves.

    ``around`` (bodies, s) how often each goes around places beside the bodies ``seen`` (s,).
    """
    owners = np.arange(len(volumes))
    for cavity in np.flatnonzero(volumes < 0.0):
        holds = (around[:, seen == cavity] > 0).all(axis=1) & (volumes > -volumes[cavity])
        if holds.any():
            candidates = np.flatnonzero(holds)
            owners[cavity] = candidates[np.argmin(volumes[candidates])]
    return owners


def _apart(met: np.ndarray, sizes: list[int]) -> list[list[int]]:
    """Numbers in as few groups as are found, the largest first, so that none has met another of its group."""
    groups: list[list[int]] = []
    for number in sorted(range(len(sizes)), key=lambda one: -sizes[one]):
        free = next((group for group in groups if not met[number, group].any()), None)
        if free is None:
            groups.append([number])
        else:
            free.append(number)
    return groups


def _volume(corners: Points) -> float:
    """What a closed surface of triangles (k, 3, 3) encloses [m3], negative if its normals point inwards."""
    a, b, c = np.moveaxis(corners - corners[0, 0], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6.0)
