"""Solids of simple shapes, and lattice points within solids, in float64. Lengths are in [m]."""

from dataclasses import dataclass

import numpy as np

from cortado.discretise.shapes import Block, Numbers, Points, across, block_between
from cortado.discretise.shapes import corners as corners_of
from cortado.discretise.solid import Faces, Moments, Solid, enclosed_moments, nearest_on_edges

FACING = 0.9
"""Two sides form a sheet if the cosine between their inward normals is below the negative of this value."""
NODES = 0.5 + np.sqrt(0.15) * np.array([-1.0, 0.0, 1.0])
"""Nodes of three-point Gauss quadrature on the interval from 0 to 1."""
WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0


@dataclass(frozen=True)
class Box(Solid):
    """A box centred at the origin, with sides along the axes."""

    half: Points
    """Half of the side lengths (d,) [m]."""

    def extent(self) -> tuple[Points, Points]:
        return -self.half, self.half

    def distance(self, points: Points) -> Points:
        beyond = np.abs(points) - self.half
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return np.asarray(outside + np.minimum(beyond.max(axis=1), 0.0))

    def nearest(self, points: Points) -> Points:
        found = np.clip(points, -self.half, self.half)
        beyond = np.abs(points) - self.half
        inside = np.flatnonzero((beyond < 0.0).all(axis=1))
        axis = np.argmax(beyond[inside], axis=1)
        found[inside, axis] = np.where(points[inside, axis] < 0.0, -self.half[axis], self.half[axis])
        return found

    def faces(self, fine: float) -> Faces:
        return box_faces(self.half)

    def moments(self) -> Moments:
        volume = float(np.prod(2.0 * self.half))
        return Moments(volume, np.zeros_like(self.half), np.diag(volume * self.half**2 / 3.0))


@dataclass(frozen=True)
class Round(Solid):
    """A capsule, sphere or disc: all points within a radius of a line segment centred at the origin."""

    half: Points
    """Vector from the middle to the end of the segment (d,) [m]."""
    radius: float

    def extent(self) -> tuple[Points, Points]:
        reach = np.abs(self.half) + self.radius
        return -reach, reach

    def distance(self, points: Points) -> Points:
        return np.asarray(np.linalg.norm(points - self._within(points), axis=1) - self.radius)

    def nearest(self, points: Points) -> Points:
        within = self._within(points)
        away = points - within
        length = np.linalg.norm(away, axis=1, keepdims=True)
        sideways = np.eye(points.shape[1])[np.argmin(np.abs(self.half))]
        return np.asarray(within + self.radius * np.where(length > 0.0, away / np.maximum(length, 1e-300), sideways))

    def faces(self, fine: float) -> Faces:
        length = float(np.linalg.norm(self.half))
        above = arc(np.array([0.0, length]), self.radius, 0.0, np.pi, fine)
        profile = polygon_faces(np.concatenate([above, -above]))
        along = self.half / length if length > 0.0 else np.eye(len(self.half))[-1]
        upright = profile if len(self.half) == 2 else revolved_faces(profile, 2, fine)
        return upright.moved(_standing(along), np.zeros(len(along)))

    def moments(self) -> Moments:
        dimension, length, r = len(self.half), float(np.linalg.norm(self.half)), self.radius
        disc, ball = (2.0 * r, np.pi * r**2) if dimension == 2 else (np.pi * r**2, 4.0 / 3.0 * np.pi * r**3)
        rod = 2.0 * length * disc
        across = (rod / (dimension + 1) + ball / (dimension + 2)) * r**2
        stretched = rod * length**2 / 3.0 + ball * length**2 + 4.0 * length * disc * r**2 / (dimension + 1)
        upright = stretched + ball * r**2 / (dimension + 2)
        along = self.half / length if length > 0.0 else np.zeros(dimension)
        second = across * np.eye(dimension) + (upright - across) * np.outer(along, along)
        return Moments(rod + ball, np.zeros(dimension), second)

    def _within(self, points: Points) -> Points:
        square = float(self.half @ self.half)
        along = np.clip(points @ self.half / square, -1.0, 1.0) if square > 0.0 else np.zeros(len(points))
        return np.asarray(along[:, None] * self.half)


