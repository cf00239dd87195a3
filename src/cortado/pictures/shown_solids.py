"""The solids of a scene for pictures: shapes with poses and colours, outlines, and triangle meshes."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.discretise.solid import Faces, Hollow, Placed, Solid
from cortado.scene.appearance import Finish
from cortado.scene.scene import Scene

Numbers = NDArray[np.int64]
SHARP = 0.8
"""Cosine of the angle between two normals above which an edge is smooth."""
FAR = 1e9


def merged(vertices: Points, corners: Numbers) -> tuple[Points, Numbers, NDArray[np.bool_]]:
    """Remove triangles without area. Return vertices, triangles, and a mask (t,) of the remaining triangles."""
    whole = np.rint((vertices - vertices.min(axis=0)) / (1e-9 * np.ptp(vertices, axis=0).max()))
    _, first, number = np.unique(whole, axis=0, return_index=True, return_inverse=True)
    found = number.reshape(-1)[corners]
    has_area = (found[:, 0] != found[:, 1]) & (found[:, 1] != found[:, 2]) & (found[:, 2] != found[:, 0])
    return vertices[first], found[has_area], has_area


def sides_of(corners: Numbers) -> Numbers:
    """Return the sides of triangles (t, 3) as pairs of vertices (3 t, 2)."""
    return corners[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2)


def across_of(vertices: Points, corners: Numbers) -> Points:
    """Return outward normals (t, 3). The length of a normal is twice the area of the triangle [m2]."""
    a, b, c = vertices[corners].transpose(1, 0, 2)
    return np.asarray(np.cross(b - a, c - a))


def unit(vectors: NDArray[Any]) -> Points:
    """Scale vectors (..., 3) to length 1. Zero vectors are unchanged."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))


def cosines_of(vertices: Points, corners: Numbers) -> Points:
    """Return cosines (t, 3) of the angles between normals of adjacent triangles. Side k is opposite to corner k. A side
    of one triangle, or of more than two, has the cosine -1."""
    flat = unit(across_of(vertices, corners))
    _, which, counts = np.unique(np.sort(sides_of(corners), axis=1), axis=0, return_inverse=True, return_counts=True)
    which = which.reshape(-1)
    summed = np.stack([np.bincount(which, np.repeat(flat[:, k], 3)) for k in range(3)], axis=1)
    return np.where(counts == 2, 0.5 * (summed**2).sum(axis=1) - 1.0, -1.0)[which].reshape(-1, 3)


@dataclass(frozen=True)
class ShownSolid:
    name: str
    shape: Solid
    """Shape of the solid with its middle at the origin, without rotation. The shape of a tank is its cavity."""
    position: Points
    """Position of the solid's middle (d,) [m]."""
    turn: Points
    """Rotation matrix (d, d)."""
    finish: Finish
    is_tank: bool

    @property
    def colour(self) -> Points:
        return np.array(self.finish.colour)

    @property
    def body(self) -> Solid:
        return Placed(self.shape, self.position, self.turn)

    @property
    def solid(self) -> Solid:
        """Region that fluid cannot enter: the solid, or everything outside the cavity of a tank."""
        return Hollow(self.body) if self.is_tank else self.body

    def within(self, frame: Points, origin: Points) -> "ShownSolid":
        """Return the solid in axes with the rotation matrix ``frame`` (d, d) and the ``origin`` (d,) [m]."""
        return replace(self, position=frame @ (self.position - origin), turn=frame @ self.turn)


def shown_solids(scene: Scene) -> tuple[ShownSolid, ...]:
    """Return all solids with their periodic images. Solids outside the periodic box are moved into the box."""
    found, domain = [], scene.domain
    for table in scene.solid:
        shape, is_tank = table.shown_shape(scene.discretisation.spacing), table.side == "inside"
        position = domain.wrapped(table.centroid())
        found.append(ShownSolid(table.name, shape, position, table.turn(scene.dimension), table.finish, is_tank))
    ends, lengths = scene.container.extent(), scene.periods[1]
    if ends is None or not lengths.any():
        return tuple(found)
    shifts = list(product(*[(0.0, -length, length) if length else (0.0,) for length in lengths]))[1:]
    images = []
    for one, shift in product(found, shifts):
        image = replace(one, position=one.position + np.array(shift))
        lower, upper = image.body.extent()
        if (lower < ends[1]).all() and (ends[0] < upper).all():
            images.append(image)
    return *found, *images


