"""Solids with a surface of triangles, in float64."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Numbers, Points, Which, grid, launch_on_cpu, shared
from cortado.discretise.solid import Faces, Moments, Solid, enclosed_moments

LEAF = 8
BITS = 10
SPREAD = ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249))


@dataclass(frozen=True, eq=False)
class TriangleTree:
    """`cortado.discretise.tree_kernels` describes the numbering of the nodes."""

    corners: Points
    """Corners of the triangles (k, 3, 3) [m], sorted by the leaves of the tree."""
    order: Numbers
    starts: NDArray[np.int32]
    """Index of the first triangle of each leaf (leaves + 1,). The last element is the number of triangles."""
    boxes: Points
    """Lower and upper corner of the bounding box of each node (2 leaves, 6) [m]. Index 0 is unused."""

    @classmethod
    def of(cls, corners: Points) -> "TriangleTree":
        count, middles = len(corners), corners.mean(axis=1)
        levels = max(int(np.ceil(np.log2(count / LEAF))), 0)
        order = np.arange(count)
        for level in range(levels):
            starts = _starts(count, level)
            node, places = np.repeat(np.arange(2**level), np.diff(starts)), middles[order]
            sides = np.maximum.reduceat(places, starts[:-1]) - np.minimum.reduceat(places, starts[:-1])
            order = order[np.lexsort((places[np.arange(count), sides.argmax(axis=1)[node]], node))]
        starts, ordered = _starts(count, levels), corners[order]
        lower = np.minimum.reduceat(ordered.min(axis=1), starts[:-1])
        upper = np.maximum.reduceat(ordered.max(axis=1), starts[:-1])
        boxes = [np.hstack([lower, upper])]
        while len(lower) > 1:
            lower, upper = np.minimum(lower[::2], lower[1::2]), np.maximum(upper[::2], upper[1::2])
            boxes.append(np.hstack([lower, upper]))
        return cls(ordered, order, starts.astype(np.int32), np.concatenate([np.zeros((1, 6)), *boxes[::-1]]))

    def moved(self, scale: float, shift: Points) -> "TriangleTree":
        corners, boxes = scale * self.corners + shift, scale * self.boxes + np.tile(shift, 2)
        return TriangleTree(corners, self.order, self.starts, boxes)

    def nearest(self, points: Points, reach: float = np.inf) -> tuple[Points, Points]:
        """For a point further than ``reach`` [m] from the mesh, return the point and the distance ``reach``."""
        order = np.arange(len(points))
        if np.isinf(reach) and len(points) > 1:  # along a space-filling curve (Morton 1966)
            lower, sides = points.min(axis=0), np.ptp(points, axis=0)
            cells = ((points - lower) * ((2**BITS - 1) / max(sides.max(), 1e-300))).astype(np.int64)
            for shift, mask in SPREAD:
                cells = (cells | cells << shift) & mask
            order = np.argsort(cells @ np.array([1, 2, 4]), kind="stable")
        nearest, squares = np.empty((len(points), 3)), np.empty(len(points))
        self.ask("find_nearest", points[order], reach=reach, nearest=nearest, squares=squares)
        found, away = np.empty_like(nearest), np.empty_like(squares)
        found[order], away[order] = nearest, np.sqrt(squares)
        return found, away

    def windings(self, points: Points) -> NDArray[np.int32]:
        found = np.empty(len(points), dtype=np.int32)
        self.ask("find_windings", points, windings=found)
        return found

    def crossings(self, names: Numbers, tolerance: float) -> Numbers:
        """Return the index pairs (m, 2) of triangles that cross by more than ``tolerance`` [m]. Triangles with an equal
        number in ``names`` (k, 3) share a vertex, and contact at a shared vertex is no crossing."""
        count, ordered = len(self.corners), np.ascontiguousarray(names[self.order], dtype=np.int32)
        counts, places, others = (np.zeros(size, dtype=np.int32) for size in (count, count + 1, 1))
        given = {"names": ordered, "tolerance": tolerance, "counts": counts}
        self.ask("find_crossings", self.corners[:, 0], **given, places=places, others=others)  # how many there are
        if not counts.any():
            return np.zeros((0, 2), dtype=np.int64)
        places = np.append(0, np.cumsum(counts)).astype(np.int32)
        others = np.zeros(places[-1], dtype=np.int32)
        self.ask("find_crossings", self.corners[:, 0], **given, places=places, others=others)  # and which
        pairs = np.column_stack([np.repeat(np.arange(count), counts), others[: places[-1]]])
        return np.sort(self.order[pairs], axis=1)

    def beside(self, other: "TriangleTree", reach: float) -> Numbers:
        """Return the index pairs (m, 2) of triangles in two trees that have boxes at most ``reach`` [m] apart."""
        pairs = np.ones((1, 2), dtype=np.int64)
        leaves = np.array([len(self.starts) - 1, len(other.starts) - 1])
        while (pairs < leaves).any():
            for side in range(2):
                opened = pairs[:, side] < leaves[side]
                below = np.repeat(pairs[opened], 2, axis=0)
                below[:, side] = 2 * below[:, side] + np.arange(len(below)) % 2
                pairs = np.concatenate([pairs[~opened], below])
            pairs = pairs[_near(self.boxes[pairs[:, 0]], other.boxes[pairs[:, 1]], reach)]
        found = [np.zeros((0, 2), dtype=np.int64)]
        for one, two in pairs - leaves:
            found.append(grid([np.arange(*self.starts[one : one + 2]), np.arange(*other.starts[two : two + 2])]))
        pairs = np.concatenate(found)
        first, second = (np.hstack([tree.corners.min(axis=1), tree.corners.max(axis=1)]) for tree in (self, other))
        pairs = pairs[_near(first[pairs[:, 0]], second[pairs[:, 1]], reach)]
        return np.column_stack([self.order[pairs[:, 0]], other.order[pairs[:, 1]]])

    def ask(self, kernel: str, points: Points, **arguments: Any) -> None:
        from cortado.device.modules import start_warp

        start_warp()
        from cortado.discretise import tree_kernels

        arguments |= {"points": np.ascontiguousarray(points, dtype=np.float64), "corners": self.corners}
        arguments |= {"boxes": shared(self.boxes, tree_kernels.box), "starts": self.starts}
        launch_on_cpu(getattr(tree_kernels, kernel), len(points), leaves=len(self.starts) - 1, **arguments)


def _starts(count: int, level: int) -> Numbers:
    return (np.arange(2**level + 1) * count) >> level


def _near(first: Points, second: Points, reach: float) -> Which:
    apart = np.maximum(first[:, :3] - second[:, 3:], second[:, :3] - first[:, 3:])
    return np.asarray((apart <= reach).all(axis=1))


LYING = 10.0
THIN = 1e-15


def outer_surface(
    corners: Points, pairs: Numbers, holds: Callable[[Points], Which], reach: float
) -> tuple[Points, Points]:
    """Return the triangles (n, 3, 3) [m] of a union of closed parts, cut where parts meet, and weights (n,) for surface
    integrals. Triangles inside the union have the weight 0, and coincident triangles share one weight.

    ``pairs`` (m, 2) lists all pairs of triangles that may meet away from their edges. ``holds`` tests which points (n,
    3) are inside a part. The two sides of each triangle are tested at the distance ``reach`` [m].
    """
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    pairs = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
    met, starts = np.unique(pairs[:, 0], return_index=True)
    whole = np.setdiff1d(np.arange(len(corners)), met)
    pieces, counts = [corners[whole]], [np.ones(len(whole))]
    for number, others in zip(met, np.split(pairs[:, 1], starts)[1:], strict=True):
        piece, count = _cut(corners[number], corners[others], reach)
        pieces.append(piece)
        counts.append(count)
    found = np.concatenate(pieces)
    across = np.cross(found[:, 1] - found[:, 0], found[:, 2] - found[:, 0])
    size = np.linalg.norm(across, axis=1)
    beside = reach * across / np.where(size > 0.0, size, 1.0)[:, None]
    middles = found.mean(axis=1)
    ends = holds(middles - beside).astype(np.float64) - holds(middles + beside)
    return found, ends / np.concatenate(counts)


def _cut(corners: Points, others: Points, reach: float) -> tuple[Points, Points]:
    """Cut a triangle (3, 3) along its intersections with other triangles (m, 3, 3). Return the pieces of the triangle
    (n, 3, 3), and the number of triangles (n,) within ``reach`` [m] of each piece's centre."""
    side, normal = corners[1] - corners[0], np.cross(corners[1] - corners[0], corners[2] - corners[0])
    if not normal.any():
        return np.zeros((0, 3, 3)), np.zeros(0)
    first, last = side / np.linalg.norm(side), normal / np.linalg.norm(normal)
    frame = np.stack([first, np.cross(last, first), last])
    own, placed = (corners - corners[0]) @ frame.T, (others - corners[0]) @ frame.T
    lying = placed[(np.abs(placed[..., 2]) <= LYING * reach).all(axis=1)]
    heights, following = placed[..., 2], np.roll(placed, -1, axis=1)
    crossed = (heights > 0.0) != (following[..., 2] > 0.0)
    along = (heights / np.where(crossed, heights - following[..., 2], 1.0))[..., None]
    through = (placed + along * (following - placed))[crossed][:, :2].reshape(-1, 2, 2)
    segments = np.concatenate([_sides(own[None]), through, _sides(lying)])
    lower, upper = own[:, :2].min(axis=0), own[:, :2].max(axis=0)
    meets = (segments.min(axis=1) <= upper).all(axis=1) & (segments.max(axis=1) >= lower).all(axis=1)
    flat = _pieces(segments[meets], lower[0], upper[0])
    middles = flat.mean(axis=1)
    flat = flat[_within_triangle(own, middles)[0]]
    middles, counts = flat.mean(axis=1), np.ones(len(flat))
    for one in lying:
        inside, heights = _within_triangle(one, middles)
        counts += inside & (np.abs(heights) <= reach)
    return corners[0] + flat @ frame[:2], counts