@dataclass(frozen=True)
class Revolved(Solid):
    profile: Solid
    """Plane cross-section through the axis, with straight edges. The first coordinate is the distance from the axis."""
    axis: int

    def extent(self) -> tuple[Points, Points]:
        lower, upper = self.profile.extent()
        along = np.arange(3) == self.axis
        return np.where(along, lower[1], -upper[0]), np.where(along, upper[1], upper[0])

    def distance(self, points: Points) -> Points:
        return self.profile.distance(self._flat(points))

    def nearest(self, points: Points) -> Points:
        flat = self._flat(points)
        found = self.profile.nearest(flat)
        across = np.delete(points, self.axis, axis=1)
        away = np.where(flat[:, :1] > 0.0, across / np.maximum(flat[:, :1], 1e-300), np.array([1.0, 0.0]))
        return np.insert(found[:, :1] * away, self.axis, found[:, 1], axis=1)

    def faces(self, fine: float) -> Faces:
        return revolved_faces(self.profile.faces(fine), self.axis, fine)

    def moments(self) -> Moments:
        edges = outer_edges(self.profile.faces(np.inf))
        height, (start, end) = edges[..., 1].mean(), np.moveaxis(edges, 1, 0)
        x, y = np.moveaxis(start[:, None] + NODES[:, None] * (end - start)[:, None], 2, 0)

        def integral(p: int, q: int) -> float:
            """Return the integral of x^p (y - height)^q over the profile, by Green's theorem."""
            return float((end - start)[:, 1] @ (x ** (p + 1) * (y - height) ** q @ WEIGHTS) / (p + 1))

        volume, along = 2.0 * np.pi * integral(1, 0), np.eye(3)[self.axis]
        middle = integral(1, 1) / integral(1, 0)
        across, upright = np.pi * integral(3, 0), 2.0 * np.pi * integral(1, 2) - volume * middle**2
        second = across * np.eye(3) + (upright - across) * np.outer(along, along)
        return Moments(volume, (height + middle) * along, second)

    def _flat(self, points: Points) -> Points:
        across = np.linalg.norm(np.delete(points, self.axis, axis=1), axis=1)
        return np.column_stack([across, points[:, self.axis]])


@dataclass(frozen=True)
class HalfSpace(Solid):
    """All points below a plane. Pictures show only the points between ``lower`` and ``upper``."""

    normal: Points
    """Upward unit vector (d,)."""
    height: float
    """Height of the plane along the normal [m]."""
    lower: Points
    upper: Points

    @property
    def is_bounded(self) -> bool:
        return False

    def extent(self) -> tuple[Points, Points]:
        return self.lower, self.upper

    def distance(self, points: Points) -> Points:
        return np.asarray(points @ self.normal - self.height)

    def nearest(self, points: Points) -> Points:
        return np.asarray(points - self.distance(points)[:, None] * self.normal)

    def faces(self, fine: float) -> Faces:
        size = float(np.linalg.norm(self.upper - self.lower))
        middle = 0.5 * (self.lower + self.upper)
        top = middle - (middle @ self.normal - self.height) * self.normal
        return box_faces(np.full(len(middle), size)).moved(_standing(self.normal), top - size * self.normal)

    def shown_faces(self, fine: float) -> Faces:
        return cut_box_faces(self.lower, self.upper, self.normal, self.height)


@dataclass(frozen=True)
class Polygon(Solid):
    """A polygon in 2-D without crossing sides."""

    corners: Points
    """Corners (m, 2) [m], clockwise or counterclockwise."""

    def extent(self) -> tuple[Points, Points]:
        return self.corners.min(axis=0), self.corners.max(axis=0)

    def distance(self, points: Points) -> Points:
        away, inside = np.linalg.norm(points - self.nearest(points), axis=1), np.zeros(len(points), dtype=bool)
        for (x_0, y_0), (x_1, y_1) in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            if y_0 == y_1:
                continue
            spans = (y_0 > points[:, 1]) != (y_1 > points[:, 1])  # a ray along the first axis crosses the side
            inside ^= spans & (points[:, 0] < x_0 + (points[:, 1] - y_0) * (x_1 - x_0) / (y_1 - y_0))
        return np.where(inside, -away, away)

    def nearest(self, points: Points) -> Points:
        return nearest_on_edges(points, np.stack([self.corners, np.roll(self.corners, -1, axis=0)], axis=1))

    def faces(self, fine: float) -> Faces:
        return polygon_faces(self.corners)

    def moments(self) -> Moments:
        edges = np.stack([self.corners, np.roll(self.corners, -1, axis=0)], axis=1)
        clockwise = enclosed_moments(edges, np.ones(len(edges))).volume < 0.0
        return enclosed_moments(edges, np.full(len(edges), -1.0 if clockwise else 1.0))

    def thinnest(self) -> float:
        """Return the least thickness between opposite sides of the polygon [m], or infinity."""
        starts, sides = self.corners, np.roll(self.corners, -1, axis=0) - self.corners
        lengths = np.linalg.norm(sides, axis=1)
        along = sides / lengths[:, None]
        turned = float(np.sum(starts[:, 0] * sides[:, 1] - starts[:, 1] * sides[:, 0]))
        inward = np.copysign(1.0, turned) * np.stack([-along[:, 1], along[:, 0]], axis=1)
        found, count = np.inf, len(starts)
        for k in range(count):
            others = np.flatnonzero(inward @ inward[k] < -FACING)
            others = others[~np.isin((others - k) % count, (1, count - 1))]
            ends = np.stack([starts[others], starts[others] + sides[others]], axis=1) - starts[k]
            (s, t), depths = (ends @ along[k]).T, ends @ inward[k]
            first, last = np.clip([np.minimum(s, t), np.maximum(s, t)], 0.0, lengths[k])
            over = last > first
            slopes = (depths[:, 1] - depths[:, 0])[over] / (t - s)[over]
            across = [depths[over, 0] + slopes * (place[over] - s[over]) for place in (first, last)]
            least = np.minimum(*across)
            found = min(found, float(least[least > 0.0].min(initial=np.inf)))
        return found


