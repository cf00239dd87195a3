"""Points on surfaces at a depth beneath that of a solid, or at a height above it, evenly spaced, in float64."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from cortado.device.threads import usable_cores
from cortado.discretise.shapes import Numbers, Points, Which, bisected, block_about
from cortado.discretise.solid import Solid

Near = Callable[[Points, float], Which]
"""Whether points (n, d) [m] are less than a length [m] from something."""
FINE = 3
"""Points of a surface along a spacing, among which those that stay are chosen."""
CELLS = (3, 4)
"""Into how many parts, along each axis, cells are cut in which a surface is looked for, until these are fine; the last
of them is even."""
APART, LEAST_APART = 0.78, 0.65
"""In spacings: points are chosen wherever none is nearer than the first; then they are moved, none nearer to another
than the second."""
FIRST, GROWTH = 0.05, 1.7
"""The part of points that is looked at at first, and how many more each time."""
ROUNDS = {2: 40, 3: 4}
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

    Where a solid is thinner than twice the depth, they are in its middle.
    """
    fine = spacing / FINE
    feet, away = surface_feet(solid, fine)
    points = feet - _reached(solid, feet, away, depth)[:, None] * away
    if depth <= 0.0:
        points = points[np.abs(solid.distance_up_to(points, fine - depth) + depth) < 0.25 * fine]
    return evenly_chosen(points, fine, spacing)


def evenly_chosen(candidates: Points, fine: float, spacing: float) -> SurfacePoints:
    """Some of the points (n, d) [m] that are ``fine`` [m] apart on a surface, about a spacing [m] apart.

    First as many as can be so that no two are too near each other; then each is moved to the middle of what is nearest
    to it (Lloyd 1982), and to a candidate; then any that are too near another are left out, and gaps are filled.
    """
    dimension = candidates.shape[1]
    if not len(candidates):
        return SurfacePoints(candidates, np.zeros(0))
    areas = np.full(len(candidates), fine ** (dimension - 1))
    order, nothing = np.random.default_rng(SEED).permutation(len(candidates)), np.zeros(0, dtype=np.int64)
    chosen = candidates[_chosen(candidates, order, APART * spacing, nothing)]
    for _ in range(ROUNDS[dimension]):
        owner = _nearest(chosen, candidates)[1]
        total = np.bincount(owner, areas, len(chosen))
        sums = np.stack([np.bincount(owner, areas * x, len(chosen)) for x in candidates.T], axis=1)
        chosen = sums[total > 0.0] / total[total > 0.0, None]
    moved = np.unique(_nearest(candidates, chosen)[1])
    kept = _chosen(candidates, moved, LEAST_APART * spacing, nothing)
    chosen = candidates[np.sort(_chosen(candidates, order, APART * spacing, kept))]
    owner = _nearest(chosen, candidates)[1]
    shares = np.bincount(owner, areas, len(chosen)) / spacing ** (dimension - 1)
    return SurfacePoints(chosen, shares)


def surface_feet(solid: Solid, fine: float, is_near: Near | None = None) -> tuple[Points, Points]:
    """Points of a surface (n, d) [m], about ``fine`` [m] apart, each with as much of its area, and unit vectors (n, d)
    away from the solid; of a surface that a lattice finds only those that are near something, where ``is_near`` says
    so."""
    found = solid.own_feet(fine)
    if found is not None:
        return found
    lower, upper = (np.asarray(end) for end in solid.extent())

    def is_wanted(points: Points, furthest: float) -> Which:
        found = np.abs(solid.distance_up_to(points, furthest)) < furthest
        if is_near is not None:
            found[found] = is_near(points[found], furthest)
        return np.asarray(found)

    cells = [points[is_wanted(points, fine)] for points in lattice_about(lower, upper, fine, fine, is_wanted)]
    near = np.concatenate([np.zeros((0, len(lower))), *cells])
    near = near[np.abs(solid.distance(near)) < 0.5 * fine]  # a band of this thickness has fine^d / fine for each point
    feet, away = solid.nearest(near), solid.outward(near)
    on_it = np.linalg.norm(near - feet, axis=1) < 1e-3 * fine  # too near to tell where out is: by differences
    slopes = [
        solid.distance(feet[on_it] + 1e-3 * fine * axis) - solid.distance(feet[on_it] - 1e-3 * fine * axis)
        for axis in np.eye(len(lower))
    ]
    normals = np.stack(slopes, axis=1)
    away[on_it] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return feet, away


