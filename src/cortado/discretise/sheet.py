"""Sheets (walls without thickness) and wall particles of sheets, in float64. Sheets are edges in 2-D, triangles in
3-D."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from cortado.discretise.mesh import TriangleTree
from cortado.discretise.room import Room
from cortado.discretise.shapes import ROUND_OFF, Numbers, Points, Which, in_space, launch_on_cpu
from cortado.discretise.solid import Faces, Solid, nearest_on_edges
from cortado.discretise.solid_walls import DENSITY, WallPoints, frames, surface_points
from cortado.discretise.walls import Places, RestLattice, wall_weights


@dataclass(frozen=True, eq=False)
class Sheet(Solid):
    """A surface with fluid on both sides. Distances from a sheet are never negative."""

    vertices: Points
    """Vertices (m, d) [m]."""
    corners: Numbers
    """Indices of the vertices of each edge or triangle (k, d)."""

    @classmethod
    def along(cls, places: Points) -> "Sheet":
        """Return the sheet along a polyline (m, 2) [m] in 2-D, or in a convex flat polygon (m, 3) [m] in 3-D."""
        numbers, is_flat = np.arange(len(places)), places.shape[1] == 2
        around = [0 * numbers[2:], numbers[1:-1], numbers[2:]]
        return cls(places, np.stack([numbers[:-1], numbers[1:]] if is_flat else around, axis=1))

    @property
    def pieces(self) -> Points:
        return self.vertices[self.corners]

    @property
    def normals(self) -> Points:
        return np.asarray(self._across / np.linalg.norm(self._across, axis=1, keepdims=True))

    def centroid(self) -> Points:
        sizes = np.linalg.norm(self._across, axis=1)
        return np.asarray(sizes @ self.pieces.mean(axis=1) / sizes.sum())

    @classmethod
    def joined(cls, sheets: Sequence["Sheet"]) -> "Sheet":
        starts = np.cumsum([0, *(len(one.vertices) for one in sheets[:-1])])
        corners = [one.corners + start for one, start in zip(sheets, starts, strict=True)]
        return cls(np.concatenate([one.vertices for one in sheets]), np.concatenate(corners))

    def placed(self, position: Points, turn: Points) -> "Sheet":
        return Sheet(self.vertices @ turn.T + position, self.corners)

    def extent(self) -> tuple[Points, Points]:
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    def distance(self, points: Points) -> Points:
        return np.asarray(np.linalg.norm(points - self.nearest(points), axis=1))

    def nearest(self, points: Points) -> Points:
        return self._tree.nearest(points)[0] if points.shape[1] == 3 else nearest_on_edges(points, self.pieces)

    def aside(self, points: Points, distance: float) -> Points:
        """Move points to a distance [m] from the sheet, on the same side, or along the sheet's normals."""
        feet = self.nearest(points)
        away = points - feet
        length = np.linalg.norm(away, axis=1)
        on_it = length < ROUND_OFF * distance
        middles = self.pieces.mean(axis=1)
        for k in np.flatnonzero(on_it):
            away[k] = self.normals[np.argmin(np.linalg.norm(middles - points[k], axis=1))]
            length[k] = 1.0
        return np.asarray(feet + distance * away / length[:, None])

    def faces(self, fine: float) -> Faces:
        return Faces(self.vertices, np.concatenate([self.corners, self.corners[:, ::-1]]))

    def crossed(self, starts: Points, ends: Points, spacing: float) -> Which:
        from cortado.device.modules import start_warp

        start_warp()
        import warp as wp

        from cortado.device.precision import FLOAT64
        from cortado.discretise.tree_kernels import faces_on, find_crossing

        faces, trees = faces_on([(self.pieces, self.normals)], spacing, FLOAT64, wp.get_device("cpu"))
        found = np.zeros(len(starts), dtype=bool)
        start, end = (np.ascontiguousarray(in_space(places)) for places in (starts, ends))
        launch_on_cpu(find_crossing(), len(starts), faces=faces, starts=start, ends=end, found=found)
        del trees
        return found

    @cached_property
    def _across(self) -> Points:
        """The length of a normal (k, d) is proportional to the size of the edge or triangle."""
        first, *others = np.moveaxis(self.pieces, 1, 0)
        along = [other - first for other in others]
        return along[0][:, ::-1] * np.array([-1.0, 1.0]) if len(along) == 1 else np.cross(*along)

    @cached_property
    def _tree(self) -> TriangleTree:
        return TriangleTree.of(self.pieces)


