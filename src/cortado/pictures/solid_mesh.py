"""Surfaces of solids as triangles that light can be found at the corners of: small ones, smooth where a solid is round
and sharp at its edges."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.discretise.solids.faces import Faces
from cortado.pictures.refined import Numbers, merged, refined, sides_of

SHARP = 0.8
"""Cosine of the angle between two triangles below which the edge between them is sharp."""
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
    """(t, 3, 3) how far each corner, the columns, is from each side of the face that the triangle is a part of, the rows
    [m]: where that is a sharp edge; else `FAR`"""

    @classmethod
    def of(cls, faces: Faces, longest: float) -> "SolidMesh":
        """Of the surface of a solid in 3-D, with sides no longer than ``longest`` [m]."""
        flat_points, flat_corners, _ = merged(faces.vertices, faces.corners)
        points, corners, parents = refined(flat_points, flat_corners, longest)
        across = _across(points, corners)
        normals = _normals(corners, across)
        key = np.column_stack([corners.ravel(), np.rint(normals.reshape(-1, 3) * 1e4).astype(np.int64)])
        _, chosen, number = np.unique(key, axis=0, return_index=True, return_inverse=True)
        from_edges = _from_edges(flat_points, flat_corners, points[corners], parents)
        return cls(points[corners.ravel()[chosen]], normals.reshape(-1, 3)[chosen], number.reshape(-1, 3), from_edges)

    def moved(self, turn: Points, position: Points) -> "SolidMesh":
        """Turned by a matrix (3, 3) and then moved (3,) [m]."""
        return SolidMesh(self.points @ turn.T + position, self.normals @ turn.T, self.triangles, self.from_edges)

    @classmethod
    def joined(cls, parts: Sequence["SolidMesh"]) -> "SolidMesh":
        """Several as one."""
        starts = np.cumsum([0, *(len(part.points) for part in parts)])
        triangles = [part.triangles + start for part, start in zip(parts, starts, strict=False)]
        return cls(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in ("points", "normals")),
            np.concatenate(triangles),
            np.concatenate([part.from_edges for part in parts]),
        )


def _across(points: Points, corners: Numbers) -> Points:
    """(t, 3) outwards, as long as twice the area of each triangle [m2]."""
    a, b, c = points[corners].transpose(1, 0, 2)
    return np.asarray(np.cross(b - a, c - a))


def _unit(vectors: Points) -> Points:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _normals(corners: Numbers, across: Points) -> Points:
    """(t, 3, 3) at each corner the mean of the normals of triangles there, but for those beyond sharp edges."""
    order = np.argsort(corners.ravel(), kind="stable")
    counts = np.bincount(corners.ravel())
    ends = np.cumsum(counts)
    own = counts[corners.ravel()]  # how many triangles there are around each corner
    corner = np.repeat(np.arange(corners.size), own)
    within = np.arange(len(corner)) - np.repeat(np.cumsum(own) - own, own)
    other = order[np.repeat((ends - counts)[corners.ravel()], own) + within] // 3
    flat = _unit(across)
    smooth = np.einsum("pk,pk->p", flat[corner // 3], flat[other]) > SHARP
    weighted = across[other] * smooth[:, None]
    summed = np.stack([np.bincount(corner, weighted[:, k], corners.size) for k in range(3)], axis=1)
    return _unit(summed).reshape(-1, 3, 3)


def _from_edges(points: Points, corners: Numbers, parts: Points, parents: Numbers) -> Points:
    """As `SolidMesh.from_edges`: triangles (p, 3, 3) [m] that are parts of triangles (t, 3), the parents (p,)."""
    sides = points[sides_of(corners).reshape(-1, 3, 2)]
    across = _unit(_across(points, corners))
    inwards = _unit(np.cross(across[:, None], sides[:, :, 1] - sides[:, :, 0]))
    beyond = parts[:, None] - sides[parents][:, :, :1]
    distances = np.einsum("pkjc,pkc->pkj", beyond, inwards[parents])
    return np.where(_is_sharp(corners, across)[parents][..., None], distances, FAR)


def _is_sharp(corners: Numbers, flat: Points) -> NDArray[np.bool_]:
    """(t, 3) whether the side across each corner is a sharp edge, or the end of the surface."""
    _, which, counts = np.unique(np.sort(sides_of(corners), axis=1), axis=0, return_inverse=True, return_counts=True)
    which = which.reshape(-1)
    summed = np.stack([np.bincount(which, np.repeat(flat[:, k], 3)) for k in range(3)], axis=1)
    square = (summed**2).sum(axis=1)  # 2 + 2 cos of the angle between two triangles
    return np.asarray(((square < 2.0 + 2.0 * SHARP) | (counts != 2))[which].reshape(-1, 3))
