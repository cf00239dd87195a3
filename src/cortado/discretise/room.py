"""Where fluid may be: in the region of a container, outside of solids."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from cortado.discretise.region import Region
from cortado.discretise.shapes import Points
from cortado.discretise.solids.solid import Placed, Solid


@dataclass(frozen=True)
class Room:
    """A region without the solids in it, which come again with every period."""

    region: Region
    solids: Sequence[Solid]
    periods: Points
    """(d,) the lengths of the period [m], 0 for axes without one"""

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return len(self.periods)

    def from_solids(self, points: Points, reach: float = np.inf) -> Points:
        """(n,) how far points (n, d) [m] are from the nearest solid, negative inside one [m]; infinite without any.
        What is not less than a reach [m] in size may be any other number of its sign that is not."""
        if not self.solids:
            return np.full(len(points), np.inf)
        images = self._images(points)
        return np.min([solid.distance_up_to(image, reach) for image in images for solid in self.solids], axis=0)

    def distance(self, points: Points, reach: float = np.inf) -> Points:
        """(n,) how far points (n, d) [m] are outside of the room, negative inside [m]. What is not less than a reach
        [m] in size may be any other number of its sign that is not."""
        return np.maximum(self.region.distance(points), -self.from_solids(points, reach))

    def contains(self, points: Points, tolerance: float) -> np.ndarray:
        """(n,) whether points (n, d) [m] are within, or outside by no more than the tolerance [m]."""
        return self.region.contains(points, tolerance) & (self.from_solids(points, abs(tolerance)) >= -tolerance)

    def cell_shares(self, points: Points, spacing: float) -> Points:
        """(n,) the part of the cell, a spacing [m] wide, around each of the points (n, d) [m] that is within the room;
        along the surfaces of solids the cell counts as turned with them."""
        within = self.region.cell_shares(points, spacing)
        return within * np.clip(self.from_solids(points, 0.5 * spacing) / spacing + 0.5, 0.0, 1.0)

    def images(self, solid: Solid) -> list[Solid]:
        """A solid, and those a period from it."""
        turn = np.eye(self.dimension)
        return [solid, *(Placed(solid, shift, turn) for shift in self._shifts()[1:])]

    def _shifts(self) -> list[Points]:
        """(d,) by how much images are off [m], the first of them not at all."""
        ends = [(0.0, -length, length) if length else (0.0,) for length in self.periods]
        return [np.array(shift) for shift in product(*ends)]

    def _images(self, points: Points) -> list[Points]:
        """Points (n, d) and those a period from them."""
        return [points + shift for shift in self._shifts()]
