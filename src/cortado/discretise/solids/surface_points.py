"""Points on surfaces at a depth beneath that of a solid, or at a height above it, evenly spaced, in float64."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

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
ROUNDS = {2: 40, 3: 8}
"""In which each point moves to the middle of what is nearest to it, by the number of dimensions."""
OFF_FACES = (0.31, 0.17, 0.23)
"""Of a cell: how far fine lattices are off the faces of solids that are aligned with them."""
HALVINGS = 20
MOST = 2_000_000
"""Points that are looked at at a time: bounds the memory."""
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
    return evenly_chosen(*_candidates(solid, spacing / FINE, depth), spacing)


def evenly_chosen(candidates: Points, areas: Points, spacing: float) -> SurfacePoints:
    """Those of points (n, d) [m] with areas (n,) [m^(d - 1)] that stay, about a spacing [m] apart."""
    dimension = candidates.shape[1]
    if not len(candidates):
        return SurfacePoints(candidates, np.zeros(0))
    chosen = candidates[_spread(candidates, APART * spacing)]
    from scipy.spatial import cKDTree

    for _ in range(ROUNDS[dimension]):
        owner = cKDTree(chosen).query(candidates)[1]
        total = np.bincount(owner, areas, len(chosen))
        sums = np.stack([np.bincount(owner, areas * x, len(chosen)) for x in candidates.T], axis=1)
        middles = sums / np.maximum(total, 1e-300)[:, None]
        chosen = middles[total > 0.0]
    chosen = candidates[np.unique(cKDTree(candidates).query(chosen)[1])]
    owner = cKDTree(chosen).query(candidates)[1]
    shares = np.bincount(owner, areas, len(chosen)) / spacing ** (dimension - 1)
    return SurfacePoints(chosen, shares)


def thin_share(solid: Solid, spacing: float, thickness: float) -> tuple[float, Points]:
    """The share of a solid's surface beneath which it is less thick than ``thickness`` [m], and a point (d,) [m] of
    that share."""
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


def surface_feet(solid: Solid, fine: float) -> tuple[Points, Points]:
    """Points of the surface (n, d) [m], some ``fine`` [m] apart, each with as much of its area, and unit vectors (n, d)
    away from the solid."""
    near = _near(solid, fine, fine)
    near = near[np.abs(solid.distance(near)) < 0.5 * fine]  # a band of this thickness has fine^d / fine for each point
    feet, away = solid.nearest(near), solid.outward(near)
    on_it = np.linalg.norm(near - feet, axis=1) < 1e-3 * fine  # too near to tell where out is
    away[on_it] = _normals(solid, feet[on_it], fine)
    return feet, away


def _candidates(solid: Solid, fine: float, depth: float) -> tuple[Points, Points]:
    """(n, d) points of the surface at a depth [m], some ``fine`` [m] apart, and the area (n,) [m^(d - 1)] of each."""
    feet, away = surface_feet(solid, fine)
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
    coarse = COARSE * FINE * fine
    cells = block_about(0.5 * (lower + upper), 0.5 * (upper - lower) + reach + coarse, coarse).points()
    cells = cells[np.abs(solid.distance(cells)) < reach + 0.5 * coarse * np.sqrt(len(lower))]
    found = [points[np.abs(solid.distance(points)) < reach] for points in _within_cells(cells, fine)]
    return np.concatenate([np.zeros((0, len(lower))), *found])


def lattice_about(feet: Points, reach: float, fine: float, tree: Any) -> Iterator[Points]:
    """Points (n, d) of a lattice, ``fine`` [m] apart, of which those no further than ``reach`` [m] from feet (m, d)
    [m], of which there is a tree, are all; in parts."""
    if not len(feet):
        return
    lower, upper, coarse = feet.min(axis=0), feet.max(axis=0), COARSE * FINE * fine
    cells = block_about(0.5 * (lower + upper), 0.5 * (upper - lower) + reach + coarse, coarse).points()
    furthest = reach + 0.5 * coarse * np.sqrt(len(lower))
    near = np.isfinite(tree.query(cells, distance_upper_bound=furthest)[0])
    yield from _within_cells(cells[near], fine)


def _within_cells(cells: Points, fine: float) -> Iterator[Points]:
    """Points (n, d), ``fine`` [m] apart, that fill cells whose middles (m, d) [m] are given; in parts."""
    along = fine * (np.arange(COARSE * FINE) + 0.5) - 0.5 * COARSE * FINE * fine
    inside = np.array(list(product(along, repeat=cells.shape[1]))) + fine * np.array(OFF_FACES[: cells.shape[1]])
    chunk = max(MOST // len(inside), 1)
    for start in range(0, len(cells), chunk):
        yield (cells[start : start + chunk, None] + inside).reshape(-1, cells.shape[1])


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
