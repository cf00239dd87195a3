"""Wall particles of solids, and points beside solids where fluid may rest, in float64. The points are evenly spaced, at
a fixed depth below the surface or at a fixed height above the surface."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from cortado.device.threads import usable_cores
from cortado.discretise.room import Room
from cortado.discretise.shapes import Numbers, Points, Rows, Which, bisected, block_about
from cortado.discretise.solid import Solid
from cortado.discretise.walls import Places, RestLattice

Near = Callable[[Points, float], Which]
"""A function that tests which points (n, d) [m] are closer than a length [m] to an object."""
FINE = {2: 12, 3: 3}
"""Number of candidate points on a surface per spacing, by dimension."""
CELLS = (3, 4)
"""Parts of a cell along each axis, in two successive refinements near a surface. The last number must be even."""
APART, LEAST_APART = 0.78, 0.65
"""Least distance between chosen points, and least distance after the points are moved [spacings]."""
FIRST, GROWTH = 0.05, 1.7
"""Fraction of the candidate points in the first tested portion, and growth factor of later portions."""
ROUNDS = {2: 40, 3: 4}
"""Number of rounds of Lloyd's algorithm, by dimension."""
OFF_FACES = (0.31, 0.17, 0.23)
"""Shift of fine lattices [cells], which keeps lattice points away from faces."""
HALVINGS = 20
MANY, MOST = 50_000, 2_000_000
"""Least number of points for a search on several cores, and greatest number of points in one search."""
SEED = 1


@dataclass(frozen=True)
class SurfacePoints:
    points: Points
    shares: Points
    """Areas of the points (n,), relative to the area of a lattice point."""


def surface_points(solid: Solid, spacing: float, depth: float) -> SurfacePoints:
    """A negative ``depth`` [m] means above the surface. In thin parts of the solid the points lie halfway through."""
    fine = spacing / FINE[len(solid.extent()[0])]
    feet, away = surface_feet(solid, fine)
    points, tolerance = feet - depth * away, 1e-3 * depth
    if depth <= 0.0:
        points = points[np.abs(solid.distance_up_to(points, fine - depth) + depth) < 0.25 * fine]
        return evenly_chosen(points, fine, spacing)
    thin = np.flatnonzero(solid.distance_up_to(points, depth) >= -depth + tolerance)

    def is_nearest(depths: Points) -> Which:
        return solid.distance_up_to(feet[thin] - depths[:, None] * away[thin], depth) < -depths + tolerance

    middles = bisected(is_nearest, np.zeros(len(thin)), np.full(len(thin), depth), HALVINGS)[0]
    points[thin] = feet[thin] - middles[:, None] * away[thin]
    return evenly_chosen(points, fine, spacing)


def evenly_chosen(candidates: Points, fine: float, spacing: float) -> SurfacePoints:
    """First, candidates at a least distance from each other are chosen. Each point then moves to the candidate nearest
    to the centroid of its closest candidates (Lloyd 1982). Finally, points closer than a least distance are removed,
    and candidates fill gaps. ``fine`` [m] is the distance between candidates."""
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
    kept = _chosen(candidates, np.unique(_nearest(candidates, chosen)[1]), LEAST_APART * spacing, nothing)
    chosen = candidates[np.sort(_chosen(candidates, order, APART * spacing, kept))]
    sizes = np.bincount(_nearest(chosen, candidates)[1], areas, len(chosen))
    return SurfacePoints(chosen, sizes / spacing ** (dimension - 1))


def surface_feet(solid: Solid, fine: float, is_near: Near | None = None) -> tuple[Points, Points]:
    """Return surface points (n, d) [m] and outward unit vectors. The result may lack points that fail ``is_near``."""
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


def lattice_about(lower: Points, upper: Points, reach: float, fine: float, is_near: Near) -> Iterator[Points]:
    """Yield portions of a lattice with all points within ``reach`` [m] of the object that ``is_near`` tests. ``fine``
    is the spacing of the lattice [m]."""
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
    along = size / parts * (np.arange(parts) + 0.5) - 0.5 * size
    inside = np.array(list(product(along, repeat=cells.shape[1])))
    return (cells[:, None] + inside).reshape(-1, cells.shape[1])


