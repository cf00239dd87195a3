"""Queries on surfaces, in float64: the nearest point on triangles, winding numbers, and crossings of line segments with
sheets.

The triangles are stored in a binary tree. The children of node n are the nodes 2 n and 2 n + 1. A node is a leaf if its
number is at least ``leaves``. The first leaf contains the triangles ``starts[0]`` to ``starts[1] - 1``.

A sheet is an open surface of faces, which are edges in 2-D and triangles in 3-D. Faces extend slightly beyond their
boundaries, so that no line segment passes between two faces.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import FLOAT64, Precision, TypesByName
from cortado.discretise.shapes import Points, in_space

DEPTH = 32
real, vector = wp.float64, wp.vec3d
box = wp.types.vector(length=6, dtype=wp.float64)
waiting_nodes, waiting_squares = wp.types.vector(length=DEPTH, dtype=wp.int32), wp.types.vector(DEPTH, wp.float64)
_module = kernel_module("triangle_tree")
_kinds = {vector: "points nearest", box: "boxes", real: "squares", wp.vec3i: "names"}
typed = TypesByName(wp.int32, {**_kinds, wp.array2d(dtype=vector): "corners"})


@wp.func
def square_from_box(p: vector, b: box) -> real:
    square = real(0.0)
    for k in range(3):
        beyond = wp.max(wp.max(b[k] - p[k], p[k] - b[k + 3]), real(0.0))
        square += beyond * beyond
    return square


@wp.func
def nearest_of_triangle(p: vector, a: vector, b: vector, c: vector) -> vector:
    """Return the nearest point on a triangle (Ericson, Real-Time Collision Detection, 2005, section 5.1.5)."""
    zero = real(0.0)
    ab = b - a
    ac = c - a
    d1 = wp.dot(ab, p - a)
    d2 = wp.dot(ac, p - a)
    if d1 <= zero and d2 <= zero:
        return a
    d3 = wp.dot(ab, p - b)
    d4 = wp.dot(ac, p - b)
    if d3 >= zero and d4 <= d3:
        return b
    vc = d1 * d4 - d3 * d2
    if vc <= zero and d1 >= zero and d3 <= zero:
        return a + (d1 / (d1 - d3)) * ab
    d5 = wp.dot(ab, p - c)
    d6 = wp.dot(ac, p - c)
    if d6 >= zero and d5 <= d6:
        return c
    vb = d5 * d2 - d1 * d6
    if vb <= zero and d2 >= zero and d6 <= zero:
        return a + (d2 / (d2 - d6)) * ac
    va = d3 * d6 - d5 * d4
    if va <= zero and d4 >= d3 and d5 >= d6:
        return b + ((d4 - d3) / ((d4 - d3) + (d5 - d6))) * (c - b)
    return a + (vb / (va + vb + vc)) * ab + (vc / (va + vb + vc)) * ac


@typed.kernel(_module)
def find_nearest(first: int, points, boxes, starts, corners, leaves: int, reach: real, nearest, squares):
    """If no triangle is within the distance ``reach``, the given point itself is stored."""
    i = first + wp.tid()
    p = points[i]
    best = reach * reach
    place = p
    node = int(1)
    waiting = int(0)
    nodes = waiting_nodes()
    at_least = waiting_squares()
    while node > 0:
        following = int(0)
        if node >= leaves:
            for t in range(starts[node - leaves], starts[node - leaves + 1]):
                found = nearest_of_triangle(p, corners[t, 0], corners[t, 1], corners[t, 2])
                square = wp.length_sq(found - p)
                if square < best:
                    best = square
                    place = found
        else:
            near = 2 * node
            far = near + 1
            near_square = square_from_box(p, boxes[near])
            far_square = square_from_box(p, boxes[far])
            if far_square < near_square:
                near = 2 * node + 1
                far = 2 * node
                larger = near_square
                near_square = far_square
                far_square = larger
            if near_square < best:
                following = near
            if far_square < best:
                nodes[waiting] = far
                at_least[waiting] = far_square
                waiting += 1
        while following == 0 and waiting > 0:
            waiting -= 1
            if at_least[waiting] < best:
                following = nodes[waiting]
        node = following
    nearest[i] = place
    squares[i] = best


@wp.func
def side_of_edge(p: vector, a: vector, b: vector) -> wp.int32:
    """Return 1 if a ray from a point along the first axis crosses an upward edge, and -1 for a downward edge. Return 0
    if the ray misses the edge. The two triangles that share an edge get consistent results."""
    upwards = int(1)
    low = a
    high = b
    if b[1] < a[1]:
        upwards = int(-1)
        low = b
        high = a
    if p[1] < low[1] or p[1] >= high[1]:
        return int(0)
    if (high[0] - low[0]) * (p[1] - low[1]) - (high[1] - low[1]) * (p[0] - low[0]) > real(0.0):
        return upwards
    return int(0)


@wp.func
def crossing(p: vector, a: vector, b: vector, c: vector) -> wp.int32:
    """Return 1 if a ray along the last axis leaves the solid through a triangle. Return -1 if the ray enters the solid
    through the triangle, and 0 if the ray misses the triangle."""
    around = side_of_edge(p, a, b) + side_of_edge(p, b, c) + side_of_edge(p, c, a)
    if around == 0 or p[2] > wp.max(a[2], wp.max(b[2], c[2])):
        return int(0)
    if p[2] < wp.min(a[2], wp.min(b[2], c[2])):
        return around
    if wp.dot(wp.cross(b - a, c - a), p - a) * real(around) > real(0.0):
        return int(0)
    return around


@typed.kernel(_module)
def find_windings(first: int, points, boxes, starts, corners, leaves: int, windings):
    """The winding number is 1 inside a surface with outward normals."""
    i = first + wp.tid()
    p = points[i]
    total = int(0)
    waiting = int(1)
    nodes = waiting_nodes()
    nodes[0] = int(1)
    while waiting > 0:
        waiting -= 1
        node = nodes[waiting]
        b = boxes[node]
        if p[0] >= b[0] and p[0] <= b[3] and p[1] >= b[1] and p[1] <= b[4] and p[2] <= b[5]:
            if node >= leaves:
                for t in range(starts[node - leaves], starts[node - leaves + 1]):
                    total += crossing(p, corners[t, 0], corners[t, 1], corners[t, 2])
            else:
                nodes[waiting] = 2 * node
                nodes[waiting + 1] = 2 * node + 1
                waiting += 2
    windings[i] = total


@wp.func
def pierces(p: vector, q: vector, a: vector, b: vector, c: vector, tolerance: real) -> wp.bool:
    """The ends p and q of the segment must be further than ``tolerance`` from the triangle's plane."""
    normal = wp.cross(b - a, c - a)
    size = wp.length(normal)
    above = wp.dot(normal, p - a)
    below = wp.dot(normal, q - a)
    least = tolerance * size
    if size == real(0.0) or wp.min(wp.abs(above), wp.abs(below)) <= least or above * below > real(0.0):
        return wp.bool(False)
    d = q - p
    one = wp.dot(d, wp.cross(a - p, b - p))
    two = wp.dot(d, wp.cross(b - p, c - p))
    three = wp.dot(d, wp.cross(c - p, a - p))
    least = wp.min(one, wp.min(two, three))
    most = wp.max(one, wp.max(two, three))
    return least > real(0.0) or most < real(0.0)