def extents_of_solids(scenes: Iterable[Scene]) -> list[tuple[Points, Points]]:
    return [one.body.extent() for scene in scenes for one in shown_solids(scene)]


def union(boxes: Sequence[tuple[Points, Points]]) -> tuple[Points, Points]:
    """Return the lower and the upper corner (d,) [m] of the smallest box around several boxes."""
    both = np.array(boxes)
    return both[:, 0].min(axis=0), both[:, 1].max(axis=0)


def solid_outline(scene: Scene) -> Points:
    """Return the outlines of all solids in a scene as line segments (k, 2, d) [m], with the solids at rest."""
    lines = [own_lines(one) @ one.turn.T + one.position for one in shown_solids(scene)]
    return np.concatenate([np.zeros((0, 2, scene.dimension)), *lines])


def own_faces(shown: ShownSolid) -> Faces:
    """Return the faces of a solid without rotation whose middle is at the origin."""
    sizes = np.ptp(shown.shape.extent(), axis=0)
    return shown.shape.shown_faces(np.pi / 48 * float(max(sizes.min(), 0.25 * sizes.max())))


def own_lines(shown: ShownSolid) -> Points:
    """Return line segments (k, 2, d) [m]. The middle of the solid is at the origin."""
    faces = own_faces(shown)
    if len(shown.turn) == 2:
        return faces.vertices[faces.corners]
    points, corners, _ = merged(faces.vertices, faces.corners)
    cosines = cosines_of(points, corners)
    edges = np.unique(np.sort(sides_of(corners)[cosines.ravel() < SHARP], axis=1), axis=0)
    is_round = bool(((cosines >= SHARP) & (cosines < 1.0 - 1e-9)).any())  # coplanar
    return np.concatenate([points[edges], *(_cut_by_plane(points, corners, axis) for axis in range(3) if is_round)])


def _cut_by_plane(points: Points, corners: Numbers, axis: int) -> Points:
    """Cut triangles by the plane through the origin perpendicular to an axis, into line segments (k, 2, 3) [m]."""
    above = points[:, axis] >= 0.0
    crossing = corners[(above[corners] != above[corners[:, :1]]).any(axis=1)]
    start, end = points[sides_of(crossing)].transpose(1, 0, 2)
    crosses = (start[:, axis] >= 0.0) != (end[:, axis] >= 0.0)
    start, end = start[crosses], end[crosses]
    share = start[:, axis] / (start[:, axis] - end[:, axis])
    return (start + share[:, None] * (end - start)).reshape(-1, 2, 3)


def refined(vertices: Points, corners: Numbers, longest: float) -> tuple[Points, Numbers, Numbers]:
    """Cut the sides of triangles (t, 3) into parts of at most ``longest`` [m]. Return vertices, new triangles, and the
    index of the original triangle of each new triangle. The number of parts is a power of 2, so adjacent triangles
    still share their vertices. New sides inside a triangle are at most sqrt(2) times as long as ``longest``."""

    def parts_of(sides: Numbers) -> Numbers:
        lengths = np.linalg.norm(vertices[sides[:, 0]] - vertices[sides[:, 1]], axis=1)
        return 2 ** np.ceil(np.log2(np.maximum(lengths / longest, 1.0))).astype(np.int64)

    parts = parts_of(sides_of(corners)).reshape(-1, 3)
    thin = (parts.min(axis=1) == 1) & (np.sort(parts, axis=1)[:, 1] > 1)
    given, halved, parents = vertices, corners[~thin], np.flatnonzero(~thin)
    while len(halved):
        sides, which = np.unique(np.sort(sides_of(halved), axis=1), axis=0, return_inverse=True)
        is_long = parts_of(sides) > 1
        if not is_long.any():
            break
        middles = np.full(len(sides), -1)
        middles[is_long] = len(vertices) + np.arange(is_long.sum())
        vertices = np.concatenate([vertices, vertices[sides[is_long]].mean(axis=1)])
        halved, parents = _cut(halved, middles[which.reshape(-1, 3)], parents)
    found = [(vertices, halved, parents)]
    turned = (np.argmin(parts, axis=1)[:, None] + np.arange(3)) % 3  # so that the short side is across the first corner
    corners, parts = (np.take_along_axis(one, turned, axis=1) for one in (corners, parts))
    for second, first in np.unique(parts[thin, 1:], axis=0):
        which = np.flatnonzero(thin & (parts[:, 1:] == (second, first)).all(axis=1))
        found.append(_in_strips(given[corners[which]], which, first, second))
    starts = np.cumsum([0, *(len(one) for one, _, _ in found)])
    joined = [numbers + start for (_, numbers, _), start in zip(found, starts, strict=False)]
    parents = np.concatenate([one for _, _, one in found])
    vertices, corners, kept = merged(np.concatenate([one for one, _, _ in found]), np.concatenate(joined))
    return vertices, corners, parents[kept]


