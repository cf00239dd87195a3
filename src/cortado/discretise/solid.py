"""Solids with faces and moments, in float64. Points are (n, d) [m]. Distances (n,) [m] are negative inside."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial

import numpy as np

from cortado.discretise.shapes import Numbers, Points, whole_origin


def rotation_matrix(rotation: Sequence[float]) -> Points:
    """Return the matrix (d, d) of a rotation vector (3,) in 3-D or an angle (1,) in 2-D [rad]."""
    from scipy.spatial.transform import Rotation

    if len(rotation) == 1:
        return np.asarray(Rotation.from_rotvec([0.0, 0.0, rotation[0]]).as_matrix()[:2, :2])
    return np.asarray(Rotation.from_rotvec(rotation).as_matrix())


@dataclass(frozen=True)
class Faces:
    """A closed surface of flat faces: edges in 2-D, and triangles in 3-D. Edges have the inside on their left."""

    vertices: Points
    """Vertices (m, d) [m]."""
    corners: Numbers
    """Indices of the vertices of each face (k, d), in 3-D counterclockwise as seen from outside."""

    def moved(self, turn: Points, position: Points) -> "Faces":
        return Faces(self.vertices @ turn.T + position, self.corners)

    def reversed(self) -> "Faces":
        return Faces(self.vertices, self.corners[:, ::-1])


def nearest_on_edges(points: Points, edges: Points) -> Points:
    """Return the nearest points on edges (k, 2, 2) to given points (n, 2) [m]."""
    best, found = np.full(len(points), np.inf), np.zeros_like(points)
    for first, last in edges:
        side = last - first
        along = np.clip((points - first) @ side / (side @ side), 0.0, 1.0)
        places = first + along[:, None] * side
        squares = ((points - places) ** 2).sum(axis=1)
        nearer = squares < best
        best, found[nearer] = np.minimum(best, squares), places[nearer]
    return found


@dataclass(frozen=True)
class Moments:
    volume: float
    """Volume [m^d]."""
    centre: Points
    """Centroid (d,) [m]."""
    second: Points
    """Integrals of products of coordinates, relative to the centroid (d, d) [m^(d + 2)]."""


def enclosed_moments(corners: Points, weights: Points) -> Moments:
    """Integrate over edges (k, 2, 2) or triangles (k, 3, 3) [m], counterclockwise from outside (Mirtich 1996)."""
    d = corners.shape[1]
    origin = whole_origin(corners.reshape(-1, d))
    about = corners - origin
    sums, (first, second) = about.sum(axis=1), np.moveaxis(about, 1, 0)[:2]
    cones = weights * (first[:, 0] * second[:, 1] - second[:, 0] * first[:, 1] if d == 2 else np.linalg.det(about))
    volume = float(cones.sum()) / factorial(d)
    middle = np.asarray((cones[:, None] * sums).sum(axis=0) / ((d + 1.0) * cones.sum()))
    products = np.einsum("k,kci,kcj->ij", cones, about, about) + np.einsum("k,ki,kj->ij", cones, sums, sums)
    return Moments(volume, origin + middle, products / factorial(d + 2) - volume * np.outer(middle, middle))


class Solid(ABC):
    """A closed body in d dimensions."""

    @property
    def is_bounded(self) -> bool:
        """Return False for a solid that extends beyond its box."""
        return True

    @abstractmethod
    def extent(self) -> tuple[Points, Points]:
        """Return the lower and the upper corner of the box around the solid, each (d,) [m]."""

    @abstractmethod
    def distance(self, points: Points) -> Points:
        """Return the distances of points from the surface."""

    @abstractmethod
    def nearest(self, points: Points) -> Points:
        """Return the nearest points on the surface."""

    @abstractmethod
    def faces(self, fine: float) -> Faces:
        """Return flat faces of the surface, about ``fine`` [m] wide on curved parts."""

    def moments(self) -> Moments:
        raise NotImplementedError(f"{type(self).__name__} has no moments")

    def shown_faces(self, fine: float) -> Faces:
        """Return the faces for pictures. An unbounded solid is shown only inside its box."""
        return self.faces(fine)

    def distance_up_to(self, points: Points, reach: float) -> Points:
        """Return the distances of points from the surface. Distances above ``reach`` [m] are only lower bounds."""
        return self.distance(points)

    def own_feet(self, fine: float) -> tuple[Points, Points] | None:
        """Return surface points and outward unit vectors (n, d), or None if a lattice search must find the points."""
        return None

    def outward(self, points: Points) -> Points:
        """Return outward unit vectors (n, d) at points away from the surface."""
        across = (points - self.nearest(points)) * np.sign(self.distance(points))[:, None]
        return np.asarray(across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300))


@dataclass(frozen=True)
class Placed(Solid):
    """A solid that is rotated about the origin and then shifted."""

    solid: Solid
    position: Points
    """Shift (d,) [m]."""
    turn: Points
    """Rotation matrix (d, d)."""

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
class Hollow(Solid):
    """All of space except a shape, like a tank with infinitely thick walls."""

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
class Mass:
    volume: float
    """Volume [m^d]."""
    inertia: Points
    """Inertia tensor about the centroid for density 1 (3, 3) [m^(d + 2)]. In 2-D only component zz is not 0."""

    @classmethod
    def of(cls, solid: Solid) -> "Mass":
        moments = solid.moments()
        about = np.trace(moments.second) * np.eye(3)
        if len(moments.centre) == 2:
            return cls(moments.volume, np.diag([0.0, 0.0, about[2, 2]]))
        return cls(moments.volume, about - moments.second)

    def in_volumes(self, unit: float) -> "Mass":
        return Mass(self.volume / unit, self.inertia / unit)