def _chosen(points: Points, order: Numbers, apart: float, chosen: Numbers) -> Numbers:
    """Add points, in the given ``order``, that are further than ``apart`` [m] from all ``chosen`` points."""
    from scipy.spatial import cKDTree

    size = int(FIRST * len(order)) + 1
    while len(order):
        some, order, size = order[:size], order[size:], int(GROWTH * size) + 1
        if len(chosen):
            some = some[np.isinf(_nearest(points[chosen], points[some], apart)[0])]
        if not len(some):
            continue
        first, second = cKDTree(points[some]).query_pairs(apart, output_type="ndarray").T
        waits, stays = np.ones(len(some), dtype=bool), np.zeros(len(some), dtype=bool)
        while waits.any():  # the first of every few that are near each other stay
            active = waits[first] & waits[second]
            first, second = first[active], second[active]
            new = waits.copy()
            new[second] = False
            stays |= new
            waits &= ~new
            waits[second[new[first]]] = False
        chosen = np.append(chosen, some[stays])
    return chosen


def _nearest(some: Points, points: Points, reach: float = np.inf) -> tuple[Points, Numbers]:
    """Return the distance from ``points`` to the nearest point in ``some``, or infinity, and this point's index."""
    from scipy.spatial import cKDTree

    workers = usable_cores() if len(points) > MANY else 1
    distances, numbers = cKDTree(some).query(points, distance_upper_bound=reach, workers=workers)
    return distances, numbers


@dataclass(frozen=True)
class WallPoints(Rows):
    """Wall particles without their final weights."""

    positions: Points
    flat: Points
    """Weights of the particles in the density next to a flat wall (b,) [-]."""
    feet: Points
    """Vectors from the particles to the nearest points on the surface (b, d) [m]."""


@dataclass(frozen=True, eq=False)
class ContainerWalls:
    """The wall particles of a container before solids are added to the container."""

    points: WallPoints
    solids: Sequence[Solid]
    """Solids that form the container's walls."""
    room: Room
    """Room for fluid, outside of solids at rest."""
    spacing: float
    support: float

    @property
    def _clear(self) -> float:
        """Return the least distance from solids at which wall particles keep their positions [m]."""
        return 2.0 * self.support + self.spacing

    @cached_property
    def stay(self) -> Which:
        feet = self.points.positions + self.points.feet
        return np.asarray(self.room.from_solids(feet, self._clear) >= self._clear)

    def keeps(self, points: Points) -> Which:
        """Test which points are near a wall particle that keeps its position, or are above the container's rim."""
        from scipy.spatial import cKDTree

        kept = np.asarray(self.room.from_solids(points, self.spacing) > 0.0)
        outside = points[kept]
        cells = self.stay.any() and self.stay[cKDTree(self.points.positions).query(outside)[1]]
        kept[kept] = ~self.room.region.is_below_rim(outside) | cells
        return kept

    def is_near(self, points: Points, furthest: float) -> Which:
        """Test which points may be closer than ``furthest`` [m] to a solid or to moved wall particles."""
        near = self._clear + 2.0 * self.spacing + furthest
        return np.asarray(self.room.from_solids(points, near) < near)


DENSITY = 0.75
"""Distance between wall particles [spacings]."""
MARGIN = 0.01
"""Greatest distance between two surfaces that count as touching [spacings]."""
TOLERANCE = 0.05
"""Tolerance in comparisons of depths below two surfaces [spacings]."""
EDGE = 0.4
"""Greatest distance from an edge to the nearest fine point of the surface [spacings]."""
EXPOSED_HALVINGS, EXPOSED_ROUNDS, DIGITS = 12, 30, 4


