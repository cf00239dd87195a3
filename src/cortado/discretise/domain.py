"""Where fluid repeats, and how a place sees all images of particles: positions go on beyond the ends of a period."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any, Self

import numpy as np

from cortado.discretise.pairs import apart, wrapped
from cortado.discretise.shapes import Points

ALONG = 1e-3
"""Directions whose angle [rad] is smaller than this count as the same: images along them are not told apart."""


@dataclass(frozen=True)
class Domain:
    """One period of a scene."""

    lower: tuple[float, ...]
    """(d,) where it begins [m]; 0 along an axis that is not periodic."""
    lengths: tuple[float, ...]
    """(d,) how long it is [m]; 0 along an axis that is not periodic."""

    @classmethod
    def of(cls, lower: Points, lengths: Points) -> Self:
        """From arrays (d,) [m]."""
        axes = lengths > 0.0
        return cls(tuple(np.where(axes, lower, 0.0).tolist()), tuple(np.where(axes, lengths, 0.0).tolist()))

    def vectors(self, vector: Any) -> tuple[Any, Any, Any]:
        """Its lower ends [m], its lengths [m] and one over these [1/m], as vectors of Warp."""
        rest = (0.0,) * (3 - len(self.lengths))
        frequency = (1.0 / length if length else 0.0 for length in self.lengths)
        return vector(*self.lower, *rest), vector(*self.lengths, *rest), vector(*frequency, *rest)

    def wrapped(self, points: Points) -> Points:
        """The images of points (..., d) [m] that are within the period; along other axes as they are."""
        lower = np.array(self.lower)
        return lower + wrapped(points - lower, np.array(self.lengths)) if any(self.lengths) else points

    def shortest(self, ways: Points) -> Points:
        """Of ways (n, d) [m] those to the nearest images."""
        return apart(ways, np.array(self.lengths)) if any(self.lengths) else ways

    def within(self, points: Points, lower: Points, upper: Points) -> tuple[Points, np.ndarray]:
        """The images of points (n, d) [m] that are in a region between corners (d,) [m], or behind its lower corner
        where none is; and whether they are in it (n,). An end that is infinite is that of the period, if there is one;
        a region that is longer than the period is the period."""
        begin, lengths = np.array(self.lower), np.array(self.lengths)
        start = np.where(np.isfinite(lower), lower, begin)
        end = np.where(np.isfinite(upper), upper, begin + lengths)
        whole = (lengths > 0.0) & (end - start >= lengths)
        start, end = np.where(whole, begin, start), np.where(whole, np.inf, end)
        lower, upper = np.where(lengths > 0.0, start, lower), np.where(lengths > 0.0, end, upper)
        images = start + wrapped(points - start, lengths) if lengths.any() else points
        images = np.where(lengths > 0.0, images, points)
        return images, np.all((images >= lower) & (images < upper), axis=1)

    def ways(self, points: Points, place: Points, reach: float, seen: Callable[[Points], Points]) -> list[Points]:
        """The ways (n, k) from a place (d,) to all images of points (n, d) within a reach [m], as ``seen`` shows them:
        a linear function of ways (n, d), such as what is left of them across a direction. Every array has one image of
        each point.

        Images that ``seen`` does not tell apart count once: as those within the period.
        """
        lengths = np.array(self.lengths)
        if not lengths.any():
            return [seen(points - place)]
        way, steps = seen(self.wrapped(points) - place), _independent(seen(np.eye(len(lengths))), lengths)
        if not len(steps):
            return [way]
        inverse = np.linalg.pinv(steps)
        way = way - np.rint(way @ inverse) @ steps
        most = np.floor(reach * np.linalg.norm(inverse, axis=0) + 0.5).astype(int)
        return [way + np.array(turns) @ steps for turns in product(*(range(-k, k + 1) for k in most))]


WITHOUT_PERIODS = Domain((), ())
"""Nothing repeats."""


def _independent(axes: Points, lengths: Points) -> Points:
    """(m, k) from image to image, along as many periodic axes as are independent when they are seen as ``axes`` (d, k):
    first along those that are seen best."""
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