def _cut(corners: Numbers, middles: Numbers, parents: Numbers) -> tuple[Numbers, Numbers]:
    """Divide triangles. ``middles`` (t, 3) are the new vertices on the sides opposite to the corners, or -1."""
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


@dataclass(frozen=True)
class SolidMesh:
    """A triangle mesh of solids. Points, normals and triangles are as in `liquid_surface.Mesh`."""

    points: Points
    normals: Points
    triangles: Numbers
    from_edges: Points
    """Distance of each corner (column) from each side (row) of a triangle (t, 3, 3) [m], or `FAR` for smooth edges."""

    @classmethod
    def of(cls, faces: Faces, longest: float) -> "SolidMesh":
        flat_points, flat_corners, _ = merged(faces.vertices, faces.corners)
        points, corners, parents = refined(flat_points, flat_corners, longest)
        normals = _normals(corners, across_of(points, corners))
        key = np.column_stack([corners.ravel(), np.rint(normals.reshape(-1, 3) * 1e4).astype(np.int64)])
        _, chosen, number = np.unique(key, axis=0, return_index=True, return_inverse=True)
        sides = flat_points[sides_of(flat_corners).reshape(-1, 3, 2)]
        flat = unit(across_of(flat_points, flat_corners))
        inwards = unit(np.cross(flat[:, None], sides[:, :, 1] - sides[:, :, 0]))
        beyond = points[corners][:, None] - sides[parents][:, :, :1]
        distances = np.einsum("pkjc,pkc->pkj", beyond, inwards[parents])
        is_sharp = (cosines_of(flat_points, flat_corners) < SHARP)[parents][..., None]
        places, whole = points[corners.ravel()[chosen]], normals.reshape(-1, 3)[chosen]
        return cls(places, whole, number.reshape(-1, 3), np.where(is_sharp, distances, FAR))

    def smoothed(self, values: Points) -> Points:
        """Smooth values (p, c) at the vertices along the surface, but not across sharp edges."""
        from scipy.sparse import csr_matrix

        ends = self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        first, second = np.concatenate([ends, ends[:, ::-1]]).T
        count = len(self.points)
        beside = csr_matrix((np.ones(len(first)), (first, second)), (count, count))
        weights = np.maximum(np.asarray(beside.sum(axis=1)), 1.0)
        for _ in range(8):
            values = 0.5 * values + 0.5 * (beside @ values) / weights
        return values

    def moved(self, turn: Points, position: Points) -> "SolidMesh":
        return SolidMesh(self.points @ turn.T + position, self.normals @ turn.T, self.triangles, self.from_edges)

    @classmethod
    def joined(cls, parts: Sequence["SolidMesh"]) -> "SolidMesh":
        starts = np.cumsum([0, *(len(part.points) for part in parts)])
        triangles = np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=False)])
        points, normals = (np.concatenate([getattr(one, name) for one in parts]) for name in ("points", "normals"))
        return cls(points, normals, triangles, np.concatenate([part.from_edges for part in parts]))


def _normals(corners: Numbers, across: Points) -> Points:
    """Return normals (t, 3, 3) at corners: means over the triangles at a vertex whose normals are similar."""
    order = np.argsort(corners.ravel(), kind="stable")
    counts = np.bincount(corners.ravel())
    ends = np.cumsum(counts)
    own = counts[corners.ravel()]  # how many triangles there are around each corner
    corner = np.repeat(np.arange(corners.size), own)
    within = np.arange(len(corner)) - np.repeat(np.cumsum(own) - own, own)
    other = order[np.repeat((ends - counts)[corners.ravel()], own) + within] // 3
    flat = unit(across)
    smooth = np.einsum("pk,pk->p", flat[corner // 3], flat[other]) > SHARP
    weighted = across[other] * smooth[:, None]
    summed = np.stack([np.bincount(corner, weighted[:, k], corners.size) for k in range(3)], axis=1)
    return unit(summed).reshape(-1, 3, 3)
