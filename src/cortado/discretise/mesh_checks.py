"""Checks that turn triangles into a solid, or report mistakes and remedies."""

from dataclasses import dataclass

import numpy as np

from cortado.calls import counted
from cortado.discretise.mesh import Mesh, TriangleTree
from cortado.discretise.shapes import Numbers, Points, Which, whole_origin
from cortado.errors import InputError

SAME = 1e-6
"""Greatest distance between merged vertices, relative to the size of the mesh."""
COARSE, TOLD = 0.02, 1e-3
"""Rounding of coordinates above which a file is refused or noted, relative to the size of the mesh."""
ASIDE = 1e-6
"""Distance from a surface at which its two sides are tested, relative to the size of the mesh."""
CROSSED = 1e-7
"""Depth of a crossing of two triangles above which the crossing counts, relative to the size of the mesh."""
LOOKED_AT = 8192
SAME_WAY = 1e-6
"""Greatest angle between coincident triangles at an edge [rad]."""
TOGETHER = 1e-3
"""Greatest angle between triangles at an edge that count as parallel, because coordinates are float32 [rad]."""
MEETING = (
    "{what} has {edges} at which three triangles or more meet without closing, the first at {place}, so that nothing "
    "says what is inside: delete faces that divide its inside or stick out of it."
)
OPEN = (
    "{what} is not closed, so that nothing says what is inside: it has {edges}, the first at {place}; close its holes, "
    "small ones by trimesh's mesh.fill_holes(), and give a sheet a thickness."
)
TURNED = (
    "Normals of {what} point inwards at some triangles and outwards at others: they change at {edges}, the first at "
    "{place}; let all point outwards, as trimesh's mesh.fix_normals() does."
)