def _sides(triangles: Points) -> Points:
    """Return the edges (3 n, 2, 2) of triangles (n, 3, 3) in the projection along the last axis."""
    return np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2)[..., :2].reshape(-1, 2, 2)


def _within_triangle(triangle: Points, points: Points) -> tuple[Which, Points]:
    """Work in the projection along the last axis. Also return the height of the triangle at each point (n,)."""
    a, b, c = triangle
    across = (b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0]
    if across == 0.0:
        return np.zeros(len(points), dtype=bool), np.zeros(len(points))
    away = points - a[:2]
    to_b = (away[:, 0] * (c - a)[1] - away[:, 1] * (c - a)[0]) / across
    to_c = (away[:, 1] * (b - a)[0] - away[:, 0] * (b - a)[1]) / across
    return (to_b >= 0.0) & (to_c >= 0.0) & (to_b + to_c <= 1.0), a[2] + to_b * (b - a)[2] + to_c * (c - a)[2]


def _pieces(segments: Points, lower: float, upper: float) -> Points:
    order = np.argsort(segments[:, :, 0], axis=1)[..., None]
    (start, below), (end, above) = np.moveaxis(np.take_along_axis(segments, order, axis=1), (1, 2), (0, 1))
    leans = end > start
    start, below, end = start[leans], below[leans], end[leans]
    slope = (above[leans] - below) / (end - start)
    places = [segments[:, :, 0].ravel(), np.array([lower, upper])]
    for i in range(len(start)):
        steeper = slope[i + 1 :] - slope[i]
        apart = (below[i] - slope[i] * start[i]) - (below[i + 1 :] - slope[i + 1 :] * start[i + 1 :])
        crossed = apart / np.where(steeper == 0.0, np.nan, steeper)
        first, last = np.maximum(start[i], start[i + 1 :]), np.minimum(end[i], end[i + 1 :])
        places.append(crossed[(crossed > first) & (crossed < last)])
    columns = np.unique(np.concatenate(places))
    columns = columns[(columns >= lower) & (columns <= upper)]
    found = [np.zeros((0, 3, 2))]
    for left, right in pairwise(columns):
        if right - left <= THIN * (upper - lower):
            continue
        spans = (start <= left) & (end >= right)
        heights = below[spans, None] + slope[spans, None] * (np.array([left, right]) - start[spans, None])
        heights = heights[np.argsort(heights.sum(axis=1), kind="stable")]
        corners = np.stack(np.broadcast_arrays(np.array([left, right]), heights), axis=-1)
        low, high = corners[:-1], corners[1:]
        found.append(np.stack([low[:, 0], low[:, 1], high[:, 1]], axis=1))
        found.append(np.stack([low[:, 0], high[:, 1], high[:, 0]], axis=1))
    return np.concatenate(found)


