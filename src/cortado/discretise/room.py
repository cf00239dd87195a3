"""The room for fluid: the inside of a container without solids, within one period of periodic axes. Points are (n, d)
[m]. Distances (n,) [m] are negative inside."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, Self

import numpy as np

from cortado.discretise.shapes import Points, apart, wrapped
from cortado.discretise.solid import Placed, Solid

TOLERANCE = 0.5
"""Greatest distance of a particle outside its container [spacings]. Walls push particles within this distance back."""


@dataclass(frozen=True)
class Region:
    """A box with corners ``lower`` and ``upper`` (d,) [m], or the part of a box inside a cylinder or sphere."""

    lower: Points
    upper: Points
    base: Points
    """Point on the axis of the cylinder, or centre of the sphere (d,) [m]."""
    across: Points
    """Factor of each axis (d,) in the radius: 0 along the axis of a cylinder, and otherwise 1."""
    radius: float = np.inf
    rim: float = np.inf
    """Height of an open cylinder's rim along its axis [m], or infinity for a cylinder with a lid."""

    @classmethod
    def between(cls, lower: Points, upper: Points) -> "Region":
        return cls(lower, upper, np.zeros(len(lower)), np.zeros(len(lower)))

    @classmethod
    def everywhere(cls, dimension: int) -> "Region":
        return cls.between(np.full(dimension, -np.inf), np.full(dimension, np.inf))

    @classmethod
    def ball(cls, centre: Points, radius: float) -> "Region":
        everywhere = cls.everywhere(len(centre))
        return cls(everywhere.lower, everywhere.upper, centre, np.ones(len(centre)), radius)

    @classmethod
    def cylinder(cls, base: Points, radius: float, height: float, axis: int) -> "Region":
        """``base`` (d,) [m] is the centre of the base."""
        across = np.where(np.arange(len(base)) == axis, 0.0, 1.0)
        lower, upper = base - radius * across, base + radius * across
        upper[axis] += height
        return cls(lower, upper, base, across, radius)

    def distance(self, points: Points) -> Points:
        """Beyond an edge or a corner, the distance is underestimated."""
        from_faces = np.full(len(points), -np.inf)
        for x, lower, upper in zip(points.T, self.lower, self.upper, strict=True):  # NumPy is slow with short rows
            from_faces = np.maximum(from_faces, np.maximum(lower - x, x - upper))
        return np.maximum(from_faces, self._from_axis(points) - self.radius)

    def sides(self) -> Iterator[Callable[[Points], Points]]:
        """Yield a function for each finite side that returns the distances of points from the side, positive inside."""
        for axis in np.flatnonzero(self.across == 0.0).tolist():
            for at, inwards in ((self.lower[axis], 1.0), (self.upper[axis], -1.0)):
                if np.isfinite(at):
                    yield partial(_from_plane, axis=axis, at=at, inwards=inwards)
        if np.isfinite(self.radius):
            yield lambda points: np.asarray(self.radius - self._from_axis(points))

    def nearest(self, points: Points) -> Points:
        boxed = np.clip(points, self.lower, self.upper)
        across = (boxed - self.base) * self.across
        from_axis = np.linalg.norm(across, axis=1, keepdims=True)
        inwards = np.maximum(1.0 - self.radius / np.maximum(from_axis, 1e-300), 0.0)
        return np.asarray(boxed - inwards * across)

    def contains(self, points: Points, tolerance: float) -> np.ndarray:
        return np.asarray(self.distance(points) <= tolerance)

    def cell_shares(self, points: Points, spacing: float) -> Points:
        """Return the fraction of each point's cell inside the region (n,). A cell is ``spacing`` [m] wide."""
        half, found = 0.5 * spacing, np.ones(len(points))
        for x, lower, upper in zip(points.T, self.lower, self.upper, strict=True):
            width = np.minimum(x + half, upper) - np.maximum(x - half, lower)
            found *= np.clip(width / spacing, 0.0, 1.0)
        return np.asarray(found * np.clip((self.radius - self._from_axis(points)) / spacing + 0.5, 0.0, 1.0))

    def _from_axis(self, points: Points) -> Points:
        squares = np.zeros(len(points))
        for x, base, is_across in zip(points.T, self.base, self.across, strict=True):
            if is_across:
                squares += (x - base) ** 2
        return np.sqrt(squares)

    def escaped(self, before: Points, after: Points, tolerance: float) -> np.ndarray:
        """Test (n,) which particles crossed a wall. Particles may cross the rim."""
        through = self.contains(before, tolerance) & ~self.contains(after, tolerance)
        return np.asarray(through & self.is_below_rim(before) & self.is_below_rim(after))

    def is_below_rim(self, points: Points) -> np.ndarray:
        if not np.isfinite(self.rim):
            return np.ones(len(points), dtype=bool)
        return np.asarray(points @ (1.0 - self.across) < self.rim)

    def opened(self, periods: Points) -> "Region":
        """``periods`` (d,) [m] is 0 along non-periodic axes."""
        lower, upper = np.where(periods > 0.0, -np.inf, self.lower), np.where(periods > 0.0, np.inf, self.upper)
        return Region(lower, upper, self.base, self.across, self.radius, self.rim)


def _from_plane(points: Points, axis: int, at: float, inwards: float) -> Points:
    return np.asarray(inwards * (points[:, axis] - at))


ALONG = 1e-3
"""Least angle between the directions of two distinct periodic images [rad]."""


