"""Wall particles of solids, and points beside solids where fluid may rest, in float64. Both are evenly spaced, at a
depth below a solid's surface or at a height above it."""

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
from cortado.discretise.walls import Places, RestLattice, WallLayers

Near = Callable[[Points, float], Which]
"""A test of which points (n, d) [m] are closer than a length [m] to an object."""
FINE = {2: 12, 3: 3}
"""Number of candidate points of a surface per spacing, among which wall particles are chosen, by the number of
dimensions. With 3 in the plane, wall particles of discs push first rows of fluid unevenly by 9 % (12: 3 %)."""
CELLS = (3, 4)
"""Number of parts, along each axis, into which cells near a surface are divided until they are fine; the last number is
even."""
APART, LEAST_APART = 0.78, 0.65
"""In spacings: a point is chosen if no other is closer than the first number; then points are moved, to no closer than
the second."""
FIRST, GROWTH = 0.05, 1.7
"""Fraction of the points that is processed first, and the factor by which each later portion grows."""
ROUNDS = {2: 40, 3: 4}
"""Rounds in which each point moves to the centroid of its nearest candidates, by the number of dimensions."""
OFF_FACES = (0.31, 0.17, 0.23)
"""Shift of fine lattices in cells, so that their points do not lie on the faces of aligned solids."""
HALVINGS = 20
MANY, MOST = 50_000, 2_000_000
"""Numbers of points. Above the first, several cores search for the nearest faces; with fewer points they mostly wait
for each other. At most the second number is searched at a time, to limit the memory."""
SEED = 1


@dataclass(frozen=True)
class SurfacePoints:
    """Points of a surface, each with the area that it represents."""

    points: Points
    """(n, d) [m]"""
    shares: Points
    """(n,) area, relative to that of a lattice point, spacing^(d - 1)"""


def surface_points(solid: Solid, spacing: float, depth: float) -> SurfacePoints:
    """Return points about a spacing [m] apart, ``depth`` [m] below the surface of a solid, or above it if negative.

    Where a solid is thinner than twice the depth, the points are in the middle.
    """
    fine = spacing / FINE[len(solid.extent()[0])]
    feet, away = surface_feet(solid, fine)
    points = feet - _reached(solid, feet, away, depth)[:, None] * away
    if depth <= 0.0:
        points = points[np.abs(solid.distance_up_to(points, fine - depth) + depth) < 0.25 * fine]
    return evenly_chosen(points, fine, spacing)


