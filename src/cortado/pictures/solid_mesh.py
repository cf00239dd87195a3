"""Surfaces of solids as triangles that light can be found at the corners of: small ones, smooth where a solid is round
and sharp at its edges."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cortado.discretise.shapes import Points
from cortado.discretise.solids.faces import Faces
from cortado.pictures.refined import refined
from cortado.pictures.triangles import SHARP, Numbers, across_of, cosines_of, merged, sides_of, unit

ROUNDS = 8
"""Of smoothing, which takes away the steps that light from few directions has on what is round."""
FAR = 1e9
"""How far from a sharp edge a triangle is that has none [m]."""


@dataclass(frozen=True)
class SolidMesh:
    """Triangles in space, outside on the side from which their corners run counterclockwise."""

    points: Points
    """(p, 3) [m]"""
    normals: Points
    """(p, 3) unit vectors outwards"""
    triangles: Numbers
    """(t, 3) numbers of points"""
    from_edges: Points
    """(t, 3, 3) how far each corner (a column) is from each side (a row) of the face that its triangle is part of [m];
    `FAR` where the side is no sharp edge"""

    @classmethod
    def of(cls, faces: Faces, longest: float) -> "SolidMesh":
        """Of the surface of a solid in 3-D, with sides no longer than about ``longest`` [m]."""
        flat_points, flat_corners, _ = merged(faces.vertices, faces.corners)
        points, corners, parents = refined(flat_points, flat_corners, longest)
        across = across_of(points, corners)
        normals = _normals(corners, across)
        key = np.column_stack([corners.ravel(), np.rint(normals.reshape(-1, 3) * 1e4).astype(np.int64)])
        _, chosen, number = np.unique(key, axis=0, return_index=True, return_inverse=True)
        from_edges = _from_edges(flat_points, flat_corners, points[corners], parents)
        return cls(points[corners.ravel()[chosen]], normals.reshape(-1, 3)[chosen], number.reshape(-1, 3), from_edges)

    def smoothed(self, values: Points) -> Points:
        """Values (p, c) at points, smoothed along the surface but not across sharp edges."""
        from scipy.sparse import csr_matrix

        ends = self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        first, second = np.concatenate([ends, ends[:, ::-1]]).T
        count = len(self.points)
        beside = csr_matrix((np.ones(len(first)), (first, second)), (count, count))
        weights = np.maximum(np.asarray(beside.sum(axis=1)), 1.0)
        for _ in range(ROUNDS):
            values = 0.5 * values + 0.5 * (beside @ values) / weights
        return values

    def moved(self, turn: Points, position: Points) -> "SolidMesh":
        """Turned by a matrix (3, 3) and then moved (3,) [m]."""
        return SolidMesh(self.points @ turn.T + position, self.normals @ turn.T, self.triangles, self.from_edges)

    @classmethod
    def joined(cls, parts: Sequence["SolidMesh"]) -> "SolidMesh":
        """Several as one."""
        starts = np.cumsum([0, *(len(part.points) for part in parts)])
        return cls(
            points=np.concatenate([part.points for part in parts]),
            normals=np.concatenate([part.normals for part in parts]),
            triangles=np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=False)]),
            from_edges=np.concatenate([part.from_edges for part in parts]),
        )


def _normals(corners: Numbers, across: Points) -> Points:
    """(t, 3, 3) at each corner the mean of the normals of triangles there, but for those beyond sharp edges."""
    order = np.argsort(corners.ravel(), kind="stable")
    counts = np.bincount(corners.ravel())
    ends = np.cumsum(counts)
    own = counts[corners.ravel()]  # how many triangles there are around each corner
    corner = np.repeat(np.arange(corners.size), own)
    within = np.arange(len(corner)) - np.repeat(np.cumsum(own) - own, own)
    other = order[np.repeat((ends - counts)[corners.ravel()], own) + within] // 3
    flat = unit(across)
    smooth = np.einsum("pk,pk->p", flat[corner // 3], flat[other]) > SHARP
    weighted = across[other] * smooth[:, None]
    summed = np.stack([np.bincount(corner, weighted[:, k], corners.size) for k in range(3)], axis=1)
    return unit(summed).reshape(-1, 3, 3)


def _from_edges(points: Points, corners: Numbers, parts: Points, parents: Numbers) -> Points:
    """As `SolidMesh.from_edges`: triangles (p, 3, 3) [m] that are parts of triangles (t, 3), the parents (p,)."""
    sides = points[sides_of(corners).reshape(-1, 3, 2)]
    across = unit(across_of(points, corners))
    inwards = unit(np.cross(across[:, None], sides[:, :, 1] - sides[:, :, 0]))
    beyond = parts[:, None] - sides[parents][:, :, :1]
    distances = np.einsum("pkjc,pkc->pkj", beyond, inwards[parents])
    return np.where((cosines_of(points, corners) < SHARP)[parents][..., None], distances, FAR)
