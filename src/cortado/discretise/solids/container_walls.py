"""The walls of a container that has solids in it: which of them solids leave as they are, in float64."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cortado.discretise.room import Room
from cortado.discretise.shapes import Points
from cortado.discretise.solids.solid import Solid, Which
from cortado.discretise.solids.wall_points import WallPoints


@dataclass(frozen=True, eq=False)
class ContainerWalls:
    """The wall particles that a container has without solids.

    Of those that are so far from all solids that no fluid beside these sees them, each keeps its place and its cell.
    """

    points: WallPoints
    solids: Sequence[Solid]
    """What closes the container."""
    room: Room
    """Where fluid may be, beside solids."""
    spacing: float
    """Of particles [m]."""
    support: float
    """[m]"""

    @property
    def _clear(self) -> float:
        """How far from solids feet of wall particles are that keep their places [m]."""
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