def evenly_chosen(candidates: Points, fine: float, spacing: float) -> SurfacePoints:
    """Choose points about a spacing [m] apart from candidates (n, d) [m], which are ``fine`` [m] apart on a surface.

    First, as many points as possible are chosen so that no two are too close. Each then moves to the centroid of the
    candidates nearest to it (Lloyd 1982), and on to a candidate. Points too close to another are removed, and gaps
    filled.
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
    """Return points of a surface (n, d) [m], about ``fine`` [m] apart and representing equal areas, with unit vectors
    (n, d) away from the solid. If a lattice is used to find them, only points that pass ``is_near`` are returned."""
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
    """Return depths (n,) below feet (n, d) [m], at most a given depth [m], up to which the foot is the nearest point of
    the surface."""
    if depth <= 0.0:
        return np.full(len(feet), depth)
    found, tolerance = np.full(len(feet), depth), 1e-3 * depth
    thin = np.flatnonzero(solid.distance_up_to(feet - depth * away, depth) >= -depth + tolerance)

    def is_nearest(depths: Points) -> Which:
        return solid.distance_up_to(feet[thin] - depths[:, None] * away[thin], depth) < -depths + tolerance

    found[thin] = bisected(is_nearest, np.zeros(len(thin)), np.full(len(thin), depth), HALVINGS)[0]
    return found


def lattice_about(lower: Points, upper: Points, reach: float, fine: float, is_near: Near) -> Iterator[Points]:
    """Yield points (n, d) of a lattice, ``fine`` [m] apart, in portions. They include all points within ``reach`` [m]
    of an object inside a box between two corners. Cells of the box are divided while their centres pass ``is_near``."""
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
    """Divide cells of a size [m] with centres (m, d) [m] into ``parts`` along each axis; return new centres (n, d)
    [m]."""
    along = size / parts * (np.arange(parts) + 0.5) - 0.5 * size
    inside = np.array(list(product(along, repeat=cells.shape[1])))
    return (cells[:, None] + inside).reshape(-1, cells.shape[1])


def _chosen(points: Points, order: Numbers, apart: float, chosen: Numbers) -> Numbers:
    """Return indices of points (n, d) [m]: those already chosen, and those in an ``order`` that are further than
    ``apart`` [m] from all points chosen before."""
    size = int(FIRST * len(order)) + 1
    while len(order):
        some, order, size = order[:size], order[size:], int(GROWTH * size) + 1
        if len(chosen):
            some = some[np.isinf(_nearest(points[chosen], points[some], apart)[0])]
        if len(some):
            chosen = np.append(chosen, some[_first_of_all_near(points[some], apart)])
    return chosen


def _nearest(some: Points, points: Points, reach: float = np.inf) -> tuple[Points, Numbers]:
    """Return distances (n,) from points (n, d) [m] to the nearest of other points (m, d) [m], infinite beyond a reach
    [m], and the indices (n,) of the nearest."""
    from scipy.spatial import cKDTree

    workers = usable_cores() if len(points) > MANY else 1
    distances, numbers = cKDTree(some).query(points, distance_upper_bound=reach, workers=workers)
    return distances, numbers


def _first_of_all_near(points: Points, apart: float) -> Which:
    """Test (n,) which points (n, d) [m] stay if each, in order, stays unless a point within ``apart`` [m] has
    stayed."""
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


@dataclass(frozen=True)
class WallPoints(Rows):
    """Wall particles whose weights are still to be computed."""

    positions: Points
    """(b, d) [m]"""
    flat: Points
    """(b,) weights that they would have in the density in a flat wall [-]"""
    feet: Points
    """(b, d) vector from each to the nearest point of its surface [m]"""


@dataclass(frozen=True, eq=False)
class ContainerWalls:
    """The wall particles of a container without solids. Those far enough from all solids keep their positions and their
    cells: fluid beside a solid does not interact with them."""

    points: WallPoints
    solids: Sequence[Solid]
    """Solids that form the container's walls."""
    room: Room
    """Room for fluid, outside of solids at rest."""
    spacing: float
    """Particle spacing [m]."""
    support: float
    """Support radius [m]."""

    @property
    def _clear(self) -> float:
        """Return the least distance from solids at which the feet of wall particles keep their positions [m]."""
        return 2.0 * self.support + self.spacing

    @cached_property
    def stay(self) -> Which:
        """Test (b,) which wall particles keep their positions."""
        feet = self.points.positions + self.points.feet
        return np.asarray(self.room.from_solids(feet, self._clear) >= self._clear)

    def keeps(self, points: Points) -> Which:
        """Test (n,) which points (n, d) [m] below surfaces are in the cell of a wall particle that keeps its position,
        or above the rim of the container."""
        from scipy.spatial import cKDTree

        kept = np.asarray(self.room.from_solids(points, self.spacing) > 0.0)
        outside = points[kept]
        cells = self.stay.any() and self.stay[cKDTree(self.points.positions).query(outside)[1]]
        kept[kept] = ~self.room.region.is_below_rim(outside) | cells
        return kept

    def is_near(self, points: Points, furthest: float) -> Which:
        """Test (n,) which points (n, d) [m] are closer than a length [m] to solids, or to the surface where wall
        particles do not keep their positions. Some other points pass, too."""
        near = self._clear + 2.0 * self.spacing + furthest
        return np.asarray(self.room.from_solids(points, near) < near)


DENSITY = 0.75
"""In spacings: distance between wall particles."""
MARGIN = 0.01
"""In spacings: a part of a surface that extends less than this into its room touches a wall or another solid."""
TOLERANCE = 0.05
"""In spacings: tolerance in the comparison of the depths of a point below two surfaces."""
EDGE = 0.4
"""In spacings: largest distance of edges from fine points of the surface."""
EXPOSED_HALVINGS, EXPOSED_ROUNDS, DIGITS = 12, 30, 4


