"""Points on surfaces at a depth beneath that of a solid, or at a height above it, evenly spaced, in float64."""

from dataclasses import dataclass
from itertools import product

import numpy as np

from cortado.discretise.pairs import pairs_within
from cortado.discretise.shapes import Points, block_about
from cortado.discretise.solids.solid import Solid, Which

FINE = 3
"""Points of a surface along a spacing, among which those that stay are chosen."""
COARSE = 4
"""Spacings in the cells in which a surface is looked for."""
APART = 0.8
"""In spacings: no two points of those that are chosen are nearer to each other."""
ROUNDS = 5
"""In which each point moves to the middle of what is nearest to it."""
HALVINGS = 20
SEED = 1


@dataclass(frozen=True)
class SurfacePoints:
    """Points, each with the area around it."""

    points: Points
    """(n, d) [m]"""
    shares: Points
    """(n,) area over that of a lattice point, a spacing to the power of d - 1"""


def surface_points(solid: Solid, spacing: float, depth: float) -> SurfacePoints:
    """Points about a spacing [m] apart, ``depth`` [m] beneath the surface of a solid, above it where negative.

    Where a solid is thinner than twice the depth, they are in its middle. They are chosen among finer ones: no two too
    near each other, and then each in the middle of those that are nearest to it (Lloyd 1982).
    """
    fine = spacing / FINE
    candidates, areas = _candidates(solid, fine, depth)
    dimension = candidates.shape[1]
    if not len(candidates):
        return SurfacePoints(candidates, np.zeros(0))
    chosen = candidates[_spread(candidates, APART * spacing)]
    from scipy.spatial import cKDTree

    for _ in range(ROUNDS):
        owner = cKDTree(chosen).query(candidates)[1]
        total = np.bincount(owner, areas, len(chosen))
        middles = np.stack([np.bincount(owner, areas * x, len(chosen)) / total for x in candidates.T], axis=1)
        chosen = candidates[cKDTree(candidates).query(middles)[1]]
    chosen = np.unique(chosen, axis=0)
    owner = cKDTree(chosen).query(candidates)[1]
    shares = np.bincount(owner, areas, len(chosen)) / spacing ** (dimension - 1)
    return SurfacePoints(chosen, shares)


def thin_share(solid: Solid, spacing: float, thickness: float) -> tuple[float, Points]:
    """The share of a solid's surface beneath which it is less thick than ``thickness`` [m], and a point (d,) [m] of that
    share."""
    points = surface_points(solid, spacing, 0.0)
    inwards = -_normals(solid, points.points, spacing)
    thin = solid.distance(points.points + thickness * inwards) > 0.0
    if not thin.any():
        return 0.0, np.zeros(points.points.shape[1])
    return float(points.shares[thin].sum() / points.shares.sum()), points.points[thin][0]


def _normals(solid: Solid, feet: Points, spacing: float) -> Points:
    """(n, d) outward unit vectors at points of the surface (n, d) [m], by differences of the distance."""
    step, steps = 1e-3 * spacing, np.eye(feet.shape[1])
    slopes = [solid.distance(feet + step * one) - solid.distance(feet - step * one) for one in steps]
    found = np.stack(slopes, axis=1)
    return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-300))


def _candidates(solid: Solid, fine: float, depth: float) -> tuple[Points, Points]:
    """(n, d) points of the surface at a depth [m], some ``fine`` [m] apart, and the area (n,) [m^(d - 1)] of each."""
    near = _near(solid, fine, abs(depth) + fine)
    feet = solid.nearest(near)
    band = np.abs(solid.distance(near)) < 0.5 * fine  # of this thickness, so that each point has fine^d / fine of area
    near, feet = near[band], feet[band]
    away = solid.outward(near)
    points = feet - _reached(solid, feet, away, depth)[:, None] * away
    areas = np.full(len(points), fine ** (points.shape[1] - 1))
    if depth <= 0.0:
        on_it = np.abs(solid.distance(points) + depth) < 0.25 * fine
        points, areas = points[on_it], areas[on_it]
    return points, areas


def _reached(solid: Solid, feet: Points, away: Points, depth: float) -> Points:
    """(n,) how far beneath feet (n, d) [m] points may be up to a depth [m] so that no other part of the surface is
    nearer to them than these."""
    if depth <= 0.0:
        return np.full(len(feet), depth)
    low, high = np.zeros(len(feet)), np.full(len(feet), depth)
    tolerance = 1e-3 * depth
    reached = solid.distance(feet - depth * away) < -depth + tolerance
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        good = solid.distance(feet - middle[:, None] * away) < -middle + tolerance
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    return np.where(reached, depth, low)


def _near(solid: Solid, fine: float, reach: float) -> Points:
    """(n, d) points of a lattice less than ``reach`` [m] from the surface."""
    lower, upper = (np.asarray(end) for end in solid.extent())
    dimension, coarse = len(lower), COARSE * FINE * fine
    cells = block_about(0.5 * (lower + upper), 0.5 * (upper - lower) + reach + coarse, coarse).points()
    cells = cells[np.abs(solid.distance(cells)) < reach + 0.5 * coarse * np.sqrt(dimension)]
    along = fine * (np.arange(COARSE * FINE) + 0.5) - 0.5 * coarse
    inside = np.array(list(product(along, repeat=dimension)))
    found = []
    for start in range(0, len(cells), max(2_000_000 // len(inside), 1)):
        part = cells[start : start + max(2_000_000 // len(inside), 1)]
        points = (part[:, None] + inside).reshape(-1, dimension)
        found.append(points[np.abs(solid.distance(points)) < reach])
    return np.concatenate([np.zeros((0, dimension)), *found])


def _spread(points: Points, apart: float) -> Which:
    """(n,) as many of the points (n, d) [m] as can be so that no two are nearer than ``apart`` [m]: in rounds, those
    that come first among all that are near them."""
    first, second, _ = pairs_within(points, points, apart)
    different = first != second
    first, second = first[different], second[different]
    rank = np.random.default_rng(SEED).permutation(len(points))
    open_, chosen = np.ones(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
    while open_.any():
        active = open_[first] & open_[second]
        first, second = first[active], second[active]
        beaten = np.zeros(len(points), dtype=bool)
        beaten[first[rank[second] < rank[first]]] = True
        new = open_ & ~beaten
        chosen |= new
        open_ &= beaten
        open_[second[new[first]]] = False
    return chosen
