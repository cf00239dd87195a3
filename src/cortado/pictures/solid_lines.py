"""Solids as lines: their edges, and where they are round the cuts with three planes through their middles."""

import numpy as np

from cortado.discretise.shapes import Points
from cortado.discretise.solids.faces import Faces
from cortado.pictures.shown_solids import ShownSolid, shown_solids
from cortado.pictures.triangles import SHARP, Numbers, cosines_of, merged, sides_of
from cortado.scene.scene import Scene

SIDES = 48
"""Of the polygon that stands for a circle."""
FLAT = 1.0 - 1e-9
"""Cosine of the angle between triangles below which they are not of one plane."""


def solid_outline(scene: Scene) -> Points:
    """(k, 2, d) ends of the lines that draw the solids of a scene at rest [m]; none without solids."""
    lines = [own_lines(one) @ one.turn.T + one.position for one in shown_solids(scene)]
    return np.concatenate([np.zeros((0, 2, scene.dimension)), *lines])


def own_faces(shown: ShownSolid) -> Faces:
    """Faces of a solid about its middle, not turned, few enough for lines and for viewers."""
    sizes = np.ptp(shown.shape.extent(), axis=0)
    return shown.shape.shown_faces(np.pi / SIDES * float(max(sizes.min(), 0.25 * sizes.max())))


def own_lines(shown: ShownSolid) -> Points:
    """(k, 2, d) ends of the lines that draw a solid about its middle, not turned [m]."""
    faces = own_faces(shown)
    if len(shown.turn) == 2:
        return faces.vertices[faces.corners]
    points, corners, _ = merged(faces.vertices, faces.corners)
    cosines = cosines_of(points, corners)
    edges = np.unique(np.sort(sides_of(corners)[cosines.ravel() < SHARP], axis=1), axis=0)
    is_round = bool(((cosines >= SHARP) & (cosines < FLAT)).any())
    return np.concatenate([points[edges], *(_cut(points, corners, axis) for axis in range(3) if is_round)])


def _cut(points: Points, corners: Numbers, axis: int) -> Points:
    """(k, 2, 3) [m] lines where triangles cross the plane through the origin across an axis."""
    above = points[:, axis] >= 0.0
    crossing = corners[(above[corners] != above[corners[:, :1]]).any(axis=1)]
    start, end = points[sides_of(crossing)].transpose(1, 0, 2)
    crosses = (start[:, axis] >= 0.0) != (end[:, axis] >= 0.0)
    start, end = start[crosses], end[crosses]
    share = start[:, axis] / (start[:, axis] - end[:, axis])
    return (start + share[:, None] * (end - start)).reshape(-1, 2, 3)
