"""Surfaces of solids as flat faces: edges in 2-D, triangles in 3-D, in float64."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.discretise.shapes import corners as corners_of


@dataclass(frozen=True)
class Faces:
    """The faces of a closed surface; what is on their left in 2-D, and behind them in 3-D, is within."""

    vertices: Points
    """(m, d) [m]"""
    corners: NDArray[np.int64]
    """(k, d) of each face the numbers of its vertices, in 3-D counterclockwise as seen from outside"""

    def moved(self, turn: Points, position: Points) -> "Faces":
        """Turned by a matrix (d, d) and then moved (d,) [m]."""
        return Faces(self.vertices @ turn.T + position, self.corners)

    def reversed(self) -> "Faces":
        """Of all that is outside."""
        return Faces(self.vertices, self.corners[:, ::-1])

    @classmethod
    def joined(cls, parts: "list[Faces]") -> "Faces":
        """Several surfaces as one."""
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
        corners = [part.corners + start for part, start in zip(parts, starts, strict=False)]
        return cls(np.concatenate([part.vertices for part in parts]), np.concatenate(corners))


def box_faces(half: Points) -> Faces:
    """Of a box about the origin with half its sides (d,) [m]."""
    if len(half) == 2:
        return polygon_faces(half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]))
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    squares = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Faces(half * signs, np.array([t for a, b, c, d in squares for t in ((a, b, c), (a, c, d))]))


def cut_box_faces(lower: Points, upper: Points, normal: Points, height: float) -> Faces:
    """Of the part of a box, between corners (d,) [m], that is below a plane with a unit normal (d,) at a height along
    it [m]."""
    from scipy.spatial import ConvexHull

    ends = corners_of(lower, upper)
    heights = ends @ normal - height
    first, second = np.nonzero((heights[:, None] < 0.0) & (heights[None] > 0.0))
    edges = (ends[first] != ends[second]).sum(axis=1) == 1
    first, second = first[edges], second[edges]
    along = (heights[first] / (heights[first] - heights[second]))[:, None]
    hull = ConvexHull(np.concatenate([ends[heights <= 0.0], ends[first] + along * (ends[second] - ends[first])]))
    if len(lower) == 2:
        return polygon_faces(hull.points[hull.vertices])
    a, b, c = np.moveaxis(hull.points[hull.simplices], 1, 0)
    inwards = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0.0
    return Faces(hull.points, np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices).astype(np.int64))


def polygon_faces(corners: Points) -> Faces:
    """Of a polygon (m, 2) [m], given either way round."""
    following = np.roll(corners, -1, axis=0)
    (x, y), (x_next, y_next) = (corners - corners[0]).T, (following - corners[0]).T
    area = (x * y_next - x_next * y).sum()
    ordered = corners if area > 0.0 else corners[::-1]
    numbers = np.arange(len(corners))
    return Faces(ordered, np.stack([numbers, np.roll(numbers, -1)], axis=1))


def arc(centre: Points, radius: float, start: float, end: float, fine: float) -> Points:
    """(m, 2) [m] points of an arc from one angle to another [rad], some ``fine`` [m] apart."""
    count = max(int(np.ceil(abs(end - start) * radius / fine)), 4)
    angles = np.linspace(start, end, count + 1)
    return centre + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def revolved_faces(profile: Faces, axis: int, fine: float) -> Faces:
    """Of a solid of revolution about an axis of space, from its cut with a plane through the axis, which is the same on
    both sides; faces around it are some ``fine`` [m] wide."""
    count = max(int(np.ceil(2.0 * np.pi * profile.vertices[:, 0].max() / fine)), 12)
    angles = 2.0 * np.pi * np.arange(count) / count
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    first, second = [k for k in range(3) if k != axis]
    mirrored = -1.0 if axis == 1 else 1.0  # x, z and y make a left-handed frame
    vertices: list[Points] = []
    corners: list[NDArray[np.int64]] = []
    for start, end in outer_edges(profile):
        base = len(vertices) * count
        for radius, height in (start, end):
            ring = np.zeros((count, 3))
            ring[:, first], ring[:, second], ring[:, axis] = (
                radius * around[:, 0],
                mirrored * radius * around[:, 1],
                height,
            )
            vertices.append(ring)
        here, there = base + np.arange(count), base + np.roll(np.arange(count), -1)
        if start[0] > 0.0:
            corners.append(np.stack([here, there, here + count], axis=1))
        if end[0] > 0.0:
            corners.append(np.stack([there, there + count, here + count], axis=1))
    return Faces(np.concatenate(vertices), np.concatenate(corners))


def outer_edges(profile: Faces) -> Points:
    """(k, 2, 2) [m] where the edges of a profile start and end, as far as they are on one side of the axis."""
    edges = profile.vertices[profile.corners]
    return np.array([[_cut(start, end), _cut(end, start)] for start, end in edges if max(start[0], end[0]) > 0.0])


def _cut(start: Points, end: Points) -> Points:
    """(2,) the start of an edge, or where the edge crosses the axis if it starts beyond."""
    if start[0] >= 0.0:
        return start
    return np.array([0.0, start[1] + (end[1] - start[1]) * start[0] / (start[0] - end[0])])
