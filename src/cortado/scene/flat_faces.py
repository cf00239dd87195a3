"""Flat faces of moving solids that mirror the fluid (`cortado.particles.mirrors`)."""

from dataclasses import dataclass

import numpy as np

from cortado.discretise.shapes import Numbers, Points
from cortado.scene.motions import moving
from cortado.scene.scene import Scene
from cortado.scene.solvers import ProjectionSolver

LENGTH = 4.0
"""Length of the shortest face that mirrors, in support radii: images fade a support radius from each of its edges."""
ON = 1e-6
"""In spacings: distance from a face at which a point is on it."""


@dataclass(frozen=True)
class FlatFaces:
    """Flat faces of moving solids, in the frames of these."""

    solids: Numbers
    """(f,) numbers of their solids"""
    places: Points
    """(f, 3) their middles [m]"""
    frames: Points
    """(f, 3, 3) rows: the normal towards the fluid and two unit vectors along the face"""
    sizes: Points
    """(f, 3) 0, and half lengths along these two vectors [m]"""

    def behind(self, solid: Numbers, positions: Points, feet: Points, near: float) -> Numbers:
        """Return for wall particles (b,) of these solids the number of the face that each is behind, or -1. A foot ends
        on a face where it is as ``near`` as that [m]."""
        found = np.full(len(solid), -1)
        for number, (own, place, frame, size) in enumerate(
            zip(self.solids, self.places, self.frames, self.sizes, strict=True)
        ):
            at, foot = (positions + feet - place) @ frame.T, feet @ frame.T
            on = (
                (np.abs(at) <= size + near).all(axis=1) & (np.abs(foot[:, 1:]) <= near).all(axis=1) & (foot[:, 0] > 0.0)
            )
            found[on & (solid == own)] = number
        return found


def flat_faces(scene: Scene, support: float, most: int) -> FlatFaces:
    """Find the faces that mirror, so many at ``most``, of a scene with a ``support`` radius [m]: in the plane, edges of
    solids with paths that are long enough, and along which fluid slips freely. There are none with other solvers, and
    in a scene with periods."""
    found = []
    mirrors = isinstance(scene.solver, ProjectionSolver) and scene.dimension == 2
    if mirrors and not np.any(scene.container.periods(scene.dimension)[1]):
        for number, table in enumerate(moving(scene.solid)):
            if table.motion == "free" or table.sticks:
                continue
            faces = table.own_solid().faces(scene.discretisation.spacing)
            for start, end in faces.vertices[faces.corners]:
                length = np.linalg.norm(end - start)
                if length >= LENGTH * support:
                    x, y = (end - start) / length
                    frame = np.array([[y, -x, 0.0], [x, y, 0.0], [0.0, 0.0, 1.0]])
                    found.append((number, np.append(0.5 * (start + end), 0.0), frame, [0.0, 0.5 * length, np.inf]))
    solids, places, frames, sizes = (np.array([face[k] for face in found[:most]]) for k in range(4))
    return FlatFaces(solids.astype(np.int32), places.reshape(-1, 3), frames.reshape(-1, 3, 3), sizes.reshape(-1, 3))