@dataclass(frozen=True, eq=False)
class Thickened(Solid):
    sheet: Sheet
    depth: float
    """Greatest distance from the sheet [m]."""

    def extent(self) -> tuple[Points, Points]:
        lower, upper = self.sheet.extent()
        return lower - self.depth, upper + self.depth

    def distance(self, points: Points) -> Points:
        return self.sheet.distance(points) - self.depth

    def nearest(self, points: Points) -> Points:
        feet = self.sheet.nearest(points)
        away = points - feet
        length = np.linalg.norm(away, axis=1, keepdims=True)
        return np.asarray(feet + self.depth * away / np.maximum(length, 1e-300))

    def faces(self, fine: float) -> Faces:
        """Return the surface with sharp edges: the sheet shifted to both sides, and strips along the boundary."""
        sheet, count = self.sheet, len(self.sheet.vertices)
        aside = np.zeros_like(sheet.vertices)
        for corner in sheet.corners.T:
            np.add.at(aside, corner, sheet.normals)
        aside *= self.depth / np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-300)
        vertices = np.concatenate([sheet.vertices + aside, sheet.vertices - aside])
        both = [sheet.corners, sheet.corners[:, ::-1] + count]
        if sheet.vertices.shape[1] == 2:
            uses = np.bincount(sheet.corners.ravel(), minlength=count)
            starts = [a for a in sheet.corners[:, 0] if uses[a] == 1]
            ends = [b for b in sheet.corners[:, 1] if uses[b] == 1]
            strips = [(a + count, a) for a in starts] + [(b, b + count) for b in ends]
            return Faces(vertices, np.concatenate([*both, np.array(strips, dtype=np.int64).reshape(-1, 2)])[:, ::-1])
        sides = np.concatenate([sheet.corners[:, [k, (k + 1) % 3]] for k in range(3)])
        _, first, uses = np.unique(np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True)
        a, b = sides[first[uses == 1]].T
        edges = [np.stack([b, a, a + count], axis=1), np.stack([b, a + count, b + count], axis=1)]
        return Faces(vertices, np.concatenate([*both, *edges]))


def sheet_points(sheet: Sheet, lattice: RestLattice) -> WallPoints:
    """The wall particles lie on both sides and around the ends of a sheet, at the depths of a flat wall's layers."""
    apart, layers = DENSITY * lattice.spacing, lattice.layers
    parts = [surface_points(Thickened(sheet, depth), apart, 0.0) for depth in layers.depths]
    positions = np.concatenate([one.points for one in parts])
    shares = [weight * one.shares for weight, one in zip(layers.weights, parts, strict=True)]
    flat = DENSITY ** (lattice.dimension - 1) * np.concatenate(shares)
    return WallPoints(positions, flat, sheet.nearest(positions) - positions)


def sheet_weights(
    sheet: Sheet, points: Sequence[Points], flat: Sequence[Points], room: Room, lattice: RestLattice, least: float
) -> Points:
    """Return the weights (b,) of a sheet's wall particles, fitted at points at least ``least`` [m] from any surface.
    The lists ``points`` (b, d) [m] and ``flat`` (b,) contain first the sheet, then the other walls in the room."""
    spacing, own = lattice.spacing, len(points[0])
    heights = spacing * (np.arange(int(np.ceil(lattice.support / spacing - 0.5))) + 0.5)
    found = np.concatenate([surface_points(Thickened(sheet, height), spacing, 0.0).points for height in heights])
    away = found - sheet.nearest(found)
    about = Places(found, frames(away / np.linalg.norm(away, axis=1, keepdims=True)))
    around = replace(room, solids=(*room.solids, sheet))
    places = about.some(around.contains(found, -least))
    walls, weights = np.concatenate(points), np.concatenate(flat)
    seen = places, lattice, around, np.zeros(lattice.dimension), False, len(walls) - own
    return wall_weights(walls, weights, *seen, partial(sheet.crossed, spacing=spacing))[:own]
