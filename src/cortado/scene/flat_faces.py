"""Flat faces of moving solids that mirror the fluid (`cortado.particles.mirrors`)."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cortado.discretise.primitives import Box
from cortado.discretise.shapes import Numbers, Points
from cortado.discretise.solid import Hollow, Solid
from cortado.scene.motions import moving
from cortado.scene.scene import Scene
from cortado.scene.solvers import ProjectionSolver

LENGTH = 4.0
"""Length of the shortest face that mirrors, in support radii."""
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
    """Find the faces that mirror, so many at ``most``, of a scene with a ``support`` radius [m]: long enough edges of
    boxes and polygons in the plane, and sides of boxes in space, of solids with paths along which fluid slips freely.
    There are none with other solvers, and in a scene with periods."""
    found = []
    if isinstance(scene.solver, ProjectionSolver) and not np.any(scene.container.periods(scene.dimension)[1]):
        for number, table in enumerate(moving(scene.solid)):
            if table.motion != "free" and not table.sticks:
                solid = table.own_solid()
                flat = _edges(solid, scene.discretisation.spacing) if scene.dimension == 2 else _sides(solid)
                found += [(number, *face) for face in flat if (face[2][1:] >= 0.5 * LENGTH * support).all()]
    solids, places, frames, sizes = (np.array([face[k] for face in found[:most]]) for k in range(4))
    return FlatFaces(solids.astype(np.int32), places.reshape(-1, 3), frames.reshape(-1, 3, 3), sizes.reshape(-1, 3))


def _edges(solid: Solid, spacing: float) -> Iterator[tuple[Points, Points, Points]]:
    """Yield the middle, the frame and half the size of each edge of a solid in the plane, as `FlatFaces` has them."""
    faces = solid.faces(spacing)
    for start, end in faces.vertices[faces.corners]:
        length = float(np.linalg.norm(end - start))
        x, y = (end - start) / length
        frame = np.array([[y, -x, 0.0], [x, y, 0.0], [0.0, 0.0, 1.0]])
        yield np.append(0.5 * (start + end), 0.0), frame, np.array([0.0, 0.5 * length, np.inf])


def _sides(solid: Solid) -> Iterator[tuple[Points, Points, Points]]:
    """Yield the same of the six sides of a box in space, and nothing of another solid."""
    box, outwards = (solid.cavity, -1.0) if isinstance(solid, Hollow) else (solid, 1.0)
    if isinstance(box, Box):
        for axis, sign in itertools.product(range(3), (-1.0, 1.0)):
            normal, *along = np.roll(np.eye(3), -axis, axis=0)
            frame = np.stack([outwards * sign * normal, *along])
            yield sign * box.half[axis] * normal, frame, np.append(0.0, np.stack(along) @ box.half)