@wp.func
def has(names: wp.vec3i, name: wp.int32) -> wp.bool:
    return names[0] == name or names[1] == name or names[2] == name


@wp.func
def some_edge_pierces(
    corners: wp.array2d(dtype=vector), names: wp.array(dtype=wp.vec3i), s: wp.int32, t: wp.int32, tolerance: real
) -> wp.bool:
    """Edges of triangle s that share a vertex with triangle t are ignored."""
    found = wp.bool(False)
    for k in range(3):
        following = (k + 1) % 3
        if not has(names[t], names[s][k]) and not has(names[t], names[s][following]):
            p = corners[s, k]
            q = corners[s, following]
            found = found or pierces(p, q, corners[t, 0], corners[t, 1], corners[t, 2], tolerance)
    return found


@typed.kernel(_module)
def find_crossings(
    first: int, points, boxes, starts, corners, leaves: int, names, tolerance: real, places, counts, others
):
    """For triangle i, the higher numbers of crossing triangles are written to ``others``, from index ``places[i]`` up
    to ``places[i + 1]``. Crossings beyond this range are only counted in ``counts``."""
    i = first + wp.tid()
    low = wp.min(corners[i, 0], wp.min(corners[i, 1], corners[i, 2]))
    high = wp.max(corners[i, 0], wp.max(corners[i, 1], corners[i, 2]))
    count = int(0)
    waiting = int(1)
    nodes = waiting_nodes()
    nodes[0] = int(1)
    while waiting > 0:
        waiting -= 1
        node = nodes[waiting]
        b = boxes[node]
        apart = wp.bool(False)
        for k in range(3):
            apart = apart or low[k] > b[k + 3] or high[k] < b[k]
        if not apart:
            if node >= leaves:
                for t in range(wp.max(starts[node - leaves], i + 1), starts[node - leaves + 1]):
                    if some_edge_pierces(corners, names, i, t, tolerance) or some_edge_pierces(
                        corners, names, t, i, tolerance
                    ):
                        if places[i] + count < places[i + 1]:
                            others[places[i] + count] = t
                        count += 1
            else:
                nodes[waiting] = 2 * node
                nodes[waiting + 1] = 2 * node + 1
                waiting += 2
    counts[i] = count


