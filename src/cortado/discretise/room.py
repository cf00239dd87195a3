"""The room for fluid: inside the region of a container, outside of solids, and within one period of periodic axes.
Points are (n, d) [m]; distances (n,) [m] are negative inside."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, Self

import numpy as np

from cortado.discretise.shapes import Points, apart, wrapped
from cortado.discretise.solid import Placed, Solid

TOLERANCE = 0.5
"""Largest distance of a particle outside its container [spacings], from which walls push it back; light fluid among
heavier fluid is pressed out so far at times."""


@dataclass(frozen=True)
class Region:
    """A convex region in d dimensions; by default all of space."""

    lower: Points
    """(d,) [m]"""
    upper: Points
    """(d,) [m]"""
    base: Points
    """(d,) point on the axis of the cylinder [m]."""
    across: Points
    """(d,) 1 for the axes of space across the cylinder, 0 for the axis along it. All are 0 without a cylinder, and 1
    for a sphere, whose centre is ``base``."""
    radius: float = np.inf
    """Radius of the cylinder or sphere [m]."""
    rim: float = np.inf
    """Height of the open end of a cylinder along its axis [m]; infinite if it has a lid."""

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
        """Return a cylinder along an axis of space, with the centre of its base (d,) [m]."""
        across = np.where(np.arange(len(base)) == axis, 0.0, 1.0)
        lower, upper = base - radius * across, base + radius * across
        upper[axis] += height
        return cls(lower, upper, base, across, radius)

    def distance(self, points: Points) -> Points:
        """Return distances, which beyond an edge or a corner are too small."""
        from_faces = np.full(len(points), -np.inf)
        for x, lower, upper in zip(points.T, self.lower, self.upper, strict=True):  # NumPy is slow with short rows
            from_faces = np.maximum(from_faces, np.maximum(lower - x, x - upper))
        return np.maximum(from_faces, self._from_axis(points) - self.radius)

    def sides(self) -> Iterator[Callable[[Points], Points]]:
        """Yield, for each side at a finite position, a function from points to distances from the side, positive
        inside."""
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
        """Test (n,) which points (n, d) [m] are at most ``tolerance`` [m] outside."""
        return np.asarray(self.distance(points) <= tolerance)

    def cell_shares(self, points: Points, spacing: float) -> Points:
        """Return the fraction (n,) inside the region of the cell, a spacing [m] wide, around each point (n, d) [m];
        cells at a cylinder's side are taken as aligned with the side."""
        half, found = 0.5 * spacing, np.ones(len(points))
        for x, lower, upper in zip(points.T, self.lower, self.upper, strict=True):
            width = np.minimum(x + half, upper) - np.maximum(x - half, lower)
            found *= np.clip(width / spacing, 0.0, 1.0)
        return np.asarray(found * np.clip((self.radius - self._from_axis(points)) / spacing + 0.5, 0.0, 1.0))

    def _from_axis(self, points: Points) -> Points:
        """Return distances from a cylinder's axis or a sphere's centre; 0 for other regions."""
        squares = np.zeros(len(points))
        for x, base, is_across in zip(points.T, self.base, self.across, strict=True):
            if is_across:
                squares += (x - base) ** 2
        return np.sqrt(squares)

    def escaped(self, before: Points, after: Points, tolerance: float) -> np.ndarray:
        """Test (n,) which particles crossed a wall, but no rim, between ``before`` (n, d) [m] and ``after`` (n, d)
        [m]."""
        through = self.contains(before, tolerance) & ~self.contains(after, tolerance)
        return np.asarray(through & self.is_below_rim(before) & self.is_below_rim(after))

    def is_below_rim(self, points: Points) -> np.ndarray:
        if not np.isfinite(self.rim):
            return np.ones(len(points), dtype=bool)
        return np.asarray(points @ (1.0 - self.across) < self.rim)

    def opened(self, periods: Points) -> "Region":
        """Return the region without sides along periodic axes; ``periods`` (d,) [m] are 0 along other axes."""
        lower, upper = np.where(periods > 0.0, -np.inf, self.lower), np.where(periods > 0.0, np.inf, self.upper)
        return Region(lower, upper, self.base, self.across, self.radius, self.rim)


def _from_plane(points: Points, axis: int, at: float, inwards: float) -> Points:
    return np.asarray(inwards * (points[:, axis] - at))


ALONG = 1e-3
"""Angle [rad] below which images in two directions are not distinguished."""


