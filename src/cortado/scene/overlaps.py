"""Bodies of fluid that start in each other, as far as their particles tell."""

from itertools import product
from typing import Any

import numpy as np

from cortado.discretise.shapes import Points
from cortado.discretise.smoothing import CUBIC_SPLINE
from cortado.errors import Words
from cortado.scene.fields import FieldPath, field_error
from cortado.scene.fluids import Fluid, FluidBody, PointsFluid
from cortado.scene.sentences import field_name, point_in_words

NEAREST = 0.5
"""In spacings: particles that start nearer to each other overlap."""
DENSEST = 0.9
"""Of the number density within a fluid: a particle that starts where another body has so much is inside of it, however
the two lattices lie. In a corner of the other body, half a spacing away, there is at most 7/8 of it."""
SUPPORT, NEIGHBOURS = 2.0, 40
"""By which the number density is computed: the support [spacings], and more particles than there are within it."""


def check_distinct(path: FieldPath, fluid: Fluid, spacing: float) -> None:
    """The points of a file may overlap each other; those of a lattice cannot."""
    if not isinstance(fluid, PointsFluid) or fluid.count(spacing) < 2:
        return
    points = fluid.points()
    distinct, counts = np.unique(points, axis=0, return_counts=True)
    if len(distinct) < len(points):
        raise field_error(path, *_overlap("itself", distinct[np.argmax(counts)], spacing))
    from scipy.spatial import cKDTree

    distances = cKDTree(points).query(points, k=[2])[0].ravel()
    if distances.min() < _nearest(spacing):
        raise field_error(path, *_overlap("itself", points[np.argmin(distances)], spacing))


def check_overlaps(placed: list[tuple[FieldPath, FluidBody]], lengths: Points, spacing: float) -> None:
    """Between different bodies, and between a body and the periodic images of all; ``lengths`` (d,) of a period [m]."""
    paths, bodies = zip(*placed, strict=True)
    lower, upper = np.swapaxes([body.extent(spacing) for body in bodies], 0, 1)
    shifts = [np.array(s) * lengths for s in product(*[(0, -1, 1) if length else (0,) for length in lengths])]
    for second, shift in product(range(len(bodies)), shifts):
        last = second + 1 if shift.any() else second
        gaps = np.maximum(lower[:last] - upper[second] - shift, lower[second] + shift - upper[:last])
        for first in np.nonzero((gaps < _nearest(spacing)).all(axis=1))[0]:
            place = _meeting(bodies[first], bodies[second], shift, spacing)
            if place is not None:
                raise field_error(paths[second], *_overlap(field_name(paths[first]), place, spacing))


def _meeting(first: FluidBody, second: FluidBody, shift: Points, spacing: float) -> Points | None:
    """(d,) where a particle of one body is too near to those of the other, the second one shifted; None if nowhere."""
    from scipy.spatial import cKDTree

    one = _near(first.particles(spacing), np.array(second.extent(spacing)) + shift, spacing)
    other = _near(second.particles(spacing) + shift, first.extent(spacing), spacing)
    if not len(one) or not len(other):
        return None
    distances = cKDTree(one).query(other)[0]
    if distances.min() < _nearest(spacing):
        return other[np.argmin(distances)]
    for points, body in ((other, one), (one, other)):
        tree = cKDTree(body)
        close = points[tree.query(points)[0] < spacing * (1.0 - 1e-6)]
        density = _density(tree, close, spacing)
        if density.max(initial=0.0) > DENSEST:
            return close[np.argmax(density)]
    return None


def _near(points: Points, extent: Any, spacing: float) -> Points:
    """(n, d) those points that are in a box or within the support of a particle in it."""
    reach = SUPPORT * spacing
    return points[((points > extent[0] - reach) & (points < extent[1] + reach)).all(axis=1)]


def _density(tree: Any, points: Points, spacing: float) -> np.ndarray:
    """(n,) number density of the particles of a tree at points (n, d), over that within a fluid."""
    dimension = points.shape[1]
    distances = tree.query(points, k=NEIGHBOURS, distance_upper_bound=SUPPORT * spacing)[0]
    return spacing**dimension * CUBIC_SPLINE.weight(distances, dimension, SUPPORT * spacing).sum(axis=1)


def _overlap(other: str, place: Points, spacing: float) -> tuple[Words, str]:
    wanted = f"at least half a spacing, {NEAREST * spacing:g} m, from it everywhere"
    return Words(f"overlapping {other} at {point_in_words(place)}"), wanted


def _nearest(spacing: float) -> float:
    return NEAREST * spacing * (1.0 - 1e-6)
