"""What a solid is to the discretisation: signed distances, nearest points and faces of its surface, in float64."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points, across
from cortado.discretise.solids.faces import Faces, arc, box_faces, cut_box_faces, polygon_faces, revolved_faces

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
class Box(Solid):
    """A box about the origin, along the axes."""

    half: Points
    """(d,) half of its sides [m]"""

    def extent(self) -> tuple[Points, Points]:
        return -self.half, self.half

    def distance(self, points: Points) -> Points:
        beyond = np.abs(points) - self.half
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return np.asarray(outside + np.minimum(beyond.max(axis=1), 0.0))

    def nearest(self, points: Points) -> Points:
        found = np.clip(points, -self.half, self.half)
        beyond = np.abs(points) - self.half
        inside = np.flatnonzero((beyond < 0.0).all(axis=1))
        axis = np.argmax(beyond[inside], axis=1)
        found[inside, axis] = np.where(points[inside, axis] < 0.0, -self.half[axis], self.half[axis])
        return found

    def faces(self, fine: float) -> Faces:
        return box_faces(self.half)


@dataclass(frozen=True)
class Round(Solid):
    """All points no further than a radius from a segment about the origin: a capsule, or a sphere (in 2-D a disc) where
    the segment has no length."""

    half: Points
    """(d,) from the middle of the segment to its end [m]"""
    radius: float
    """[m]"""

    def extent(self) -> tuple[Points, Points]:
        reach = np.abs(self.half) + self.radius
        return -reach, reach

    def distance(self, points: Points) -> Points:
        return np.asarray(np.linalg.norm(points - self._within(points), axis=1) - self.radius)

    def nearest(self, points: Points) -> Points:
        within = self._within(points)
        away = points - within
        length = np.linalg.norm(away, axis=1, keepdims=True)
        sideways = np.eye(points.shape[1])[np.argmin(np.abs(self.half))]
        return np.asarray(within + self.radius * np.where(length > 0.0, away / np.maximum(length, 1e-300), sideways))

    def faces(self, fine: float) -> Faces:
        length = float(np.linalg.norm(self.half))
        above = arc(np.array([0.0, length]), self.radius, 0.0, np.pi, fine)
        profile = polygon_faces(np.concatenate([above, -above]))
        along = self.half / length if length > 0.0 else np.eye(len(self.half))[-1]
        flat = len(self.half) == 2
        upright = profile if flat else revolved_faces(profile, 2, fine)
        return upright.moved(_standing(along), np.zeros(len(along)))

    def _within(self, points: Points) -> Points:
        """(n, d) the nearest points of the segment."""
        square = float(self.half @ self.half)
        along = np.clip(points @ self.half / square, -1.0, 1.0) if square > 0.0 else np.zeros(len(points))
        return np.asarray(along[:, None] * self.half)


@dataclass(frozen=True)
class Revolved(Solid):
    """A solid of revolution about an axis of space through the origin."""

    profile: Solid
    """Its cut with a plane through the axis, in 2-D: across the axis, to both sides, and along it."""
    axis: int

    def extent(self) -> tuple[Points, Points]:
        lower, upper = self.profile.extent()
        along = np.arange(3) == self.axis
        return np.where(along, lower[1], -upper[0]), np.where(along, upper[1], upper[0])

    def distance(self, points: Points) -> Points:
        return self.profile.distance(self._flat(points))

    def nearest(self, points: Points) -> Points:
        flat = self._flat(points)
        found = self.profile.nearest(flat)
        across = np.delete(points, self.axis, axis=1)
        away = np.where(flat[:, :1] > 0.0, across / np.maximum(flat[:, :1], 1e-300), np.array([1.0, 0.0]))
        return np.insert(found[:, :1] * away, self.axis, found[:, 1], axis=1)

    def faces(self, fine: float) -> Faces:
        return revolved_faces(self.profile.faces(fine), self.axis, fine)

    def _flat(self, points: Points) -> Points:
        """(n, 2) distance from the axis, and height [m]."""
        across = np.linalg.norm(np.delete(points, self.axis, axis=1), axis=1)
        return np.column_stack([across, points[:, self.axis]])


@dataclass(frozen=True)
class HalfSpace(Solid):
    """All that is below a plane, as far as a box shows it."""

    normal: Points
    """(d,) unit vector upwards"""
    height: float
    """Of the plane along it [m]."""
    lower: Points
    """(d,) [m]"""
    upper: Points
    """(d,) [m]"""

    @property
    def is_bounded(self) -> bool:
        return False

    def extent(self) -> tuple[Points, Points]:
        return self.lower, self.upper

    def distance(self, points: Points) -> Points:
        return np.asarray(points @ self.normal - self.height)

    def nearest(self, points: Points) -> Points:
        return np.asarray(points - self.distance(points)[:, None] * self.normal)

    def faces(self, fine: float) -> Faces:
        size = float(np.linalg.norm(self.upper - self.lower))
        middle = 0.5 * (self.lower + self.upper)
        top = middle - (middle @ self.normal - self.height) * self.normal
        return box_faces(np.full(len(middle), size)).moved(_standing(self.normal), top - size * self.normal)

    def shown_faces(self, fine: float) -> Faces:
        return cut_box_faces(self.lower, self.upper, self.normal, self.height)


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


@dataclass(frozen=True)
class Polygon(Solid):
    """A polygon in 2-D, whose sides do not cross."""

    corners: Points
    """(m, 2) [m], either way round"""

    def extent(self) -> tuple[Points, Points]:
        return self.corners.min(axis=0), self.corners.max(axis=0)

    def distance(self, points: Points) -> Points:
        away = np.linalg.norm(points - self.nearest(points), axis=1)
        return np.where(self._holds(points), -away, away)

    def nearest(self, points: Points) -> Points:
        best, found = np.full(len(points), np.inf), np.empty_like(points)
        for first, last in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            side = last - first
            along = np.clip((points - first) @ side / (side @ side), 0.0, 1.0)
            place = first + along[:, None] * side
            square = ((points - place) ** 2).sum(axis=1)
            nearer = square < best
            best, found[nearer] = np.minimum(best, square), place[nearer]
        return found

    def faces(self, fine: float) -> Faces:
        return polygon_faces(self.corners)

    def _holds(self, points: Points) -> Which:
        """(n,) by the number of sides that a ray along the first axis crosses."""
        inside = np.zeros(len(points), dtype=bool)
        for (x_0, y_0), (x_1, y_1) in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            if y_0 == y_1:
                continue
            spans = (y_0 > points[:, 1]) != (y_1 > points[:, 1])
            inside ^= spans & (points[:, 0] < x_0 + (points[:, 1] - y_0) * (x_1 - x_0) / (y_1 - y_0))
        return inside


def _standing(direction: Points) -> Points:
    """(d, d) the rotation matrix that turns the last axis to a unit vector (d,)."""
    frame = np.stack([*across(direction), direction], axis=1)
    frame[:, 0] *= np.linalg.det(frame)
    return frame
