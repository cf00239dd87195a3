"""Solids of simple shapes, and lattice points within solids, in float64."""

from dataclasses import dataclass

import numpy as np

from cortado.discretise.shapes import Block, Points, Which, across, block_between
from cortado.discretise.solid import (
    Faces,
    Moments,
    Solid,
    arc,
    box_faces,
    cut_box_faces,
    enclosed_moments,
    nearest_on_edges,
    outer_edges,
    polygon_faces,
    revolved_faces,
    revolved_moments,
)

FACING = 0.9
"""Smallest cosine between one side of a polygon and the reversed other side at which the two form a sheet."""


@dataclass(frozen=True)
class Box(Solid):
    """A box centred at the origin, with sides along the axes."""

    half: Points
    """(d,) half of its sides [m]."""

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
    """All points within a radius of a segment centred at the origin: a capsule, a sphere or, in 2-D, a disc."""

    half: Points
    """(d,) vector from the middle of the segment to its end [m]."""
    radius: float
    """[m]"""

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
        flat = len(self.half) == 2
        upright = profile if flat else revolved_faces(profile, 2, fine)
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
    """A solid of revolution about an axis of space through the origin."""

    profile: Solid
    """Cross-section through the axis, in 2-D, with straight edges: coordinates across the axis and along it."""
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
        return revolved_moments(outer_edges(self.profile.faces(np.inf)), self.axis)

    def _flat(self, points: Points) -> Points:
        """Return distances from the axis, and heights, (n, 2) [m]."""
        across = np.linalg.norm(np.delete(points, self.axis, axis=1), axis=1)
        return np.column_stack([across, points[:, self.axis]])


@dataclass(frozen=True)
class HalfSpace(Solid):
    """A half space, all points below a plane; pictures show only its part inside a box."""

    normal: Points
    """(d,) unit vector upwards"""
    height: float
    """[m] along the normal"""
    lower: Points
    """(d,) [m]"""
    upper: Points
    """(d,) [m]"""

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
    """A polygon in 2-D, whose sides do not cross."""

    corners: Points
    """(m, 2) [m], clockwise or counterclockwise."""

    def extent(self) -> tuple[Points, Points]:
        return self.corners.min(axis=0), self.corners.max(axis=0)

    def distance(self, points: Points) -> Points:
        away = np.linalg.norm(points - self.nearest(points), axis=1)
        return np.where(self._holds(points), -away, away)

    def nearest(self, points: Points) -> Points:
        return nearest_on_edges(points, np.stack([self.corners, np.roll(self.corners, -1, axis=0)], axis=1))

    def faces(self, fine: float) -> Faces:
        return polygon_faces(self.corners)

    def moments(self) -> Moments:
        edges = np.stack([self.corners, np.roll(self.corners, -1, axis=0)], axis=1)
        clockwise = enclosed_moments(edges, np.ones(len(edges))).volume < 0.0
        return enclosed_moments(edges, np.full(len(edges), -1.0 if clockwise else 1.0))

    def thinnest(self) -> float:
        """Return the smallest thickness [m] between facing sides without a common corner; infinite without facing
        sides."""
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

    def _holds(self, points: Points) -> Which:
        """Test (n,) which points are inside, by the number of sides that a ray along the first axis crosses."""
        inside = np.zeros(len(points), dtype=bool)
        for (x_0, y_0), (x_1, y_1) in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            if y_0 == y_1:
                continue
            spans = (y_0 > points[:, 1]) != (y_1 > points[:, 1])
            inside ^= spans & (points[:, 0] < x_0 + (points[:, 1] - y_0) * (x_1 - x_0) / (y_1 - y_0))
        return inside


def _standing(direction: Points) -> Points:
    """Return the rotation matrix (d, d) that rotates the last axis to a unit vector (d,)."""
    frame = np.stack([*across(direction), direction], axis=1)
    frame[:, 0] *= np.linalg.det(frame)
    return frame


def block_around(solid: Solid, spacing: float) -> Block:
    """Return the lattice ``lower + (i + 1/2) spacing`` [m] in the box around a solid, or up to half a spacing
    beyond."""
    lower, upper = solid.extent()
    return block_between(lower, upper + 0.5 * spacing, spacing)


def points_inside(solid: Solid, spacing: float) -> Points:
    points = block_around(solid, spacing).points()
    return np.asarray(points[solid.distance_up_to(points, spacing) < 0.0])
