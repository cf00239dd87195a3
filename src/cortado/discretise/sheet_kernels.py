"""Which segments go through a sheet, an open surface of edges in the plane or of triangles in space: its faces. One
that goes through the joint of two faces goes through the sheet, as faces reach a little beyond their edges."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import FLOAT64, Precision, TypesByName
from cortado.discretise.shapes import Points, in_space

MARGIN = 1e-6
"""In spacings: by how much faces are wider than they are."""
AROUND = 1e-3
"""In spacings: how far around a segment one looks for faces, in float32."""


@cache
def faces_type(precision: Precision) -> Any:
    """Make the Warp struct of the faces of sheets, of one sheet after the other, each in the frame of its sheet."""
    real, vector = precision.real, precision.vector

    class Faces:
        trees: wp.array(dtype=wp.uint64)
        """Of the boxes around the faces of each sheet."""
        starts: wp.array(dtype=wp.int32)
        """Number of the first face of each sheet."""
        middles: wp.array(dtype=vector)
        """Of each sheet, to which its faces are relative [m]."""
        normals: wp.array(dtype=vector)
        """(faces,) unit vectors"""
        places: wp.array2d(dtype=vector)
        """(faces, 3) a point on each end or side of a face [m]"""
        inwards: wp.array2d(dtype=vector)
        """(faces, 3) unit vectors from these into the face; 0 for a third one in the plane"""
        margin: real
        around: real
        """[m]"""

    Faces.__name__ = Faces.__qualname__ = f"Faces_{precision.name}"
    return wp.struct(Faces)


@cache
def face_functions(precision: Precision) -> tuple[Any, Any, Any]:
    """Make Warp functions, for places about the middle of sheet k: ``query``, which looks for its faces in the box
    around two places and a way around them; ``meets``, whether a segment goes through a face; and ``goes_through``,
    whether it does through any face of the sheet."""
    real, vector, faces_of = precision.real, precision.vector, faces_type(precision)

    @wp.func
    def low(a: vector) -> wp.vec3f:
        return wp.vec3f(wp.float32(a[0]), wp.float32(a[1]), wp.float32(a[2]))

    @wp.func
    def query(p: vector, q: vector, around: real, k: int, faces: faces_of) -> wp.BvhQuery:
        beyond = vector(around, around, around)
        return wp.bvh_query_aabb(faces.trees[k], low(wp.min(p, q) - beyond), low(wp.max(p, q) + beyond))

    @wp.func
    def meets(p: vector, q: vector, face: int, faces: faces_of) -> bool:
        n, a = faces.normals[face], faces.places[face, 0]
        h_p, h_q = wp.dot(n, p - a), wp.dot(n, q - a)
        if (h_p < real(0.0)) == (h_q < real(0.0)):
            return False
        y = p + (h_p / (h_p - h_q)) * (q - p)
        for side in range(3):
            if wp.dot(faces.inwards[face, side], y - faces.places[face, side]) < -faces.margin:
                return False
        return True

    @wp.func
    def goes_through(p: vector, q: vector, k: int, faces: faces_of) -> bool:
        candidates = query(p, q, faces.around, k, faces)
        face = int(0)
        while wp.bvh_query_next(candidates, face):
            if meets(p, q, faces.starts[k] + face, faces):
                return True
        return False

    return query, meets, goes_through


def faces_on(sheets: Sequence[tuple[Points, Points]], spacing: float, precision: Precision, device: Any) -> Any:
    """Return the struct of the faces of sheets, by their corners (k, d, d) [m] and unit normals (k, d), beside
    particles a spacing [m] apart, and the trees in it, which live as long as somebody has them."""
    made, trees, middles, rows = faces_type(precision)(), [], [], []
    for corners, normals in sheets:
        middle = 0.5 * (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1)))
        pieces = corners - middle
        following = np.roll(pieces, -1, axis=1) - pieces  # in the plane from either end to the other one
        inwards = np.cross(normals[:, None], following) if pieces.shape[1] == 3 else following
        inwards = inwards / np.linalg.norm(inwards, axis=2, keepdims=True)
        ends = (in_space(pieces.min(axis=1)), in_space(pieces.max(axis=1)))
        trees.append(wp.Bvh(*(wp.array(end, dtype=wp.vec3f, device=device) for end in ends)))
        middles.append(in_space(middle))
        rows.append((in_space(normals), _three(in_space(pieces)), _three(in_space(inwards))))

    def array(values: Any, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

    made.trees, made.middles = array([tree.id for tree in trees], wp.uint64), array(middles, precision.vector)
    made.starts = array(np.cumsum([0, *(len(corners) for corners, _ in sheets)])[:-1], wp.int32)
    for name, parts in zip(("normals", "places", "inwards"), zip(*rows, strict=True), strict=True):
        setattr(made, name, array(np.concatenate(parts), precision.vector))
    made.margin, made.around = MARGIN * spacing, AROUND * spacing
    return made, trees


def _three(rows: Points) -> Points:
    """Return vectors (k, 2 or 3, 3) with rows of 0 behind them, (k, 3, 3)."""
    return np.pad(rows, [(0, 0), (0, 3 - rows.shape[1]), (0, 0)])


@cache
def find_crossing() -> Any:
    """Make the kernel that tells which of some segments go through the one sheet that there is, in float64."""
    goes_through, vector = face_functions(FLOAT64)[2], FLOAT64.vector
    typed = TypesByName(wp.bool, {faces_type(FLOAT64): "faces", vector: "starts ends"})

    @wp.kernel(module=kernel_module("sheet_crossings"), enable_backward=False)
    @typed.arrays
    def find(first: int, faces, starts, ends, found):
        i = first + wp.tid()
        found[i] = goes_through(starts[i] - faces.middles[0], ends[i] - faces.middles[0], 0, faces)

    return find