def box_faces(half: Points) -> Faces:
    if len(half) == 2:
        return polygon_faces(half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]))
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    squares = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Faces(half * signs, np.array([t for a, b, c, d in squares for t in ((a, b, c), (a, c, d))]))


def cut_box_faces(lower: Points, upper: Points, normal: Points, height: float) -> Faces:
    """The part of a box below the plane remains. ``height`` [m] is along the unit vector ``normal`` (d,)."""
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
    """Return the edges of a polygon with corners (m, 2) [m], given clockwise or counterclockwise."""
    following = np.roll(corners, -1, axis=0)
    (x, y), (x_next, y_next) = (corners - corners[0]).T, (following - corners[0]).T
    ordered = corners if (x * y_next - x_next * y).sum() > 0.0 else corners[::-1]
    numbers = np.arange(len(corners))
    return Faces(ordered, np.stack([numbers, np.roll(numbers, -1)], axis=1))


def arc(centre: Points, radius: float, start: float, end: float, fine: float) -> Points:
    """Return points of a circular arc (m, 2) [m], about ``fine`` [m] apart. ``start`` and ``end`` are angles [rad]."""
    count = max(int(np.ceil(abs(end - start) * radius / fine)), 4)
    angles = np.linspace(start, end, count + 1)
    return centre + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def revolved_faces(profile: Faces, axis: int, fine: float) -> Faces:
    """The given profile is symmetric about the axis. Faces are about ``fine`` [m] wide."""
    count = max(int(np.ceil(2.0 * np.pi * profile.vertices[:, 0].max() / fine)), 12)
    angles = 2.0 * np.pi * np.arange(count) / count
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    first, second = [k for k in range(3) if k != axis]
    mirrored = -1.0 if axis == 1 else 1.0  # x, z and y make a left-handed frame
    vertices, corners = list[Points](), list[Numbers]()
    for start, end in outer_edges(profile):
        base = len(vertices) * count
        for radius, height in (start, end):
            ring = np.full((count, 3), height)
            ring[:, first], ring[:, second] = radius * around[:, 0], mirrored * radius * around[:, 1]
            vertices.append(ring)
        here, there = base + np.arange(count), base + np.roll(np.arange(count), -1)
        if start[0] > 0.0:
            corners.append(np.stack([here, there, here + count], axis=1))
        if end[0] > 0.0:
            corners.append(np.stack([there, there + count, here + count], axis=1))
    return Faces(np.concatenate(vertices), np.concatenate(corners))


def outer_edges(profile: Faces) -> Points:
    """Return the edges of a profile on one side of the axis, as start and end points (k, 2, 2) [m]."""
    edges = profile.vertices[profile.corners]
    return np.array([[_cut(start, end), _cut(end, start)] for start, end in edges if max(start[0], end[0]) > 0.0])


def _cut(start: Points, end: Points) -> Points:
    if start[0] >= 0.0:
        return start
    return np.array([0.0, start[1] + (end[1] - start[1]) * start[0] / (start[0] - end[0])])


def _standing(direction: Points) -> Points:
    frame = np.stack([*across(direction), direction], axis=1)
    frame[:, 0] *= np.linalg.det(frame)
    return frame


def block_around(solid: Solid, spacing: float) -> Block:
    lower, upper = solid.extent()
    return block_between(lower, upper + 0.5 * spacing, spacing)


def points_inside(solid: Solid, spacing: float) -> Points:
    points = block_around(solid, spacing).points()
    return np.asarray(points[solid.distance_up_to(points, spacing) < 0.0])