@dataclass(frozen=True)
class ExposedSurface:
    """Fine points of the surface that fluid in a room can touch: that of solids, which may touch each other, and of the
    container near them."""

    feet: Points
    """(n, d) [m]"""
    away: Points
    """(n, d) unit vectors from the surface into the room"""
    owner: Numbers
    """(n,) index into `solids` of each point's solid"""
    solids: Sequence[Solid]
    """Solids that form the container's walls, then the other solids."""
    container: ContainerWalls
    lower: Points
    """(d,) Start of the period [m]"""

    @classmethod
    def of(cls, container: ContainerWalls, solids: Sequence[Solid], lower: Points) -> "ExposedSurface":
        """Find the surface of solids, and of the container near them, that fluid can touch, as points spacing / `FINE`
        apart. Along periodic axes it extends a support beyond the period, which starts at ``lower`` (d,) [m]."""
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
        """Return the spacing of fine points [m]."""
        return self.container.spacing / FINE[self.feet.shape[1]]

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.feet)

    def walls(self, layers: WallLayers, lattice: RestLattice) -> WallPoints:
        """Build wall particles in layers at the depths of a flat wall's layers. Each has the weight of a flat wall's
        area equal to its part of the layer; at smaller depths the weight is reduced, so that the first row of fluid
        sees the same. No depth exceeds the layer's, even if a foot is hidden where parts of a solid overlap."""
        parts, spacing = [], lattice.spacing
        for depth, weight in zip(layers.depths, layers.weights, strict=True):
            found = self.beneath(depth)
            feet = self._feet_of(found.points, *self._tree.query(found.points)) - found.points
            found_depths = np.minimum(np.linalg.norm(feet, axis=1) / spacing, depth / spacing + TOLERANCE)
            depths, which = np.unique(np.round(found_depths, DIGITS), return_inverse=True)
            seen = np.array([lattice.plane_weight(0.5 * spacing + spacing * one) for one in depths])[which]
            flat = weight * found.shares * lattice.plane_weight(0.5 * spacing + depth) / seen
            parts.append(WallPoints(found.points, flat, feet))
        return WallPoints.joined(parts)

    def owners(self, walls: WallPoints) -> Numbers:
        """Return the index (b,) into `solids` of each wall particle's solid."""
        return np.asarray(self.owner[self._tree.query(walls.positions + walls.feet)[1]])

    def beneath(self, depth: float) -> SurfacePoints:
        """Return points about a spacing apart, ``depth`` [m] below the surface, or in the middle of thinner parts.
        Points where the container keeps its wall particles are left out."""
        points = np.concatenate([self._at(depth), self._in_the_middle(depth)])
        points = points[
            _within_a_period(points, self.lower, self.container.room.periods, 0.0) & ~self.container.keeps(points)
        ]
        found = evenly_chosen(points, self._fine, DENSITY * self.container.spacing)
        return SurfacePoints(found.points, found.shares * DENSITY ** (points.shape[1] - 1))

    def _at(self, depth: float) -> Points:
        """Return fine points (n, d) [m] at a depth below the surface."""
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
        """Return the nearest points (n, d) [m] of the surface, on a solid or where two solids meet, to points (n, d)
        [m] below it. ``nearest`` (n,) are the nearest fine points, at distances ``reach`` (n,) [m]."""
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
        """Return points (n, d) [m] near feet (n, d) [m] where the solid of each foot, ``owner`` (n,), meets the next
        solid: the feet, moved onto one surface and the other in turn."""
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

    def _in_the_middle(self, depth: float) -> Points:
        """Return points (n, d) [m] below those feet for which another part of the surface is closer than a depth [m]:
        as deep as possible with the foot still the nearest point."""
        thin = np.flatnonzero(~self._is_nearest(slice(None), np.full(len(self.feet), depth)))
        ends = np.zeros(len(thin)), np.full(len(thin), depth)
        low, _ = bisected(lambda depths: self._is_nearest(thin, depths), *ends, EXPOSED_HALVINGS)
        return np.asarray(self.feet[thin] - low[:, None] * self.away[thin])

    def _is_nearest(self, which: Any, depths: Points) -> np.ndarray:
        """Test (n,) whether each foot is the nearest point of the surface to the point at a depth (n,) [m] below it."""
        distances = self._tree.query(self.feet[which] - depths[:, None] * self.away[which])[0]
        return np.asarray(distances > depths - TOLERANCE * self.container.spacing)


def _within_a_period(points: Points, lower: Points, periods: Points, reach: float) -> Which:
    """Test (n,) which points (n, d) [m] are at most ``reach`` [m] outside of periods that start at ``lower``."""
    within = (points >= lower - reach) & (points < lower + periods + reach)
    return np.asarray((within | (periods == 0.0)).all(axis=1))


def _is_exposed(feet: Points, away: Points, container: ContainerWalls) -> Which:
    """Test (n,) which points of surfaces (n, d) [m], with unit vectors (n, d) away from the solids, fluid can touch."""
    spacing = container.spacing
    return container.room.contains(feet + 2.0 * MARGIN * spacing * away, -MARGIN * spacing)


def solid_places(solid: Solid, spacing: float, reach: float) -> Places:
    """Return points half a spacing, one and a half, ... up to ``reach`` [m] from a solid, where a lattice aligned with
    the surface may rest."""
    heights = spacing * (np.arange(int(np.ceil(reach / spacing - 0.5))) + 0.5)
    points = np.concatenate([surface_points(solid, spacing, -height).points for height in heights])
    return Places(points, frames(solid.outward(points)))


def frames(normals: Points) -> Points:
    """Return axes (n, d, d), one unit vector in each row; the first ones are the given unit vectors (n, d)."""
    if normals.shape[1] == 2:
        return np.stack([normals, normals[:, ::-1] * np.array([-1.0, 1.0])], axis=1)
    least = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = least - (least * normals).sum(axis=1, keepdims=True) * normals
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([normals, first, np.cross(normals, first)], axis=1)
