"""The wall particles of solids, and places beside them where fluid may rest, in float64."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from cortado.discretise.room import Room
from cortado.discretise.shapes import Numbers, Points, Rows, Which, bisected
from cortado.discretise.solid import Solid
from cortado.discretise.surface_points import (
    FINE,
    SurfacePoints,
    evenly_chosen,
    lattice_about,
    surface_feet,
    surface_points,
)
from cortado.discretise.walls import Places, RestLattice, WallLayers


@dataclass(frozen=True)
class WallPoints(Rows):
    """Wall particles whose weights are not known yet."""

    positions: Points
    """(b, d) [m]"""
    flat: Points
    """(b,) weights in the density that they would have in a flat wall [-]"""
    feet: Points
    """(b, d) from each to the nearest point of its surface [m]"""


@dataclass(frozen=True, eq=False)
class ContainerWalls:
    """The wall particles that a container has without solids. Those so far from all solids that no fluid beside these
    sees them keep their places and their cells."""

    points: WallPoints
    solids: Sequence[Solid]
    """They close the container."""
    room: Room
    """Where fluid may be, outside of solids at rest."""
    spacing: float
    """Of particles [m]."""
    support: float
    """[m]"""

    @property
    def _clear(self) -> float:
        """Distance from solids to the feet of wall particles that keep their places, at least [m]."""
        return 2.0 * self.support + self.spacing

    @cached_property
    def stay(self) -> Which:
        """(b,) which wall particles keep their places."""
        feet = self.points.positions + self.points.feet
        return np.asarray(self.room.from_solids(feet, self._clear) >= self._clear)

    def keeps(self, points: Points) -> Which:
        """(n,) which points (n, d) [m] beneath surfaces are in the cell of a wall particle that keeps its place, or
        above the rim of the container."""
        from scipy.spatial import cKDTree

        kept = np.asarray(self.room.from_solids(points, self.spacing) > 0.0)
        outside = points[kept]
        cells = self.stay.any() and self.stay[cKDTree(self.points.positions).query(outside)[1]]
        kept[kept] = ~self.room.region.is_below_rim(outside) | cells
        return kept

    def is_near(self, points: Points, furthest: float) -> Which:
        """(n,) which points (n, d) [m] are less than a length [m] from the surface where particles do not keep their
        places, whose cells are cut there, or from solids; a few more are."""
        near = self._clear + 2.0 * self.spacing + furthest
        return np.asarray(self.room.from_solids(points, near) < near)


DENSITY = 0.75
"""In spacings: how far wall particles are apart."""
MARGIN = 0.01
"""In spacings: a part of a surface that is no further within its room touches a wall or another solid."""
TOLERANCE = 0.05
"""In spacings: by how much less deep points may be beneath one surface than beneath another."""
EDGE = 0.4
"""In spacings: edges are less far from fine points of the surface."""
HALVINGS, ROUNDS, DIGITS = 12, 30, 4


@dataclass(frozen=True)
class ExposedSurface:
    """The surface that fluid in a room can touch of solids, which may touch each other, and of the container near them,
    as fine points."""

    feet: Points
    """(n, d) [m]"""
    away: Points
    """(n, d) unit vectors into the room"""
    owner: Numbers
    """(n,) index into `solids` of the one that each belongs to"""
    solids: Sequence[Solid]
    """Those that close the container, then the others."""
    container: ContainerWalls
    lower: Points
    """(d,) where the period begins [m]"""

    @classmethod
    def of(cls, container: ContainerWalls, solids: Sequence[Solid], lower: Points) -> "ExposedSurface":
        """The exposed surface of solids, and of the container near them, up to a support beyond the ends of a period
        that begins at ``lower`` (d,) [m]. Each point stands for a part that is a `FINE`th of a spacing long and
        wide."""
        room, spacing, fine = container.room, container.spacing, container.spacing / FINE
        found = [surface_feet(side, fine, container.is_near) for side in container.solids]
        found += [surface_feet(solid, fine) for solid in solids]
        feet, away = (np.concatenate(parts) for parts in zip(*found, strict=True))
        owner = np.repeat(np.arange(len(found)), [len(part) for part, _ in found])
        free = _within_a_period(feet, lower, room.periods, container.support) & _is_exposed(feet, away, room, spacing)
        return cls(feet[free], away[free], owner[free], [*container.solids, *solids], container, lower)

    @property
    def room(self) -> Room:
        """Where fluid may be."""
        return self.container.room

    @property
    def spacing(self) -> float:
        """Of particles [m]."""
        return self.container.spacing

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.feet)

    def walls(self, layers: WallLayers, lattice: RestLattice) -> WallPoints:
        """Wall particles in layers at the depths of those of flat walls, each with the weight of as much of a flat wall
        as its part of the layer is, and less where it is less deep: it counts the same for the first row of fluid. None
        counts as deeper than its layer, as those may seem whose foot is hidden where parts of a solid overlap."""
        parts, first_row = [], 0.5 * self.spacing
        for depth, weight in zip(layers.depths, layers.weights, strict=True):
            found = self.beneath(depth)
            feet = self._feet_of(found.points, *self._tree.query(found.points)) - found.points
            found_depths = np.minimum(np.linalg.norm(feet, axis=1) / self.spacing, depth / self.spacing + TOLERANCE)
            depths, which = np.unique(np.round(found_depths, DIGITS), return_inverse=True)
            seen = np.array([lattice.plane_weight(first_row + self.spacing * one) for one in depths])[which]
            parts.append(
                WallPoints(found.points, weight * found.shares * lattice.plane_weight(first_row + depth) / seen, feet)
            )
        return WallPoints.joined(parts)

    def owners(self, walls: WallPoints) -> Numbers:
        """(b,) index into `solids` of the one that each wall particle belongs to."""
        return np.asarray(self.owner[self._tree.query(walls.positions + walls.feet)[1]])

    def beneath(self, depth: float) -> SurfacePoints:
        """Points about a spacing apart, ``depth`` [m] beneath the surface, or in the middle of what is thinner, except
        where the container keeps its walls."""
        points = np.concatenate([self._at(depth), self._in_the_middle(depth)])
        points = points[_within_a_period(points, self.lower, self.room.periods, 0.0) & ~self.container.keeps(points)]
        found = evenly_chosen(points, self.spacing / FINE, DENSITY * self.spacing)
        return SurfacePoints(found.points, found.shares * DENSITY ** (points.shape[1] - 1))

    def _at(self, depth: float) -> Points:
        """(n, d) [m] fine points at a depth."""
        fine, found = self.spacing / FINE, []
        if not len(self.feet):
            return self.feet

        def is_near(points: Points, furthest: float) -> Which:
            beyond = furthest - depth - 0.5 * fine
            away = self._tree.query(points, distance_upper_bound=furthest)[0]
            near = np.isfinite(away) & (away > depth - 0.5 * fine - beyond)
            near[near] = self.room.distance(points[near], beyond) > -beyond
            return near

        lower, upper = self.feet.min(axis=0), self.feet.max(axis=0)
        for points in lattice_about(lower, upper, depth + 0.5 * fine, fine, is_near):
            away, nearest = self._tree.query(points, distance_upper_bound=depth + fine)
            beneath = np.isfinite(away) & (away > depth - 0.5 * fine)
            beneath[beneath] = self.room.distance(points[beneath], fine) > 0.0
            points = points[beneath]
            feet = self._feet_of(points, away[beneath], nearest[beneath])
            down = points - feet
            distances = np.linalg.norm(down, axis=1)
            band = np.abs(distances - depth) < 0.5 * fine
            found.append(feet[band] + (depth / distances[band, None]) * down[band])
        return np.concatenate([np.zeros((0, self.feet.shape[1])), *found])

    def _feet_of(self, points: Points, reach: Points, nearest: Numbers) -> Points:
        """(n, d) [m] the points of the surface, on a solid or where two of them meet, that are nearest to points (n, d)
        [m] beneath it; ``nearest`` (n,) are the nearest of the fine points, ``reach`` (n,) [m] away."""
        fine = self.spacing / FINE
        found, owner = self.feet[nearest], self.owner[nearest]
        best, furthest = np.full(len(points), np.inf), float(reach.max(initial=0.0)) + fine
        for solid in self.solids:
            within, near = np.minimum(best, reach + fine), np.arange(len(points))
            if len(self.solids) > 1:
                near = near[np.abs(solid.distance_up_to(points, furthest)) < within]
            feet = solid.nearest(points[near])
            up, distances = feet - points[near], np.linalg.norm(feet - points[near], axis=1)
            free = _is_exposed(feet, up / np.maximum(distances, 1e-300)[:, None], self.room, self.spacing)
            free &= distances < within[near]
            near = near[free]
            found[near], best[near] = feet[free], distances[free]
        between = np.flatnonzero(np.isinf(best))
        found[between] = self._edges(found[between], owner[between])
        return found

    def _edges(self, feet: Points, owner: Numbers) -> Points:
        """(n, d) [m] points near feet (n, d) [m] where the solid of each foot, ``owner`` (n,), meets the next one: the
        feet, moved to one surface and the other in turn."""
        distances = np.abs([solid.distance(feet) for solid in self.solids])
        distances[owner, np.arange(len(feet))] = np.inf
        other, found = np.argmin(distances, axis=0), feet.copy()
        for first, second in {(int(a), int(b)) for a, b in zip(owner, other, strict=True)}:
            pair = (owner == first) & (other == second)
            for _ in range(ROUNDS):
                found[pair] = self.solids[first].nearest(self.solids[second].nearest(found[pair]))
        near = np.linalg.norm(found - feet, axis=1) < self.spacing
        near &= self._tree.query(found)[0] < EDGE * self.spacing  # not where one covers the other
        return np.where(near[:, None], found, feet)

    def _in_the_middle(self, depth: float) -> Points:
        """(n, d) [m] points beneath those feet of which another part of the surface is nearer than a depth [m]: as deep
        as the foot is the nearest point."""
        thin = np.flatnonzero(~self._is_nearest(slice(None), np.full(len(self.feet), depth)))
        ends = np.zeros(len(thin)), np.full(len(thin), depth)
        low, _ = bisected(lambda depths: self._is_nearest(thin, depths), *ends, HALVINGS)
        return np.asarray(self.feet[thin] - low[:, None] * self.away[thin])

    def _is_nearest(self, which: Any, depths: Points) -> np.ndarray:
        """(n,) whether the nearest part of the surface to points at depths (n,) [m] beneath some feet is the foot."""
        distances = self._tree.query(self.feet[which] - depths[:, None] * self.away[which])[0]
        return np.asarray(distances > depths - TOLERANCE * self.spacing)


def _within_a_period(points: Points, lower: Points, periods: Points, reach: float) -> Which:
    """(n,) whether points (n, d) [m] are no more than ``reach`` [m] outside of periods that begin at ``lower``."""
    within = (points >= lower - reach) & (points < lower + periods + reach)
    return np.asarray((within | (periods == 0.0)).all(axis=1))


def _is_exposed(feet: Points, away: Points, room: Room, spacing: float) -> Which:
    """(n,) whether fluid in a room can touch points of surfaces (n, d) [m], from which unit vectors (n, d) point."""
    return room.contains(feet + 2.0 * MARGIN * spacing * away, -MARGIN * spacing)


def solid_places(solid: Solid, spacing: float, reach: float) -> Places:
    """Places half a spacing, one and a half, ... up to ``reach`` [m] from a solid, where a lattice that is turned as
    the surface is may rest."""
    heights = spacing * (np.arange(int(np.ceil(reach / spacing - 0.5))) + 0.5)
    points = np.concatenate([surface_points(solid, spacing, -height).points for height in heights])
    return Places(points, _frames(solid.outward(points)))


def _frames(normals: Points) -> Points:
    """(n, d, d) axes, a unit vector a row, of which the first are unit vectors (n, d)."""
    if normals.shape[1] == 2:
        return np.stack([normals, normals[:, ::-1] * np.array([-1.0, 1.0])], axis=1)
    least = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = least - (least * normals).sum(axis=1, keepdims=True) * normals
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([normals, first, np.cross(normals, first)], axis=1)
