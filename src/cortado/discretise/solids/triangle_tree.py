"""A tree of boxes around triangles, which finds the nearest of them, in float64."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.cpu_launches import launched_in_bands, shared, started
from cortado.discretise.shapes import Points

Numbers = NDArray[np.int64]
LEAF = 8
"""Triangles at most in a leaf."""
BITS = 10
"""Of each coordinate, by which points that are asked about are sorted: what is near in space is near in memory."""
SPREAD = ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249))
"""Shifts and masks that bring so many bits three places apart."""


@dataclass(frozen=True, eq=False)
class TriangleTree:
    """Triangles, halved again and again across the longest side of the box around their middles.

    `cortado.discretise.solids.tree_kernels` says how nodes are numbered.
    """

    corners: Points
    """(k, 3, 3) of the triangles, those of a leaf one after the other [m]"""
    order: Numbers
    """(k,) which of the triangles that were given each of them is"""
    starts: NDArray[np.int32]
    """(leaves + 1,) the first triangle of each leaf, and one behind the last"""
    boxes: Points
    """(2 leaves, 6) lower and upper corner of each node's box [m]; there is no node 0"""

    @classmethod
    def of(cls, corners: Points) -> "TriangleTree":
        """Of one triangle or more, by their corners (k, 3, 3) [m]."""
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
        """Of the same triangles, multiplied by a scale greater than 0 and then moved (3,) [m]."""
        corners, boxes = scale * self.corners + shift, scale * self.boxes + np.tile(shift, 2)
        return TriangleTree(corners, self.order, self.starts, boxes)

    def nearest(self, points: Points, reach: float = np.inf) -> tuple[Points, Points]:
        """(n, 3) the nearest points of the triangles [m], and (n,) how far away they are [m], for points (n, 3) [m];
        the points themselves and ``reach`` [m] where nothing is nearer than that."""
        order = np.arange(len(points)) if np.isfinite(reach) else _along_a_curve(points)  # these take long enough
        nearest, squares = np.empty((len(points), 3)), np.empty(len(points))
        self.ask("find_nearest", points[order], reach=reach, nearest=nearest, squares=squares)
        found, away = np.empty_like(nearest), np.empty_like(squares)
        found[order], away[order] = nearest, np.sqrt(squares)
        return found, away

    def windings(self, points: Points) -> NDArray[np.int32]:
        """(n,) how often the triangles go around points (n, 3) [m]; they must be closed."""
        found = np.empty(len(points), dtype=np.int32)
        self.ask("find_windings", points, windings=found)
        return found

    def crossings(self, names: Numbers, tolerance: float) -> Numbers:
        """(m, 2) the pairs of triangles of which an edge of one goes through the other, and further than a tolerance
        [m] to both sides; ``names`` (k, 3) tell which vertices triangles have in common, at which they do not cross."""
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
        """(m, 2) the pairs of a triangle of this tree and one of another whose boxes are no further apart than a reach
        [m] along any axis."""
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
            ends = self.starts[one : one + 2], other.starts[two : two + 2]
            found.append(
                np.stack(np.meshgrid(*(np.arange(*end) for end in ends), indexing="ij"), axis=-1).reshape(-1, 2)
            )
        pairs = np.concatenate(found)
        first, second = (np.hstack([tree.corners.min(axis=1), tree.corners.max(axis=1)]) for tree in (self, other))
        pairs = pairs[_near(first[pairs[:, 0]], second[pairs[:, 1]], reach)]
        return np.column_stack([self.order[pairs[:, 0]], other.order[pairs[:, 1]]])

    def ask(self, kernel: str, points: Points, **arguments: Any) -> None:
        """Launch one of the kernels for points (n, d) [m], with what it takes beside the tree; it writes to arrays that
        it takes."""
        started()
        from cortado.discretise.solids import tree_kernels

        launched_in_bands(
            getattr(tree_kernels, kernel),
            len(points),
            points=np.ascontiguousarray(points, dtype=np.float64),
            boxes=shared(self.boxes, tree_kernels.box),
            starts=self.starts,
            corners=self.corners,
            leaves=len(self.starts) - 1,
            **arguments,
        )


def _starts(count: int, level: int) -> Numbers:
    """(2^level + 1,) the first triangle of each node of a level, and the number of all."""
    return (np.arange(2**level + 1) * count) >> level


def _near(first: Points, second: Points, reach: float) -> NDArray[np.bool_]:
    """(n,) whether boxes (n, 6) are no further apart than a reach along any axis."""
    apart = np.maximum(first[:, :3] - second[:, 3:], second[:, :3] - first[:, 3:])
    return np.asarray((apart <= reach).all(axis=1))


def _along_a_curve(points: Points) -> Numbers:
    """(n,) the order of points (n, 3) along a curve through space that stays in a part of it before it leaves (Morton
    1966)."""
    if len(points) < 2:
        return np.arange(len(points))
    lower, sides = points.min(axis=0), np.ptp(points, axis=0)
    cells = ((points - lower) * ((2**BITS - 1) / max(sides.max(), 1e-300))).astype(np.int64)
    for shift, mask in SPREAD:
        cells = (cells | cells << shift) & mask
    return np.argsort(cells @ np.array([1, 2, 4]), kind="stable")
