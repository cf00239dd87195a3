"""Flat faces of moving solids that mirror the fluid (`cortado.particles.mirrors`)."""

from dataclasses import dataclass

import numpy as np

from cortado.discretise.shapes import Numbers, Points
from cortado.scene.motions import Knots, courses, moving
from cortado.scene.scene import Scene
from cortado.scene.solids import SolidTable
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


def flat_faces(scene: Scene, fluid: Points, support: float, most: int) -> FlatFaces:
    """Find the faces that mirror, so many at ``most``, of a scene with first particles at ``fluid`` (n, d) [m] and a
    ``support`` radius [m]: in the plane, edges of solids with paths that are long enough, along which fluid slips
    freely and around the ends of which it does not flow. There are none with other solvers, and in a scene with
    periods."""
    found = []
    mirrors = isinstance(scene.solver, ProjectionSolver) and scene.dimension == 2
    if mirrors and not np.any(scene.container.periods(scene.dimension)[1]):
        for number, table in enumerate(moving(scene.solid)):
            if table.motion == "free" or table.sticks:
                continue
            faces = table.own_solid().faces(scene.discretisation.spacing)
            edges, reached = faces.vertices[faces.corners], Reached(scene, fluid, support, table)
            for start, end in edges:
                length = np.linalg.norm(end - start)
                if length < LENGTH * support:
                    continue
                x, y = (end - start) / length
                normal = np.array([y, -x])
                if not any(_is_convex(point, normal, edges) and reached.at(point) for point in (start, end)):
                    frame = np.array([[y, -x, 0.0], [x, y, 0.0], [0.0, 0.0, 1.0]])
                    found.append((number, np.append(0.5 * (start + end), 0.0), frame, [0.0, 0.5 * length, np.inf]))
    solids, places, frames, sizes = (np.array([face[k] for face in found[:most]]) for k in range(4))
    return FlatFaces(solids.astype(np.int32), places.reshape(-1, 3), frames.reshape(-1, 3, 3), sizes.reshape(-1, 3))


def _is_convex(point: Points, normal: Points, edges: Points) -> bool:
    """Tell if a solid turns away from the fluid at the end of an edge with this normal."""
    others = edges.reshape(-1, 2, 2)
    ways = np.concatenate([others[:, k ^ 1][np.linalg.norm(others[:, k] - point, axis=1) < 1e-9] for k in (0, 1)])
    return bool(((ways - point) @ normal).min(initial=0.0) < -1e-9)


class Reached:
    """A test of where the fluid may flow around the end of a face: within the container, and not above all fluid.

    Images end with a face, and what is behind its end would pull the fluid around it: water at rest beside a box that
    hangs in it moved twice as fast as beside one of wall particles.
    """

    def __init__(self, scene: Scene, fluid: Points, support: float, table: SolidTable):
        self._scene, gravity = scene, np.array(scene.forces.gravity, dtype=np.float64)
        self._up = -gravity / np.linalg.norm(gravity) if gravity.any() and scene.emitter is None else None
        self._top = np.inf if self._up is None else float((fluid @ self._up).max()) + support
        shifts, turns = courses(table)
        times = np.zeros(1)
        if isinstance(shifts, Knots) or isinstance(turns, Knots):
            times = np.unique([time for knots in (shifts, turns) if isinstance(knots, Knots) for time in knots.times])
            times = np.unique(np.concatenate([times, 0.5 * (times[1:] + times[:-1])]))
        begun, angles = table.turn(2), np.reshape(turns.at(times), len(times))
        rotations = np.array([[np.cos(angles), -np.sin(angles)], [np.sin(angles), np.cos(angles)]]).transpose(2, 0, 1)
        self._turns, self._middles = rotations @ begun, table.middle() + shifts.at(times)

    def at(self, point: Points) -> bool:
        """Tell if fluid may come to a point (2,) of the solid's frame at some time of its path."""
        places = self._middles + self._turns @ point
        low = np.ones(len(places), dtype=bool) if self._up is None else places @ self._up < self._top
        within = self._scene.container.contains(places, -ON * self._scene.discretisation.spacing)
        return bool((low & within).any())
