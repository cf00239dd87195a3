"""Bodies whose surface cuts through cells of a lattice: how many particles they have, and where these begin.

Their particles are then moved until the fluid is at rest everywhere: `cortado.discretise.packing`.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeGuard

import numpy as np

from cortado.discretise.pairs import apart, pairs_within
from cortado.discretise.room import Region, Room
from cortado.discretise.shapes import Points, grid
from cortado.scene.fluids import ALIGNED, Fluid, RegionFluid

FINER = 4
"""Cells at the surface are cut into so many along each axis to measure a volume."""
LOOSENESS, MOST_LOOSENESS = 0.05, 0.008
"""Particles that a round body lacks, over those in its outermost spacing, and over all of its own: particles off the
lattice see each other as denser than as many on it, by 4 % with the Wendland kernels and a support of 2 spacings."""
FAR = 4.0
"""In spacings: how deep in a body depths are told apart."""
DIGITS = 6
"""Decimals of distances [spacings] by which particles are ordered: what is equal but for round-off stays in order."""


def is_packed(fluid: Fluid, room: Room, reach: float, spacing: float) -> TypeGuard[RegionFluid]:
    """Whether particles of a body may have another density than the lattice: where its own surface cuts cells, or where
    it is no further than ``reach`` [m] from a solid."""
    if not isinstance(fluid, RegionFluid) or fluid.cuts_cells(spacing):
        return isinstance(fluid, RegionFluid)
    return bool(len(room.solids) and (room.from_solids(fluid.particles(spacing), reach) < reach).any())


@dataclass(frozen=True)
class CutBody:
    """The part of a body of fluid that a container and solids leave room for."""

    fluid: RegionFluid
    room: Room
    spacing: float
    """[m]"""

    def distance(self, points: Points, reach: float) -> Points:
        """(n,) how far points (n, d) [m] are outside of the body, negative inside [m]. What is not less than a reach
        [m] in size may be any other number of its sign that is not."""
        return np.maximum(self.fluid.distance(points, self.spacing, reach), self.room.distance(points, reach))

    def shares(self, points: Points) -> Points:
        """(n,) the part of the cell around each of the points (n, d) [m] that is within the body."""
        return np.clip(0.5 - self.distance(points, 0.5 * self.spacing) / self.spacing, 0.0, 1.0)

    def volume(self, depth: float = 0.0) -> float:
        """[m^d] of what is more than a depth [m] below the surface."""
        dimension, fine = self.room.dimension, self.spacing / FINER
        cells, reach = self.fluid.block(self.spacing).grown(1).points(), depth + self.spacing
        distances = self.distance(cells, reach) + depth
        cut = cells[np.abs(distances) < 0.5 * self.spacing * np.sqrt(dimension)]
        whole = np.count_nonzero(distances < 0.0) - np.count_nonzero(self.distance(cut, reach) + depth < 0.0)
        parts = grid([np.asarray(fine * (np.arange(FINER) + 0.5) - 0.5 * self.spacing)] * dimension)
        reach = depth + fine
        shares = sum(np.clip(0.5 - (self.distance(cut + part, reach) + depth) / fine, 0.0, 1.0).sum() for part in parts)
        return float(whole * self.spacing**dimension + shares * fine**dimension)

    @cached_property
    def asked(self) -> float:
        """[m^d] that it is to hold: the volume of the fluid's shape, times the part of it that walls leave."""
        everywhere = Room(Region.everywhere(self.room.dimension), (), self.room.periods)
        return self.fluid.volume(self.spacing) * self._held / replace(self, room=everywhere)._held

    @cached_property
    def _held(self) -> float:
        """Its volume, as cells measure it [m^d]."""
        return self.volume()

    @cached_property
    def count(self) -> int:
        """The number of its particles."""
        volume = self._held
        lacking = min(LOOSENESS * (volume - self.volume(self.spacing)), MOST_LOOSENESS * volume)
        return round((volume - lacking) / self.spacing**self.room.dimension)

    def particles(self) -> Points:
        """(n, d) [m] where its particles begin: on the lattice, and where surfaces cut its cells as deep as there are
        points, `count` of them."""
        if not self._cuts_cells():
            return self.fluid.particles_in(self.room, self.spacing)
        points = self.fluid.lattice(self.spacing, self.spacing)
        depths = np.round(self.distance(points, FAR * self.spacing) / self.spacing, DIGITS)
        return points[np.sort(np.argsort(depths, kind="stable")[: self.count])]

    def _cuts_cells(self) -> bool:
        """Whether a surface goes through cells: that of the body, or that of a solid."""
        if self.fluid.cuts_cells(self.spacing):
            return True
        from_solids = self.room.from_solids(self.fluid.particles(self.spacing), self.spacing)
        return bool((np.abs(from_solids) < (0.5 - ALIGNED) * self.fluid.block(self.spacing).spacings.min()).any())


@dataclass(frozen=True)
class Surroundings:
    """What lies around bodies that were cut: particles that stay where they are, air, and walls."""

    bodies: tuple[CutBody, ...]
    staying: Points
    """(m, d) particles of other fluid [m]"""
    lower: Points
    """(d,) where the period begins [m]"""
    lengths: Points
    """(d,) the lengths of the period [m], 0 for axes without one"""

    def air(self, reach: float) -> tuple[Points, Points]:
        """Points (m, d) [m] of lattices around the bodies up to ``reach`` [m] from their surfaces, and of the cell
        around each the part (m,) where there is neither fluid nor wall."""
        found = [self._air_around(body, reach) for body in self.bodies]
        points, shares = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return points[shares > 0.0], shares[shares > 0.0]

    def _air_around(self, body: CutBody, reach: float) -> tuple[Points, Points]:
        """That which is nearer to one body than to others, and no further from it than half a period."""
        points = body.fluid.lattice(body.spacing, reach + body.spacing)
        middle = 0.5 * np.sum(body.fluid.extent(body.spacing), axis=0)
        within = ((self.lengths == 0.0) | (np.abs(points - middle) < 0.5 * self.lengths)).all(axis=1)
        furthest = reach + body.spacing
        points = points[within & (np.abs(body.distance(points, furthest)) < furthest)]
        nearest = np.argmin([self._distance(other, points, furthest) for other in self.bodies], axis=0)
        points = points[nearest == self.bodies.index(body)]
        fluid = self._shares(points, body.spacing)
        walls = np.clip(0.5 + body.room.distance(points, body.spacing) / body.spacing, 0.0, 1.0)
        return points, np.clip(1.0 - fluid - walls, 0.0, 1.0)

    def _distance(self, body: CutBody, points: Points, reach: float) -> Points:
        return np.min([body.distance(points + shift, reach) for shift in body.room.shifts()], axis=0)

    def _shares(self, points: Points, spacing: float) -> Points:
        """(n,) the part of the cell around each of the points that is fluid."""
        found = sum(body.shares(points + shift) for body in self.bodies for shift in body.room.shifts())
        reach = spacing * np.sqrt(points.shape[1])
        point, particle, _ = pairs_within(points, self.staying, reach, self.lower, self.lengths)
        separations = np.abs(apart(points[point] - self.staying[particle], self.lengths))
        common = np.clip(1.0 - separations / spacing, 0.0, None).prod(axis=1)
        return np.asarray(found + np.bincount(point, common, minlength=len(points)), dtype=np.float64)
