"""Volume, centroid and second moments of solids, by integrals over their surfaces (Mirtich 1996), in float64."""

from dataclasses import dataclass
from math import factorial

import numpy as np

from cortado.discretise.shapes import Points, whole_origin

NODES = 0.5 + np.sqrt(0.15) * np.array([-1.0, 0.0, 1.0])
"""Of Gauss's quadrature with three points from 0 to 1, exact for polynomials of degree 5."""
WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0


@dataclass(frozen=True)
class Moments:
    """Of a solid in d dimensions."""

    volume: float
    """[m^d]"""
    centre: Points
    """(d,) its centroid [m]"""
    second: Points
    """(d, d) the integrals of products of coordinates about the centroid [m^(d + 2)]"""


def enclosed_moments(corners: Points, weights: Points) -> Moments:
    """Of what edges (k, 2, 2) or triangles (k, 3, 3) enclose, counterclockwise as seen from outside [m], each with a
    weight (k,): they are the bases of cones about a place near by."""
    d = corners.shape[1]
    origin = whole_origin(corners.reshape(-1, d))
    about = corners - origin
    sums, (first, second) = about.sum(axis=1), np.moveaxis(about, 1, 0)[:2]
    cones = weights * (first[:, 0] * second[:, 1] - second[:, 0] * first[:, 1] if d == 2 else np.linalg.det(about))
    volume = float(cones.sum()) / factorial(d)
    middle = np.asarray((cones[:, None] * sums).sum(axis=0) / ((d + 1.0) * cones.sum()))
    products = np.einsum("k,kci,kcj->ij", cones, about, about) + np.einsum("k,ki,kj->ij", cones, sums, sums)
    return Moments(volume, origin + middle, products / factorial(d + 2) - volume * np.outer(middle, middle))


def revolved_moments(edges: Points, axis: int) -> Moments:
    """Of a solid of revolution about an axis of space, by the edges (k, 2, 2) [m] of its profile on one side of the
    axis, distance from it and height, counterclockwise; those on the axis may be left out."""
    height = edges[..., 1].mean()
    start, end = edges[:, 0], edges[:, 1]
    x, y = np.moveaxis(start[:, None] + NODES[:, None] * (end - start)[:, None], 2, 0)

    def integral(p: int, q: int) -> float:
        """Of x^p (y - height)^q over the profile, by Green's theorem."""
        return float((end - start)[:, 1] @ (x ** (p + 1) * (y - height) ** q @ WEIGHTS) / (p + 1))

    volume, along = 2.0 * np.pi * integral(1, 0), np.eye(3)[axis]
    middle = integral(1, 1) / integral(1, 0)
    across, upright = np.pi * integral(3, 0), 2.0 * np.pi * integral(1, 2) - volume * middle**2
    second = across * np.eye(3) + (upright - across) * np.outer(along, along)
    return Moments(volume, (height + middle) * along, second)