@dataclass(frozen=True)
class Domain:
    """The periodic box of a scene. Positions may leave the box, and particles interact with all periodic images."""

    lower: tuple[float, ...]
    """Lower corner of the periodic box (d,) [m], or 0 along axes without a period."""
    lengths: tuple[float, ...]
    """Lengths of the periodic box (d,) [m], or 0 along axes without a period."""

    @classmethod
    def of(cls, lower: Points, lengths: Points) -> Self:
        axes = lengths > 0.0
        return cls(tuple(np.where(axes, lower, 0.0).tolist()), tuple(np.where(axes, lengths, 0.0).tolist()))

    def vectors(self, vector: Any) -> tuple[Any, Any, Any]:
        """Return the lower corner, the lengths and the inverse lengths of the periodic box as Warp vectors."""
        rest = (0.0,) * (3 - len(self.lengths))
        frequency = (1.0 / length if length else 0.0 for length in self.lengths)
        return vector(*self.lower, *rest), vector(*self.lengths, *rest), vector(*frequency, *rest)

    def wrapped(self, points: Points) -> Points:
        lower = np.array(self.lower)
        return lower + wrapped(points - lower, np.array(self.lengths)) if any(self.lengths) else points

    def shortest(self, ways: Points) -> Points:
        """Return the vectors to the nearest periodic images, given the vectors ``ways`` (n, d) [m] to any images."""
        return apart(ways, np.array(self.lengths)) if any(self.lengths) else ways

    def within(self, points: Points, lower: Points, upper: Points) -> tuple[Points, np.ndarray]:
        """Return images, and which points have an image between the corners. Infinite corners mean the periodic box."""
        start, lower, upper = self.ends(lower, upper)
        lengths = np.array(self.lengths)
        images = start + wrapped(points - start, lengths) if lengths.any() else points
        images = np.where(lengths > 0.0, images, points)
        return images, np.all((images >= lower) & (images < upper), axis=1)

    def ends(self, lower: Points, upper: Points) -> tuple[Points, Points, Points]:
        begin, lengths = np.array(self.lower), np.array(self.lengths)
        start = np.where(np.isfinite(lower), lower, begin)
        end = np.where(np.isfinite(upper), upper, begin + lengths)
        whole = (lengths > 0.0) & (end - start >= lengths)
        start, end = np.where(whole, begin, start), np.where(whole, np.inf, end)
        return start, np.where(lengths > 0.0, start, lower), np.where(lengths > 0.0, end, upper)

    def ways(self, points: Points, place: Points, reach: float, seen: Callable[[Points], Points]) -> list[Points]:
        """Return the vectors from ``place`` (d,) to the images of points, as one array (n, k) for each image within
        ``reach`` [m]. The linear function ``seen`` is applied to the vectors. Images with equal results count once."""
        steps, inverse, shifts = self.images(reach, seen)
        way = seen(self.wrapped(points) - place)
        if len(steps):
            way = way - np.rint(way @ inverse) @ steps
        return [way + shift for shift in shifts] if len(steps) else [way]

    def images(self, reach: float, seen: Callable[[Points], Points]) -> tuple[Points, Points, Points]:
        """Return the translations between distinct images (m, k), their inverse matrix (k, m), and the shifts to all
        images within ``reach`` (i, k) [m]. Images are distinct if ``seen`` maps them to different points."""
        lengths, found = np.array(self.lengths), []
        axes = seen(np.eye(len(lengths))) if lengths.any() else np.zeros((0, 0))
        left = np.where(lengths[: len(axes), None] > 0.0, axes, 0.0)
        for _ in axes:  # the longest independent translations first
            sizes = np.linalg.norm(left, axis=1)
            best = int(np.argmax(sizes))
            if sizes[best] < ALONG:
                break
            unit = left[best] / sizes[best]
            found.append(lengths[best] * axes[best])
            left = left - np.outer(left @ unit, unit)
        if not found:
            return np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((1, 1))
        steps = np.array(found)
        inverse = np.linalg.pinv(steps)
        most = np.floor(reach * np.linalg.norm(inverse, axis=0) + 0.5).astype(int)
        turns = np.array(list(product(*(range(-k, k + 1) for k in most))), dtype=np.float64)
        return steps, np.asarray(inverse, dtype=np.float64), turns @ steps


WITHOUT_PERIODS = Domain((), ())


@dataclass(frozen=True)
class Room:
    """A region without the solids inside. The solids repeat periodically."""

    region: Region
    solids: Sequence[Solid]
    periods: Points
    """Lengths of the periodic box (d,) [m], or 0 along axes without a period."""

    @property
    def dimension(self) -> int:
        return len(self.periods)

    def from_solids(self, points: Points, reach: float = np.inf) -> Points:
        """Return infinity without solids. Distances above ``reach`` [m] are only lower bounds."""
        if not self.solids:
            return np.full(len(points), np.inf)
        images = [points + shift for shift in self.shifts()]
        return np.min([solid.distance_up_to(image, reach) for image in images for solid in self.solids], axis=0)

    def distance(self, points: Points, reach: float = np.inf) -> Points:
        return np.maximum(self.region.distance(points), -self.from_solids(points, reach))

    def contains(self, points: Points, tolerance: float) -> np.ndarray:
        return self.region.contains(points, tolerance) & (self.from_solids(points, abs(tolerance)) >= -tolerance)

    def cell_shares(self, points: Points, spacing: float) -> Points:
        within = self.region.cell_shares(points, spacing)
        return within * np.clip(self.from_solids(points, 0.5 * spacing) / spacing + 0.5, 0.0, 1.0)

    def images(self, solid: Solid) -> list[Solid]:
        return [solid, *(Placed(solid, shift, np.eye(self.dimension)) for shift in self.shifts()[1:])]

    def shifts(self) -> list[Points]:
        """Return the shifts to periodic images (d,) [m]. The first shift is 0."""
        return [np.array(shift) for shift in product(*((0.0, -a, a) if a else (0.0,) for a in self.periods))]