@dataclass(frozen=True)
class ExposedSurface:
    """Closely spaced points where fluid can touch solids, or can touch the container near solids."""

    feet: Points
    """Points on the surface (n, d) [m]."""
    away: Points
    """Unit vectors from the surface into the room (n, d)."""
    owner: Numbers
    """Index into `solids` for each point (n,)."""
    solids: Sequence[Solid]
    """Solids that form the walls of the container, followed by the solids in the container."""
    container: ContainerWalls
    lower: Points
    """Lower corner of the periodic box (d,) [m]."""

    @classmethod
    def of(cls, container: ContainerWalls, solids: Sequence[Solid], lower: Points) -> "ExposedSurface":
        """Along periodic axes the surface extends one support radius beyond the periodic box."""
        fine = container.spacing / FINE[len(lower)]
        found = [surface_feet(side, fine, container.is_near) for side in container.solids]
        found += [surface_feet(solid, fine) for solid in solids]
        feet, away = (np.concatenate(parts) for parts in zip(*found, strict=True))
        owner = np.repeat(np.arange(len(found)), [len(part) for part, _ in found])
        free = _within_a_period(feet, lower, container.room.periods, container.support)
        free &= _is_exposed(feet, away, container)
        return cls(feet[free], away[free], owner[free], [*container.solids, *solids], container, lower)

    @property
    def _fine(self) -> float:
        return self.container.spacing / FINE[self.feet.shape[1]]

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.feet)

    def walls(self, lattice: RestLattice) -> WallPoints:
        """The weight of a wall particle is proportional to its area, and is reduced near the surface."""
        parts, spacing = [], lattice.spacing
        for depth, weight in zip(lattice.layers.depths, lattice.layers.weights, strict=True):
            found = self.beneath(depth)
            feet = self._feet_of(found.points, *self._tree.query(found.points)) - found.points
            found_depths = np.minimum(np.linalg.norm(feet, axis=1) / spacing, depth / spacing + TOLERANCE)
            depths, which = np.unique(np.round(found_depths, DIGITS), return_inverse=True)
            seen = np.array([lattice.plane_weight(0.5 * spacing + spacing * one) for one in depths])[which]
            flat = weight * found.shares * lattice.plane_weight(0.5 * spacing + depth) / seen
            parts.append(WallPoints(found.points, flat, feet))
        return WallPoints.joined(parts)

    def owners(self, walls: WallPoints) -> Numbers:
        """Return the index into `solids` for each wall particle (b,)."""
        return np.asarray(self.owner[self._tree.query(walls.positions + walls.feet)[1]])

    def beneath(self, depth: float) -> SurfacePoints:
        """Return points about a spacing apart, ``depth`` [m] below the surface or in the middle of thinner parts. No
        points lie near container wall particles that keep their positions."""
        thin = np.flatnonzero(~self._is_nearest(slice(None), np.full(len(self.feet), depth)))
        ends = np.zeros(len(thin)), np.full(len(thin), depth)
        low, _ = bisected(lambda depths: self._is_nearest(thin, depths), *ends, EXPOSED_HALVINGS)
        points = np.concatenate([self._at(depth), self.feet[thin] - low[:, None] * self.away[thin]])
        within = _within_a_period(points, self.lower, self.container.room.periods, 0.0)
        points = points[within & ~self.container.keeps(points)]
        found = evenly_chosen(points, self._fine, DENSITY * self.container.spacing)
        return SurfacePoints(found.points, found.shares * DENSITY ** (points.shape[1] - 1))

    def _at(self, depth: float) -> Points:
        fine, found = self._fine, []
        if not len(self.feet):
            return self.feet

        def is_near(points: Points, furthest: float) -> Which:
            beyond = furthest - depth - 0.5 * fine
            away = self._tree.query(points, distance_upper_bound=furthest)[0]
            near = np.isfinite(away) & (away > depth - 0.5 * fine - beyond)
            near[near] = self.container.room.distance(points[near], beyond) > -beyond
            return near

        lower, upper = self.feet.min(axis=0), self.feet.max(axis=0)
        for points in lattice_about(lower, upper, depth + 0.5 * fine, fine, is_near):
            away, nearest = self._tree.query(points, distance_upper_bound=depth + fine)
            beneath = np.isfinite(away) & (away > depth - 0.5 * fine)
            beneath[beneath] = self.container.room.distance(points[beneath], fine) > 0.0
            points = points[beneath]
            feet = self._feet_of(points, away[beneath], nearest[beneath])
            down = points - feet
            distances = np.linalg.norm(down, axis=1)
            band = np.abs(distances - depth) < 0.5 * fine
            found.append(feet[band] + (depth / distances[band, None]) * down[band])
        return np.concatenate([np.zeros((0, self.feet.shape[1])), *found])

    def _feet_of(self, points: Points, reach: Points, nearest: Numbers) -> Points:
        """``nearest`` (n,) is the index of the nearest fine point, and ``reach`` (n,) [m] its distance."""
        fine = self._fine
        found, owner = self.feet[nearest], self.owner[nearest]
        best, furthest = np.full(len(points), np.inf), float(reach.max(initial=0.0)) + fine
        for solid in self.solids:
            within, near = np.minimum(best, reach + fine), np.arange(len(points))
            if len(self.solids) > 1:
                near = near[np.abs(solid.distance_up_to(points, furthest)) < within]
            feet = solid.nearest(points[near])
            up, distances = feet - points[near], np.linalg.norm(feet - points[near], axis=1)
            free = _is_exposed(feet, up / np.maximum(distances, 1e-300)[:, None], self.container)
            free &= distances < within[near]
            near = near[free]
            found[near], best[near] = feet[free], distances[free]
        between = np.flatnonzero(np.isinf(best))
        found[between] = self._edges(found[between], owner[between])
        return found

    def _edges(self, feet: Points, owner: Numbers) -> Points:
        """Return points on edges of two solids, by alternating projection. ``owner`` (n,) is each point's solid."""
        distances = np.abs([solid.distance(feet) for solid in self.solids])
        distances[owner, np.arange(len(feet))] = np.inf
        other, found = np.argmin(distances, axis=0), feet.copy()
        for first, second in {(int(a), int(b)) for a, b in zip(owner, other, strict=True)}:
            pair = (owner == first) & (other == second)
            for _ in range(EXPOSED_ROUNDS):
                found[pair] = self.solids[first].nearest(self.solids[second].nearest(found[pair]))
        near = np.linalg.norm(found - feet, axis=1) < self.container.spacing
        near &= self._tree.query(found)[0] < EDGE * self.container.spacing  # not where one covers the other
        return np.where(near[:, None], found, feet)

    def _is_nearest(self, which: Any, depths: Points) -> np.ndarray:
        distances = self._tree.query(self.feet[which] - depths[:, None] * self.away[which])[0]
        return np.asarray(distances > depths - TOLERANCE * self.container.spacing)