@dataclass(frozen=True)
class Domain:
    """One period of a scene; positions may leave it, and particles interact with all images."""

    lower: tuple[float, ...]
    """(d,) [m]; 0 without period"""
    lengths: tuple[float, ...]
    """(d,) [m]; 0 without period"""

    @classmethod
    def of(cls, lower: Points, lengths: Points) -> Self:
        axes = lengths > 0.0
        return cls(tuple(np.where(axes, lower, 0.0).tolist()), tuple(np.where(axes, lengths, 0.0).tolist()))

    def vectors(self, vector: Any) -> tuple[Any, Any, Any]:
        """Return the lower ends [m], the lengths [m] and the inverse lengths [1/m], as Warp vectors."""
        rest = (0.0,) * (3 - len(self.lengths))
        frequency = (1.0 / length if length else 0.0 for length in self.lengths)
        return vector(*self.lower, *rest), vector(*self.lengths, *rest), vector(*frequency, *rest)

    def wrapped(self, points: Points) -> Points:
        lower = np.array(self.lower)
        return lower + wrapped(points - lower, np.array(self.lengths)) if any(self.lengths) else points

    def shortest(self, ways: Points) -> Points:
        """Return the vectors (n, d) [m] to the nearest images of points."""
        return apart(ways, np.array(self.lengths)) if any(self.lengths) else ways

    def within(self, points: Points, lower: Points, upper: Points) -> tuple[Points, np.ndarray]:
        """Return the images of points (n, d) [m] in a region between corners (d,) [m], and a mask (n,) of the points
        with an image inside. Infinite ends become the ends of the period, and a region longer than the period the
        period."""
        start, lower, upper = self.ends(lower, upper)
        lengths = np.array(self.lengths)
        images = start + wrapped(points - start, lengths) if lengths.any() else points
        images = np.where(lengths > 0.0, images, points)
        return images, np.all((images >= lower) & (images < upper), axis=1)

    def ends(self, lower: Points, upper: Points) -> tuple[Points, Points, Points]:
        """Return the lower ends from which `within` counts images, and the corners of its region, each (d,) [m]."""
        begin, lengths = np.array(self.lower), np.array(self.lengths)
        start = np.where(np.isfinite(lower), lower, begin)
        end = np.where(np.isfinite(upper), upper, begin + lengths)
        whole = (lengths > 0.0) & (end - start >= lengths)
        start, end = np.where(whole, begin, start), np.where(whole, np.inf, end)
        return start, np.where(lengths > 0.0, start, lower), np.where(lengths > 0.0, end, upper)

    def ways(self, points: Points, place: Points, reach: float, seen: Callable[[Points], Points]) -> list[Points]:
        """Return ``seen`` of the vectors from a place (d,) to all images of points (n, d) within ``reach`` [m]: arrays
        (n, k), each for one image of every point. ``seen`` is a linear function of vectors (n, d), such as their
        component across a direction. Images with equal ``seen`` count once, as the image inside the period."""
        steps, inverse, shifts = self.images(reach, seen)
        way = seen(self.wrapped(points) - place)
        if len(steps):
            way = way - np.rint(way @ inverse) @ steps
        return [way + shift for shift in shifts] if len(steps) else [way]

    def images(self, reach: float, seen: Callable[[Points], Points]) -> tuple[Points, Points, Points]:
        """Return the translations (m, k) [m] between images with different ``seen``, their inverse (k, m), and shifts
        (i, k) [m] from the nearest image to all images within ``reach`` [m]."""
        lengths = np.array(self.lengths)
        steps = _independent(seen(np.eye(len(lengths))), lengths) if lengths.any() else np.zeros((0, 0))
        if not len(steps):
            return np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((1, 1))
        inverse = np.linalg.pinv(steps)
        most = np.floor(reach * np.linalg.norm(inverse, axis=0) + 0.5).astype(int)
        turns = np.array(list(product(*(range(-k, k + 1) for k in most))), dtype=np.float64)
        return steps, np.asarray(inverse, dtype=np.float64), turns @ steps


WITHOUT_PERIODS = Domain((), ())


def _independent(axes: Points, lengths: Points) -> Points:
    """Return a maximal independent set of translations (m, k) between images, projected by ``axes`` (d, k), longest
    first."""
    left, found = np.where(lengths[:, None] > 0.0, axes, 0.0), []
    for _ in lengths:
        sizes = np.linalg.norm(left, axis=1)
        best = int(np.argmax(sizes))
        if sizes[best] < ALONG:
            break
        unit = left[best] / sizes[best]
        found.append(lengths[best] * axes[best])
        left = left - np.outer(left @ unit, unit)
    return np.array(found)


@dataclass(frozen=True)
class Room:
    """A region without the solids in it, which repeat with every period."""

    region: Region
    solids: Sequence[Solid]
    periods: Points
    """(d,) [m]; 0 along other axes"""

    @property
    def dimension(self) -> int:
        return len(self.periods)

    def from_solids(self, points: Points, reach: float = np.inf) -> Points:
        """Return distances from the nearest solid, infinite without solids. Beyond ``reach`` [m] only their signs and
        lower bounds are exact."""
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
        turn = np.eye(self.dimension)
        return [solid, *(Placed(solid, shift, turn) for shift in self.shifts()[1:])]

    def shifts(self) -> list[Points]:
        """Return the shifts (d,) to periodic images [m]; the first is 0."""
        return [np.array(shift) for shift in product(*((0.0, -a, a) if a else (0.0,) for a in self.periods))]
