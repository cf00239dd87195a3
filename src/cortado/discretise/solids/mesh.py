"""Solids whose surface is made of triangles."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.discretise.solids.faces import Faces
from cortado.discretise.solids.mesh_union import outer_surface
from cortado.discretise.solids.moments import Moments, enclosed_moments
from cortado.discretise.solids.solid import Solid
from cortado.discretise.solids.triangle_tree import Numbers, TriangleTree

LOW_DISCREPANCY = 0.7548776662466927 ** np.array([1.0, 2.0])
"""Steps along two axes of a sequence that fills a square evenly: powers of 1 / p, p^3 = p + 1."""
BESIDE = 1e-12
"""Of the length of a mesh: how far from a triangle one looks at whether both sides of it are inside."""
SEEN = 1e-3
"""Of the distance of points of a surface: how far outside of it one looks for another part of the solid."""


@dataclass(frozen=True, eq=False)
class Mesh(Solid):
    """What a closed surface of triangles holds: all points around which it goes at least once.

    Parts may overlap: each is closed by itself, and the solid is their union. `cortado.discretise.solids.mesh_checks`
    finds parts, and says what is wrong with triangles.
    """

    vertices: Points
    """(m, 3) [m]"""
    triangles: Numbers
    """(k, 3) which vertices are the corners of each, counterclockwise as seen from outside"""
    parts: Sequence[Numbers] = ()
    """The triangles of each part; without any, all are one, which does not cross itself."""
    known_trees: Sequence[TriangleTree] = ()
    """Of the parts, where somebody has made them before."""

    def moved(self, scale: float, shift: Points) -> "Mesh":
        """Multiplied by a scale greater than 0 and then moved (3,) [m]."""
        trees = [tree.moved(scale, shift) for tree in self._trees]
        return Mesh(scale * self.vertices + shift, self.triangles, self.parts, trees)

    @cached_property
    def corners(self) -> Points:
        """(k, 3, 3) the corners of all triangles [m]."""
        return self.vertices[self.triangles]

    @property
    def _numbers(self) -> Sequence[Numbers]:
        return self.parts or (np.arange(len(self.triangles)),)

    @cached_property
    def _trees(self) -> Sequence[TriangleTree]:
        return self.known_trees or [TriangleTree.of(self.corners[part]) for part in self._numbers]

    def extent(self) -> tuple[Points, Points]:
        return self._ends

    @cached_property
    def _ends(self) -> tuple[Points, Points]:
        return self.corners.min(axis=(0, 1)), self.corners.max(axis=(0, 1))

    def distance(self, points: Points) -> Points:
        """As `Solid.distance`, to round-off; where parts overlap, the depth beneath the surface of one of them, which
        is less."""
        return self._looked_up(points, np.inf)[1]

    def distance_up_to(self, points: Points, reach: float) -> Points:
        return self._looked_up(points, reach)[1]

    def holds(self, points: Points) -> NDArray[np.bool_]:
        """(n,) whether points (n, 3) [m] are inside."""
        return np.any([tree.windings(points) > 0 for tree in self._trees], axis=0)

    def nearest(self, points: Points) -> Points:
        if len(self._trees) == 1:
            return self._trees[0].nearest(points)[0]
        return self._looked_up(points, np.inf)[0]

    def outward(self, points: Points) -> Points:
        places, distances = self._looked_up(points, np.inf)
        return (points - places) / np.where(distances == 0.0, 1.0, distances)[:, None]

    def faces(self, fine: float) -> Faces:
        return Faces(self.vertices, self.triangles)

    def _looked_up(self, points: Points, reach: float) -> tuple[Points, Points]:
        """(n, 3) the nearest points of the surface, and (n,) the distances, no larger than a reach [m]."""
        found, best = np.empty_like(points), np.full(len(points), np.inf)
        for tree in self._trees:
            places, away = tree.nearest(points, reach)
            distances = np.where(tree.windings(points) > 0, -away, away)
            nearer = distances < best
            found[nearer], best[nearer] = places[nearer], distances[nearer]
        return found, best

    def own_feet(self, fine: float) -> tuple[Points, Points]:
        """As `Solid.own_feet`.

        Along the triangles, in an order in which those near each other in space follow one another, a point stands at
        equal intervals of the area; in a triangle that has several, these are a sequence of low discrepancy (Roberts
        2018, R2), folded into it.
        """
        order = np.concatenate([part[tree.order] for part, tree in zip(self._numbers, self._trees, strict=True)])
        areas = self.areas()[order]
        total = areas.sum()
        count = max(round(total / fine**2), 1)
        numbers = np.arange(count)
        owner = np.searchsorted(np.cumsum(areas), (numbers + 0.5) * total / count)
        owner = order[np.minimum(owner, len(order) - 1)]
        along = np.mod(0.5 + numbers[:, None] * LOW_DISCREPANCY, 1.0)
        along = np.where(along.sum(axis=1, keepdims=True) > 1.0, 1.0 - along, along)
        a, b, c = np.moveaxis(self.corners[owner], 1, 0)
        points, outward = a + along[:, :1] * (b - a) + along[:, 1:] * (c - a), self.normals()[owner]
        if not self.parts:
            return points, outward
        seen = self._looked_up(points + SEEN * fine * outward, SEEN * fine)[1] > 0.0
        return points[seen], outward[seen]

    def moments(self) -> Moments:
        return self._moments

    @cached_property
    def _moments(self) -> Moments:
        if not self.parts:
            return enclosed_moments(self.corners, np.ones(len(self.corners)))
        reach = BESIDE * float(np.ptp(self.extent(), axis=0).max())
        pieces = list(zip(self.parts, self._trees, strict=True))
        pairs = [part[tree.crossings(self.triangles[part], 0.0)] for part, tree in pieces]
        for (one, tree), (other, beside) in combinations(pieces, 2):
            first, second = tree.beside(beside, reach).T
            pairs.append(np.column_stack([one[first], other[second]]))
        return enclosed_moments(*outer_surface(self.corners, np.concatenate(pairs), self.holds, reach))

    def normals(self) -> Points:
        """(k, 3) unit vectors outwards from each triangle; 0 where it has no area."""
        across = self._across
        return across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)

    def areas(self) -> Points:
        """(k,) of each triangle [m2]."""
        return 0.5 * np.linalg.norm(self._across, axis=1)

    @cached_property
    def _across(self) -> NDArray[np.float64]:
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.cross(b - a, c - a)