def _within_a_period(points: Points, lower: Points, periods: Points, reach: float) -> Which:
    """Test (n,) which points are inside the periodic box or at most ``reach`` [m] outside."""
    within = (points >= lower - reach) & (points < lower + periods + reach)
    return np.asarray((within | (periods == 0.0)).all(axis=1))


def _is_exposed(feet: Points, away: Points, container: ContainerWalls) -> Which:
    """Test (n,) where fluid can touch the surface. ``away`` (n, d) has outward unit vectors of the solids."""
    spacing = container.spacing
    return container.room.contains(feet + 2.0 * MARGIN * spacing * away, -MARGIN * spacing)


def solid_places(solid: Solid, spacing: float, reach: float) -> Places:
    """The first points lie half a spacing from the solid's surface, and further points follow at each spacing."""
    heights = spacing * (np.arange(int(np.ceil(reach / spacing - 0.5))) + 0.5)
    points = np.concatenate([surface_points(solid, spacing, -height).points for height in heights])
    return Places(points, frames(solid.outward(points)))


def frames(normals: Points) -> Points:
    """Return orthonormal axes (n, d, d). The first axis is the given unit vector (n, d)."""
    if normals.shape[1] == 2:
        return np.stack([normals, normals[:, ::-1] * np.array([-1.0, 1.0])], axis=1)
    least = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = least - (least * normals).sum(axis=1, keepdims=True) * normals
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([normals, first, np.cross(normals, first)], axis=1)