LOW_DISCREPANCY = 0.7548776662466927 ** np.array([1.0, 2.0])
"""Increments of a low-discrepancy sequence in a square (Roberts 2018, R2)."""
BESIDE = 1e-12
"""Distance from a triangle at which its two sides are tested, relative to the size of the mesh."""
SEEN = 1e-3
"""Height at which a surface point is tested for being inside another part [spacings of surface points]."""


@dataclass(frozen=True, eq=False)
class Mesh(Solid):
    """All points with a winding number of at least 1 are inside. Parts of the mesh may overlap."""

    vertices: Points
    """Vertices (m, 3) [m]."""
    triangles: Numbers
    """Indices of the vertices of each triangle (k, 3), counterclockwise as seen from outside."""
    parts: Sequence[Numbers] = ()
    """Indices of the triangles of each part. The list is empty if the mesh is one part that does not cross itself."""
    known_trees: Sequence[TriangleTree] = ()

    def moved(self, scale: float, shift: Points) -> "Mesh":
        trees = [tree.moved(scale, shift) for tree in self._trees]
        return Mesh(scale * self.vertices + shift, self.triangles, self.parts, trees)

    @cached_property
    def corners(self) -> Points:
        return self.vertices[self.triangles]

    @property
    def _numbers(self) -> Sequence[Numbers]:
        return self.parts or (np.arange(len(self.triangles)),)

    @cached_property
    def _trees(self) -> Sequence[TriangleTree]:
        return self.known_trees or [TriangleTree.of(self.corners[part]) for part in self._numbers]

    def extent(self) -> tuple[Points, Points]:
        return self._ends

    @cached_property
    def _ends(self) -> tuple[Points, Points]:
        return self.corners.min(axis=(0, 1)), self.corners.max(axis=(0, 1))

    def distance(self, points: Points) -> Points:
        """Where parts overlap, the returned depth is too small."""
        return self._looked_up(points, np.inf)[1]

    def distance_up_to(self, points: Points, reach: float) -> Points:
        return self._looked_up(points, reach)[1]

    def holds(self, points: Points) -> Which:
        return np.any([tree.windings(points) > 0 for tree in self._trees], axis=0)

    def nearest(self, points: Points) -> Points:
        return self._trees[0].nearest(points)[0] if len(self._trees) == 1 else self._looked_up(points, np.inf)[0]

    def outward(self, points: Points) -> Points:
        places, distances = self._looked_up(points, np.inf)
        return (points - places) / np.where(distances == 0.0, 1.0, distances)[:, None]

    def faces(self, fine: float) -> Faces:
        return Faces(self.vertices, self.triangles)

    def _looked_up(self, points: Points, reach: float) -> tuple[Points, Points]:
        found, best = np.empty_like(points), np.full(len(points), np.inf)
        for tree in self._trees:
            places, away = tree.nearest(points, reach)
            distances = np.where(tree.windings(points) > 0, -away, away)
            nearer = distances < best
            found[nearer], best[nearer] = places[nearer], distances[nearer]
        return found, best

    def own_feet(self, fine: float) -> tuple[Points, Points]:
        """The points are a low-discrepancy sequence (Roberts 2018, R2)."""
        order = np.concatenate([part[tree.order] for part, tree in zip(self._numbers, self._trees, strict=True)])
        areas = self.areas()[order]
        total = areas.sum()
        count = max(round(total / fine**2), 1)
        numbers = np.arange(count)
        place = np.searchsorted(np.cumsum(areas), (numbers + 0.5) * total / count)
        owner = order[np.minimum(place, len(order) - 1)]
        along = np.mod(0.5 + numbers[:, None] * LOW_DISCREPANCY, 1.0)
        along = np.where(along.sum(axis=1, keepdims=True) > 1.0, 1.0 - along, along)
        a, b, c = np.moveaxis(self.corners[owner], 1, 0)
        points, outward = a + along[:, :1] * (b - a) + along[:, 1:] * (c - a), self.normals()[owner]
        if not self.parts:
            return points, outward
        seen = self._looked_up(points + SEEN * fine * outward, SEEN * fine)[1] > 0.0
        return points[seen], outward[seen]

    def moments(self) -> Moments:
        return self._moments

    @cached_property
    def _moments(self) -> Moments:
        if not self.parts:
            return enclosed_moments(self.corners, np.ones(len(self.corners)))
        reach = BESIDE * float(np.ptp(self.extent(), axis=0).max())
        pieces = list(zip(self.parts, self._trees, strict=True))
        pairs = [part[tree.crossings(self.triangles[part], 0.0)] for part, tree in pieces]
        for (one, tree), (other, beside) in combinations(pieces, 2):
            first, second = tree.beside(beside, reach).T
            pairs.append(np.column_stack([one[first], other[second]]))
        return enclosed_moments(*outer_surface(self.corners, np.concatenate(pairs), self.holds, reach))

    def normals(self) -> Points:
        """The normal of a triangle without area is 0."""
        return self._across / np.maximum(np.linalg.norm(self._across, axis=1, keepdims=True), 1e-300)

    def areas(self) -> Points:
        return 0.5 * np.linalg.norm(self._across, axis=1)

    @cached_property
    def _across(self) -> Points:
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.cross(b - a, c - a)