@dataclass(frozen=True)
class Edges:
    ends: Numbers
    """Indices of the two vertices of each edge (e, 2), with the lower index first."""
    names: Numbers
    """Indices of the edges of each triangle (k, 3)."""
    ways: Numbers
    """Directions of the edges in each triangle (k, 3): 1 from the lower to the higher vertex index, or -1."""

    @classmethod
    def of(cls, triangles: Numbers) -> "Edges":
        sides = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1)
        ends = np.sort(sides, axis=-1)
        span = int(triangles.max(initial=0)) + 1
        keys, names = np.unique(ends[..., 0] * span + ends[..., 1], return_inverse=True)
        ways = np.where(sides[..., 0] < sides[..., 1], 1, -1)
        return cls(np.column_stack([keys // span, keys % span]), names.reshape(-1, 3), ways)

    @property
    def counts(self) -> Numbers:
        return np.bincount(self.names.ravel(), minlength=len(self.ends))

    def close(self) -> Which:
        """At a closed edge, equally many triangles run along the edge in both directions."""
        return np.asarray(np.bincount(self.names.ravel(), self.ways.ravel(), len(self.ends)) == 0.0)

    def check(self, vertices: Points, what: str) -> None:
        unbalanced, counts = ~self.close(), self.counts
        meeting, opened = (unbalanced & (counts > 2), "edge", MEETING), (counts == 1, "open edge", OPEN)
        for wrong, edge, sentence in (meeting, opened, (unbalanced, "edge", TURNED)):
            if wrong.any():
                place = self.place(int(np.argmax(wrong)), vertices)
                raise InputError(sentence.format(what=what, edges=counted(int(wrong.sum()), edge), place=place))

    def place(self, edge: int, vertices: Points) -> str:
        return place_in_file(vertices[self.ends[edge]].mean(axis=0))


def place_in_file(place: Points) -> str:
    return f"({', '.join(f'{value:.7g}' for value in place)}) in the file"


def merged(vertices: Points, triangles: Numbers, tolerance: float = 0.0) -> tuple[Points, Numbers]:
    """Merge vertices closer than ``tolerance``. Remove duplicate and degenerate triangles."""
    from scipy.spatial import cKDTree

    order, names = np.lexsort(vertices.T), np.empty(len(vertices), dtype=np.int64)
    new = np.append(True, (np.diff(vertices[order], axis=0) != 0.0).any(axis=1))
    names[order], vertices = np.cumsum(new) - 1, vertices[order[new]]
    if tolerance > 0.0:
        groups = _connected(cKDTree(vertices).query_pairs(tolerance, output_type="ndarray"), len(vertices))
        vertices, names = vertices[np.unique(groups, return_index=True)[1]], groups[names]
    triangles = names[triangles]
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    turned = np.take_along_axis(triangles, (triangles.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    once = np.sort(np.unique(turned, axis=0, return_index=True)[1])
    _, found, counts = np.unique(np.sort(turned[once], axis=1), axis=0, return_inverse=True, return_counts=True)
    return vertices, triangles[once[counts[found.ravel()] == 1]]


def _connected(links: Numbers, count: int) -> Numbers:
    from trimesh.graph import connected_component_labels

    return np.asarray(connected_component_labels(links, count), dtype=np.int64)


def bodies(edges: Edges, vertices: Points, triangles: Numbers, origin: Points, what: str) -> Numbers:
    """Return the index of each triangle's body (k,). Two triangles at an edge belong to one body if the solid lies
    between the two triangles. ``origin`` (3,) is the position of the mesh in the file."""
    sides = np.argsort(edges.names.ravel(), kind="stable")
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
    return _connected(np.concatenate(links) // 3, len(triangles))


def _angles(edge: Points, opposite: Points) -> Points:
    along = (edge[1] - edge[0]) / np.linalg.norm(edge[1] - edge[0])
    across = np.eye(3)[np.argmin(np.abs(along))]
    right = np.cross(along, across)
    return np.arctan2((opposite - edge[0]) @ np.cross(along, right), (opposite - edge[0]) @ right)


def _directions(angles: Points, ways: Numbers) -> int:
    order = np.argsort(angles)
    angles, ways = angles[order], ways[order]
    groups = np.cumsum(np.diff(angles, prepend=angles[0]) > TOGETHER)
    groups[2.0 * np.pi + angles[0] - angles <= TOGETHER] = 0
    return int(np.count_nonzero(np.bincount(groups, ways)))


def _pairs(angles: Points, ends: np.ndarray) -> Numbers:
    """Return the pairs of triangles at an edge (m / 2, 2) that enclose a wedge of the solid."""
    turned = np.mod(angles - angles[np.argmin(ends)] + 0.5 * SAME_WAY, 2.0 * np.pi)
    order = np.lexsort((~ends, np.floor(turned / SAME_WAY)))
    begun, ended, pairs = list[int](), list[int](), []
    for number in map(int, order):
        waiting, own = (begun, ended) if ends[number] else (ended, begun)
        if ends[number] and waiting:
            pairs.append((waiting.pop(0), number))
        else:
            own.append(number)
    return np.array([*pairs, *zip(begun, ended, strict=True)], dtype=np.int64)


def parts_of(
    mesh: Mesh, tree: TriangleTree, labels: Numbers, crossings: Numbers, some: Numbers, beside: Points
) -> tuple[tuple[Numbers, ...], int | None, int | None]:
    """Divide the triangles into parts, so that no two bodies in the same part overlap. No parts are returned if the
    mesh does not cross itself. Also return a triangle where a body crosses itself, or None, and a triangle of a body
    inside another body, or None.

    ``labels`` (k,) is the index of each triangle's body, and ``crossings`` (m, 2) are the pairs of triangles that
    cross. Every body has a triangle with an area in ``some`` (s,). ``beside`` (s, 3) is a point just outside each
    triangle in ``some`` [m].
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
    inside = np.zeros((len(pieces), len(pieces)), dtype=bool)  # a point beside the second is inside the first
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
    """The owner of a cavity is the smallest body around the cavity. Any other body owns itself."""
    owners = np.arange(len(volumes))
    for cavity in np.flatnonzero(volumes < 0.0):
        holds = (around[:, seen == cavity] > 0).all(axis=1) & (volumes > -volumes[cavity])
        if holds.any():
            candidates = np.flatnonzero(holds)
            owners[cavity] = candidates[np.argmin(volumes[candidates])]
    return owners


def _apart(met: np.ndarray, sizes: list[int]) -> list[list[int]]:
    """Divide indices into a small number of groups. ``met`` is False for any two indices in a group."""
    groups: list[list[int]] = []
    for number in sorted(range(len(sizes)), key=lambda one: -sizes[one]):
        free = next((group for group in groups if not met[number, group].any()), None)
        if free is None:
            groups.append([number])
        else:
            free.append(number)
    return groups


def _volume(corners: Points) -> float:
    """The volume is negative if the normals point inwards."""
    a, b, c = np.moveaxis(corners - corners[0, 0], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6.0)


@dataclass(frozen=True, eq=False)
class FoundMesh:
    mesh: Mesh
    """The mesh in the file's unit of length, relative to ``origin``."""
    origin: Points
    """Position (3,) of the mesh in the file, which is 0 for a mesh near the file's origin."""
    notes: tuple[str, ...]
    left_out: int


def found_mesh(vertices: Points, triangles: Numbers, what: str, rounding: float = 0.0) -> FoundMesh:
    """``rounding`` is the rounding step of the coordinates, or 0. ``what`` is the name of the mesh."""
    used = vertices[triangles.ravel()]
    if not np.isfinite(used).all():
        wrong = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
        raise InputError(
            f"{what} has {len(wrong)} {'vertex' if len(wrong) == 1 else 'vertices'} with coordinates that are not "
            f"finite, the first of them number {wrong[0]}, counted from 0: export the mesh once more."
        )
    length = np.ptp(used, axis=0).max()
    far = f"{what} lies far from the origin: move it before it is exported, as the file rounds its coordinates to "
    far += f"{rounding:g} there, beside a length of {length:g}."
    if rounding > COARSE * length:
        raise InputError(far)
    count, origin = len(triangles), whole_origin(used)
    vertices, triangles = merged(vertices - origin, triangles)
    edges = Edges.of(triangles)
    if not edges.close().all():
        if rounding > TOLD * length:
            raise InputError(far)
        vertices, triangles = merged(vertices, triangles, SAME * length)
        edges = Edges.of(triangles)
    if not len(triangles):
        raise InputError(
            f"{what} holds no volume: all of its {count} triangles have no area, or coincide in pairs that face "
            "opposite ways; give the sheet a thickness."
        )
    edges.check(origin + vertices, what)
    mesh = Mesh(vertices, triangles)
    tree = TriangleTree.of(mesh.corners)
    parts, notes = _solid_parts(mesh, tree, bodies(edges, vertices, triangles, origin, what), origin, what)
    notes += (far,) if rounding > TOLD * length else ()
    known = () if parts else (tree,)
    return FoundMesh(Mesh(vertices, triangles, parts, known), origin, notes, count - len(triangles))


def _solid_parts(
    mesh: Mesh, tree: TriangleTree, labels: Numbers, origin: Points, what: str
) -> tuple[tuple[Numbers, ...], tuple[str, ...]]:
    """Return the parts, and notes for the user. ``labels`` (k,) is the body of each triangle."""
    size = np.ptp(mesh.corners, axis=(0, 1)).max()
    crossings = tree.crossings(mesh.triangles, CROSSED * size)
    some = np.unique(np.append(np.arange(0, len(labels), -(-len(labels) // LOOKED_AT)), crossings[:LOOKED_AT]))
    by_area = np.argsort(-mesh.areas(), kind="stable")
    some = np.unique(np.append(some, by_area[np.unique(labels[by_area], return_index=True)[1]]))
    some = some[mesh.areas()[some] > 0.0]
    beside = mesh.corners[some].mean(axis=1) + ASIDE * size * mesh.normals()[some]
    wrong = tree.windings(beside) < 0
    if wrong.all():
        raise InputError(
            f"The normals of {what} point inwards, so that inside and outside are exchanged: turn all of its triangles "
            "over, as trimesh's mesh.invert() does."
        )
    if wrong.any():
        all_bodies, count = len(np.unique(labels)), len(np.unique(labels[some][wrong]))
        which = f"{count} of the {all_bodies} bodies of {what}" if all_bodies > 1 else f"a part of {what}"
        place = place_in_file((origin + mesh.corners[some[np.argmax(wrong)]]).mean(axis=0))
        raise InputError(
            f"The normals of {which} point inwards, for example at {place}, where no solid surrounds the triangles: "
            "turn these triangles over, and repair surfaces that cross themselves."
        )
    notes = []
    parts, crossing, filled = parts_of(mesh, tree, labels, crossings, some, beside)
    middles = origin + mesh.corners.mean(axis=1)
    if crossing is not None:
        notes.append(
            f"{what} crosses itself, for example at {place_in_file(middles[crossing])}: what it goes around twice "
            "counts once; mend it if that is not meant."
        )
    if filled is not None:
        notes.append(
            f"A body of {what} lies inside another one, for example at {place_in_file(middles[filled])}, and makes no "
            "difference: for a cavity turn its triangles over, as trimesh's mesh.invert() does."
        )
    return parts, tuple(notes)
