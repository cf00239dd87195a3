"""What a solid is to the discretisation: signed distances, nearest points and faces of its surface, in float64; and
solids made of others."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.discretise.solids.faces import Faces
from cortado.discretise.solids.moments import Moments

Which = NDArray[np.bool_]


class Solid(ABC):
    """A closed body in d dimensions."""

    @property
    def is_bounded(self) -> bool:
        """Whether all of it is in the box around it."""
        return True

    @abstractmethod
    def extent(self) -> tuple[Points, Points]:
        """The box around it: lower and upper, each (d,) [m]."""

    @abstractmethod
    def distance(self, points: Points) -> Points:
        """(n,) how far points (n, d) [m] are from the surface, negative inside [m]."""

    @abstractmethod
    def nearest(self, points: Points) -> Points:
        """(n, d) [m] the points of the surface that are nearest to points (n, d) [m]."""

    @abstractmethod
    def faces(self, fine: float) -> Faces:
        """Its surface in flat faces, some ``fine`` [m] wide where it is round."""

    def moments(self) -> Moments:
        """Its volume, centroid and second moments, to round-off; solids that may move freely have them."""
        raise NotImplementedError(f"{type(self).__name__} has no moments")

    def shown_faces(self, fine: float) -> Faces:
        """The same as pictures have it: within the box around it."""
        return self.faces(fine)

    def distance_up_to(self, points: Points, reach: float) -> Points:
        """(n,) the `distance` of points (n, d) [m] where it is less than a reach [m] in size; elsewhere what has its
        sign and is at least as large as the reach. Solids that have many faces find it sooner."""
        return self.distance(points)

    def own_feet(self, fine: float) -> tuple[Points, Points] | None:
        """Points of the surface (n, d) [m], each with an area of ``fine`` [m] to the power of d - 1, and unit vectors
        (n, d) outwards, where a solid finds them sooner than a lattice around it; None elsewhere."""
        return None

    def outward(self, points: Points) -> Points:
        """(n, d) unit vectors away from the solid at points (n, d) [m] that are not on its surface."""
        across = (points - self.nearest(points)) * np.sign(self.distance(points))[:, None]
        return np.asarray(across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300))


@dataclass(frozen=True)
class Placed(Solid):
    """A solid that is turned about the origin and then moved."""

    solid: Solid
    position: Points
    """(d,) where its origin is [m]"""
    turn: Points
    """(d, d) the rotation matrix"""

    @property
    def is_bounded(self) -> bool:
        return self.solid.is_bounded

    def extent(self) -> tuple[Points, Points]:
        lower, upper = self.solid.extent()
        middle, half = self.turn @ (0.5 * (lower + upper)), np.abs(self.turn) @ (0.5 * (upper - lower))
        return self.position + middle - half, self.position + middle + half

    def distance(self, points: Points) -> Points:
        return self.solid.distance((points - self.position) @ self.turn)

    def distance_up_to(self, points: Points, reach: float) -> Points:
        if not self.solid.is_bounded:
            return self.solid.distance_up_to((points - self.position) @ self.turn, reach)
        lower, upper = self.extent()
        near = ((points > lower - reach) & (points < upper + reach)).all(axis=1)
        found = np.full(len(points), np.inf)
        found[near] = self.solid.distance_up_to((points[near] - self.position) @ self.turn, reach)
        return found

    def nearest(self, points: Points) -> Points:
        return self.position + self.solid.nearest((points - self.position) @ self.turn) @ self.turn.T

    def faces(self, fine: float) -> Faces:
        return self.solid.faces(fine).moved(self.turn, self.position)

    def own_feet(self, fine: float) -> tuple[Points, Points] | None:
        found = self.solid.own_feet(fine)
        return None if found is None else (self.position + found[0] @ self.turn.T, found[1] @ self.turn.T)


@dataclass(frozen=True)
class Union(Solid):
    """Several solids as one; they may overlap."""

    solids: Sequence[Solid]

    @property
    def is_bounded(self) -> bool:
        return all(solid.is_bounded for solid in self.solids)

    def extent(self) -> tuple[Points, Points]:
        ends = np.array([solid.extent() for solid in self.solids])
        return ends[:, 0].min(axis=0), ends[:, 1].max(axis=0)

    def distance(self, points: Points) -> Points:
        """As `Solid.distance`; where solids overlap, the depth below the surface of one of them, which is less."""
        return np.min([solid.distance(points) for solid in self.solids], axis=0)

    def distance_up_to(self, points: Points, reach: float) -> Points:
        return np.min([solid.distance_up_to(points, reach) for solid in self.solids], axis=0)

    def nearest(self, points: Points) -> Points:
        first = np.argmin([solid.distance(points) for solid in self.solids], axis=0)
        found = np.empty_like(points)
        for number, solid in enumerate(self.solids):
            found[first == number] = solid.nearest(points[first == number])
        return found

    def faces(self, fine: float) -> Faces:
        return Faces.joined([solid.faces(fine) for solid in self.solids])


@dataclass(frozen=True)
class Hollow(Solid):
    """All of space but a shape: a tank with walls of any thickness."""

    cavity: Solid

    @property
    def is_bounded(self) -> bool:
        return False

    def extent(self) -> tuple[Points, Points]:
        return self.cavity.extent()

    def distance(self, points: Points) -> Points:
        return -self.cavity.distance(points)

    def distance_up_to(self, points: Points, reach: float) -> Points:
        return -self.cavity.distance_up_to(points, reach)

    def nearest(self, points: Points) -> Points:
        return self.cavity.nearest(points)

    def faces(self, fine: float) -> Faces:
        return self.cavity.faces(fine).reversed()

    def own_feet(self, fine: float) -> tuple[Points, Points] | None:
        found = self.cavity.own_feet(fine)
        return None if found is None else (found[0], -found[1])