MARGIN = {"float64": 1e-6, "float32": 1e-3}
"""Faces extend beyond their boundaries by more than round-off at 1,000 spacings from the origin [spacings]."""
AROUND = 1e-3
"""Margin around a line segment in the search for nearby faces, which uses float32 [spacings]."""


@cache
def faces_type(precision: Precision) -> Any:
    real, vector = precision.real, precision.vector

    class Faces:
        trees: wp.array(dtype=wp.uint64)
        """Bounding volume hierarchies of the faces, one for each sheet."""
        starts: wp.array(dtype=wp.int32)
        """Index of the first face of each sheet."""
        middles: wp.array(dtype=vector)
        """Centre of each sheet [m]. Positions of a sheet's faces are relative to the sheet's centre."""
        normals: wp.array(dtype=vector)
        places: wp.array2d(dtype=vector)
        """A point on each boundary of each face (faces, 3) [m]."""
        inwards: wp.array2d(dtype=vector)
        """Unit vectors from each boundary of a face into the face (faces, 3). In 2-D the third vector is 0."""
        margin: real
        around: real

    Faces.__name__ = Faces.__qualname__ = f"Faces_{precision.name}"
    return wp.struct(Faces)


@cache
def face_functions(precision: Precision) -> tuple[Any, Any, Any]:
    """Points are relative to the centre of a sheet. ``query`` finds the faces in a box around two points, ``meets``
    tests a given face, and ``goes_through`` tests all faces of a sheet."""
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
    """Sheets are face corners (k, d, d) [m] and unit normals (k, d). The caller must keep the search trees alive."""
    made, trees, middles, rows = faces_type(precision)(), [], [], []
    for corners, normals in sheets:
        middle = 0.5 * (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1)))
        pieces = corners - middle
        following = np.roll(pieces, -1, axis=1) - pieces  # in 2-D from either end to the other one
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
    made.margin, made.around = MARGIN[precision.name] * spacing, AROUND * spacing
    return made, trees


def _three(rows: Points) -> Points:
    return np.pad(rows, [(0, 0), (0, 3 - rows.shape[1]), (0, 0)])


@cache
def find_crossing(precision: Precision = FLOAT64) -> Any:
    goes_through, vector = face_functions(precision)[2], precision.vector
    typed = TypesByName(wp.bool, {faces_type(precision): "faces", vector: "starts ends"})

    @typed.kernel(kernel_module(f"sheet_crossings_{precision.name}"))
    def find(first: int, faces, starts, ends, found):
        i = first + wp.tid()
        found[i] = goes_through(starts[i] - faces.middles[0], ends[i] - faces.middles[0], 0, faces)

    return find