def _reached(solid: Solid, feet: Points, away: Points, depth: float) -> Points:
    """(n,) depths beneath feet (n, d) [m], up to a depth [m], at which no other part of the surface is nearer than the
    foot."""
    if depth <= 0.0:
        return np.full(len(feet), depth)
    found, tolerance = np.full(len(feet), depth), 1e-3 * depth
    thin = np.flatnonzero(solid.distance_up_to(feet - depth * away, depth) >= -depth + tolerance)

    def is_nearest(depths: Points) -> Which:
        return solid.distance_up_to(feet[thin] - depths[:, None] * away[thin], depth) < -depths + tolerance

    found[thin] = bisected(is_nearest, np.zeros(len(thin)), np.full(len(thin), depth), HALVINGS)[0]
    return found


def lattice_about(lower: Points, upper: Points, reach: float, fine: float, is_near: Near) -> Iterator[Points]:
    """Points (n, d) of a lattice, ``fine`` [m] apart, in parts, with all of those that are no further than ``reach``
    [m] from a thing within the box between two corners. Cells of the box, and parts of these, are kept as far as their
    middles are near the thing, by ``is_near``."""
    dimension, size = len(lower), int(np.prod(CELLS)) * fine
    cells = block_about(0.5 * (lower + upper), 0.5 * (upper - lower) + reach + size, size).points()
    *coarse, last = CELLS
    for parts in coarse:
        cells = _divided(cells[is_near(cells, reach + 0.5 * size * np.sqrt(dimension))], size, parts)
        size /= parts
    cells = cells[is_near(cells, reach + 0.5 * size * np.sqrt(dimension))]
    chunk = max(MOST // last**dimension, 1)
    half = _divided(np.zeros((1, dimension)), 1.0, last) > 0.0
    halves = half @ 2 ** np.arange(dimension)[::-1]  # the half of a cell along each axis in which each part of it is
    for start in range(0, len(cells), chunk):
        some = cells[start : start + chunk]
        near = is_near(_divided(some, size, 2), reach + 0.25 * size * np.sqrt(dimension))
        which = near.reshape(len(some), -1)[:, halves].ravel()
        yield _divided(some, size, last)[which] + fine * np.array(OFF_FACES[:dimension])


def _divided(cells: Points, size: float, parts: int) -> Points:
    """(n, d) middles [m] of the parts, so many along each axis, of cells of a size [m] with middles (m, d) [m]."""
    along = size / parts * (np.arange(parts) + 0.5) - 0.5 * size
    inside = np.array(list(product(along, repeat=cells.shape[1])))
    return (cells[:, None] + inside).reshape(-1, cells.shape[1])


def _chosen(points: Points, order: Numbers, apart: float, chosen: Numbers) -> Numbers:
    """Numbers of points (n, d) [m]: those chosen already, and the numbers in an ``order`` that are further than
    ``apart`` [m] from them and from all chosen before."""
    size = int(FIRST * len(order)) + 1
    while len(order):
        some, order, size = order[:size], order[size:], int(GROWTH * size) + 1
        if len(chosen):
            some = some[np.isinf(_nearest(points[chosen], points[some], apart)[0])]
        if len(some):
            chosen = np.append(chosen, some[_first_of_all_near(points[some], apart)])
    return chosen


def _nearest(some: Points, points: Points, reach: float = np.inf) -> tuple[Points, Numbers]:
    """Distances (n,) from points (n, d) [m] to the nearest of some (m, d) [m], infinite from a reach [m] on, and the
    numbers (n,) of these."""
    from scipy.spatial import cKDTree

    distances, numbers = cKDTree(some).query(points, distance_upper_bound=reach, workers=usable_cores())
    return distances, numbers


def _first_of_all_near(points: Points, apart: float) -> Which:
    """(n,) the points (n, d) [m] that stay if each in turn stays unless one that does is nearer than ``apart`` [m]."""
    from scipy.spatial import cKDTree

    first, second = cKDTree(points).query_pairs(apart, output_type="ndarray").T
    open_, stays = np.ones(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
    while open_.any():
        active = open_[first] & open_[second]
        first, second = first[active], second[active]
        new = open_.copy()
        new[second] = False
        stays |= new
        open_ &= ~new
        open_[second[new[first]]] = False
    return stays
