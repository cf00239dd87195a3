"""Triangles made a solid, or a sentence that says what is wrong with them, where, and what to do about it."""

from dataclasses import dataclass

import numpy as np

from cortado.discretise.shapes import Points, whole_origin
from cortado.discretise.solids.bodies import bodies
from cortado.discretise.solids.edges import Edges, many, place_in_file
from cortado.discretise.solids.merging import merged
from cortado.discretise.solids.mesh import Mesh
from cortado.discretise.solids.mesh_parts import parts_of
from cortado.discretise.solids.triangle_tree import Numbers, TriangleTree
from cortado.errors import InputError

SAME = 1e-6
"""Of the length of a mesh: vertices that are no further apart are one where edges are open otherwise, as float32 rounds
them."""
COARSE, TOLD = 0.02, 1e-3
"""Of the length of a mesh: coordinates that a file rounds to more are refused, and told of."""
ASIDE = 1e-6
"""Of the length of a mesh: how far from a surface one looks at what is beside it."""
CROSSED = 1e-7
"""Of the length of a mesh: what goes through a triangle by less only touches it."""
LOOKED_AT = 8192
"""Triangles about whose sides one asks."""


@dataclass(frozen=True, eq=False)
class FoundMesh:
    """What a file holds."""

    mesh: Mesh
    """In the file's unit of length, about an origin of its own."""
    origin: Points
    """(3,) where that is in the file: near the middle of a mesh that is far from the origin of the file, and 0 of all
    others."""
    notes: tuple[str, ...]
    """Sentences about what is probably not meant."""
    left_out: int
    """Triangles without area, or that came twice."""


def found_mesh(vertices: Points, triangles: Numbers, what: str, rounding: float = 0.0) -> FoundMesh:
    """The solid that triangles (k, 3) between vertices (m, 3) enclose; raises `InputError`, a sentence that calls the
    mesh ``what``. In the file coordinates are whole multiples of a ``rounding``, if that is not 0."""
    used = vertices[triangles.ravel()]
    if not np.isfinite(used).all():
        wrong = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
        raise InputError(
            f"{what} has {many(len(wrong), 'vertex', 'vertices')} with coordinates that are not finite, the first of "
            f"them number {wrong[0]}, counted from 0: export the mesh once more."
        )
    length = np.ptp(used, axis=0).max()
    far = (
        f"{what} lies far from the origin: move it before it is exported, as the file rounds its coordinates to "
        f"{rounding:g} there, beside a length of {length:g}."
    )
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
            f"{what} holds no volume: all of its {count} triangles have no area, or come twice, back to back; give the "
            "sheet a thickness."
        )
    edges.check(origin + vertices, what)
    mesh = Mesh(vertices, triangles)
    tree = TriangleTree.of(mesh.corners)
    parts, notes = _solid_parts(mesh, tree, bodies(edges, vertices, triangles, origin, what), origin, what)
    notes = (*notes, *((far,) if rounding > TOLD * length else ()))
    known = () if parts else (tree,)
    return FoundMesh(Mesh(vertices, triangles, parts, known), origin, notes, count - len(triangles))


def _solid_parts(
    mesh: Mesh, tree: TriangleTree, labels: Numbers, origin: Points, what: str
) -> tuple[tuple[Numbers, ...], tuple[str, ...]]:
    """The parts of a closed mesh, with the tree of its triangles, whose bodies have labels (k,), and notes about it;
    raises `InputError` where it is inside out. Its ``origin`` (3,) is where it is in the file."""
    size = np.ptp(mesh.corners, axis=(0, 1)).max()
    crossings = tree.crossings(mesh.triangles, CROSSED * size)
    some = np.unique(np.append(np.arange(0, len(labels), -(-len(labels) // LOOKED_AT)), crossings[:LOOKED_AT]))
    by_area = np.argsort(-mesh.areas(), kind="stable")
    some = np.unique(np.append(some, by_area[np.unique(labels[by_area], return_index=True)[1]]))
    some = some[mesh.areas()[some] > 0.0]
    beside = mesh.corners[some].mean(axis=1) + ASIDE * size * mesh.normals()[some]
    wrong = tree.windings(beside) < 0
    if wrong.any():
        raise InputError(_inside_out(wrong, labels, labels[some], what, origin + mesh.corners[some[np.argmax(wrong)]]))
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


def _inside_out(wrong: np.ndarray, labels: Numbers, seen: Numbers, what: str, corners: Points) -> str:
    """``seen``: the body of each triangle that was looked at; ``corners`` of one that is wrong."""
    if wrong.all():
        return (
            f"The normals of {what} point inwards, so that its inside would be outside: turn all of its triangles "
            "over, as trimesh's mesh.invert() does."
        )
    all_bodies, count = len(np.unique(labels)), len(np.unique(seen[wrong]))
    which = f"{count} of the {all_bodies} bodies of {what}" if all_bodies > 1 else f"a part of {what}"
    return (
        f"The normals of {which} point inwards, for example at {place_in_file(corners.mean(axis=0))}, where there is "
        "nothing solid around them: turn these triangles over, and mend what crosses itself."
    )
