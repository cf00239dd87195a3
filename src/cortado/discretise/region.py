"""Where fluid may be: in a box, whose sides may be infinitely far, and in a cylinder, which may be open on top, or a
sphere."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from cortado.discretise.shapes import Points

TOLERANCE = 0.5
"""In spacings: how far outside of its container a particle may be. Walls bring back what is less far; light fluid among
heavier is pressed there at times."""


@dataclass(frozen=True)
class Region:
    """A convex region in d dimensions; by default all of space."""

    lower: Points
    """(d,) [m]"""
    upper: Points
    """(d,) [m]"""
    base: Points
    """(d,) a point on the axis of the cylinder [m]"""
    across: Points
    """(d,) 1 for the axes of space that lie across the cylinder, 0 for the one along it; all 0 without a cylinder, and
    all 1 for a sphere, whose middle ``base`` then is"""
    radius: float = np.inf
    """Of the cylinder or the sphere [m]."""
    rim: float = np.inf
    """Where the open end of a cylinder is along its axis [m], infinite if it has a lid."""

    @classmethod
    def between(cls, lower: Points, upper: Points) -> "Region":
        """A box without a cylinder."""
        return cls(lower, upper, np.zeros(len(lower)), np.zeros(len(lower)))

    @classmethod
    def everywhere(cls, dimension: int) -> "Region":
        """All of space."""
        return cls.between(np.full(dimension, -np.inf), np.full(dimension, np.inf))

    @classmethod
    def ball(cls, centre: Points, radius: float) -> "Region":
        """A sphere, or a disc in 2-D."""
        everywhere = cls.everywhere(len(centre))
        return cls(everywhere.lower, everywhere.upper, centre, np.ones(len(centre)), radius)

    @classmethod
    def cylinder(cls, base: Points, radius: float, height: float, axis: int) -> "Region":
        """A cylinder that stands on its base along an axis of space."""
        across = np.where(np.arange(len(base)) == axis, 0.0, 1.0)
        lower, upper = base - radius * across, base + radius * across
        upper[axis] += height
        return cls(lower, upper, base, across, radius)

    def distance(self, points: Points) -> Points:
        """(n,) how far points (n, d) [m] are outside of the region, negative inside [m]; beyond an edge or a corner it
        is the distance from the nearer face, which is less."""
        from_faces = np.full(len(points), -np.inf)
        for x, lower, upper in zip(points.T, self.lower, self.upper, strict=True):  # as short rows take NumPy long
            from_faces = np.maximum(from_faces, np.maximum(lower - x, x - upper))
        return np.maximum(from_faces, self._from_axis(points) - self.radius)

    def sides(self) -> Iterator[Callable[[Points], Points]]:
        """Of each side that is somewhere: (n,) how far points (n, d) [m] are from it, positive inside [m]."""
        for axis in np.flatnonzero(self.across == 0.0).tolist():
            for at, inwards in ((self.lower[axis], 1.0), (self.upper[axis], -1.0)):
                if np.isfinite(at):
                    yield partial(_from_plane, axis=axis, at=at, inwards=inwards)
        if np.isfinite(self.radius):
            yield self._from_side

    def _from_side(self, points: Points) -> Points:
        """(n,) how far points (n, d) [m] are inside the cylinder or the sphere [m]."""
        return np.asarray(self.radius - self._from_axis(points))

    def nearest(self, points: Points) -> Points:
        """(n, d) the points of the region that are nearest to points (n, d) [m] beside its faces or its side, and those
        themselves that are within."""
        boxed = np.clip(points, self.lower, self.upper)
        across = (boxed - self.base) * self.across
        from_axis = np.linalg.norm(across, axis=1, keepdims=True)
        inwards = np.maximum(1.0 - self.radius / np.maximum(from_axis, 1e-300), 0.0)
        return np.asarray(boxed - inwards * across)

    def contains(self, points: Points, tolerance: float) -> np.ndarray:
        """(n,) whether points (n, d) [m] are within, or outside by no more than the tolerance [m]."""
        found = self._from_axis(points) <= self.radius + tolerance
        for x, lower, upper in zip(points.T, self.lower, self.upper, strict=True):
            found &= (x >= lower - tolerance) & (x <= upper + tolerance)
        return np.asarray(found)

    def cell_shares(self, points: Points, spacing: float) -> Points:
        """(n,) the part of the cell, a spacing [m] wide, around each of the points (n, d) [m] that is within the
        region; along a cylinder's side the cell counts as turned with it."""
        half, found = 0.5 * spacing, np.ones(len(points))
        for x, lower, upper in zip(points.T, self.lower, self.upper, strict=True):
            width = np.minimum(x + half, upper) - np.maximum(x - half, lower)
            found *= np.clip(width / spacing, 0.0, 1.0)
        return np.asarray(found * np.clip((self.radius - self._from_axis(points)) / spacing + 0.5, 0.0, 1.0))

    def _from_axis(self, points: Points) -> Points:
        """(n,) how far points (n, d) [m] are from the axis of the cylinder or the middle of the sphere; 0 without."""
        squares = np.zeros(len(points))
        for x, base, is_across in zip(points.T, self.base, self.across, strict=True):
            if is_across:
                squares += (x - base) ** 2
        return np.sqrt(squares)

    def escaped(self, before: Points, after: Points, tolerance: float) -> np.ndarray:
        """(n,) whether particles at ``before`` (n, d) [m] went through a wall to be at ``after`` (n, d) [m].

        Over the rim of an open cup they may go, and what was outside already has not gone through.
        """
        through = self.contains(before, tolerance) & ~self.contains(after, tolerance)
        return np.asarray(through & self.is_below_rim(before) & self.is_below_rim(after))

    def is_below_rim(self, points: Points) -> np.ndarray:
        """(n,) whether points (n, d) [m] are lower than the rim of an open cup; all are where there is none."""
        if not np.isfinite(self.rim):
            return np.ones(len(points), dtype=bool)
        return np.asarray(points @ (1.0 - self.across) < self.rim)

    def opened(self, periods: Points) -> "Region":
        """Without sides along the axes that have a period; ``periods`` (d,) [m], 0 for the others."""
        lower, upper = np.where(periods > 0.0, -np.inf, self.lower), np.where(periods > 0.0, np.inf, self.upper)
        return Region(lower, upper, self.base, self.across, self.radius, self.rim)


def _from_plane(points: Points, axis: int, at: float, inwards: float) -> Points:
    """(n,) how far points (n, d) [m] are from a plane across an axis [m]."""
    return np.asarray(inwards * (points[:, axis] - at))
