"""Geometry of a scene for solvers: the container and the solids as meshes, and emitters and drains."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.device.precision import Precision
from cortado.discretise.primitives import Box
from cortado.discretise.room import Region
from cortado.discretise.shapes import Numbers, Points
from cortado.discretise.sheet import Sheet
from cortado.discretise.solid import Hollow, Solid
from cortado.errors import InputError
from cortado.particles.sheets import PlacedSheet
from cortado.scene.discrete_scene import DiscreteScene
from cortado.scene.drain_tables import BLENDED, PRESCRIBED, BoxDrain, PlaneDrain, open_sphere
from cortado.scene.motions import moving, wall_numbers
from cortado.scene.scene import Scene
from cortado.scene.solvers import ProjectionSolver
from cortado.sph.drains import BALL, BOX, PLANE, Drained, Mouth, Pull
from cortado.sph.emitter import Nozzle

FINE = 0.2
"""Width of the faces in meshes of round solids [spacings]."""
HEIGHT = 100.0
"""Ratio of height to width of the mesh of a 2-D shape."""
DEEPEST, THINNEST = 1.0, 0.45
"""Greatest depth of a particle in a solid: in spacings, and as a fraction of the solid's thickness."""
FURTHEST = 1e6
"""Greatest distance of a particle from the initial scene [spacings]."""


@dataclass(frozen=True)
class Obstacle:
    name: str
    solid: Solid
    is_hollow: bool
    thickness: float
    """Thickness of the thinnest part of the solid [m], or infinity for an unknown thickness."""


@dataclass(frozen=True)
class NamedSolid:
    number: int
    """Number of the solid from `cortado.scene.motions.wall_numbers`."""
    middle: NDArray
    """Vector of shape (3,) to the solid's middle at the start [m]."""


@dataclass(frozen=True)
class Walled:
    """The region where particles may be, inside the container and outside the solids."""

    region: Region
    """Region inside the container, unbounded along periodic axes. Without pressure, the region is the whole space."""
    near: Region
    spacing: float
    solids: tuple[Obstacle, ...]
    moving: tuple[Obstacle, ...]
    """Moving solids. The origin of each solid's frame is the middle of the solid."""
    periods: Points
    """Vector of shape (d,) with the lengths of the periodic box [m], 0 along an axis that is not periodic."""

    @property
    def dimension(self) -> int:
        return len(self.near.lower)

    def tolerance(self, one: Obstacle) -> float:
        """Return the greatest allowed depth of a particle in a solid [m]."""
        return min(DEEPEST * self.spacing, THINNEST * one.thickness)

    def furthest(self, precision: Precision) -> Region:
        """Return the largest allowed box of particle positions. A low ``precision`` may limit the box of positions."""
        spilled, reach = np.isfinite(self.region.rim), FURTHEST * self.spacing
        limit = np.inf if spilled else precision.furthest * self.spacing
        return Region.between(np.maximum(self.near.lower - reach, -limit), np.minimum(self.near.upper + reach, limit))


def middle_of(one: Obstacle) -> Points:
    lower, upper = one.solid.extent()
    return np.asarray(0.5 * (lower + upper))


def obstacle_mesh(one: Obstacle, spacing: float, device: wp.Device) -> wp.Mesh:
    """Make the surface mesh of an obstacle, with the obstacle's middle as origin. A 2-D shape has the mesh of a tall
    prism."""
    faces = one.solid.faces(FINE * spacing)
    faces = faces.reversed() if one.is_hollow else faces
    vertices, corners = faces.vertices - middle_of(one), faces.corners
    if vertices.shape[1] == 2:
        height = HEIGHT * (np.ptp(vertices) + spacing)
        (a, b), count = corners.T, len(vertices)
        vertices = np.concatenate([np.insert(vertices, 2, end, axis=1) for end in (-height, height)])
        corners = np.concatenate([np.stack([a, b, b + count], axis=1), np.stack([a, b + count, a + count], axis=1)])
    return wp.Mesh(
        points=wp.array(vertices, dtype=wp.vec3f, device=device),
        indices=wp.array(corners.ravel(), dtype=wp.int32, device=device),
        support_winding_number=True,
    )


def placed_sheets(scene: Scene) -> list[PlacedSheet]:
    numbers, placed = wall_numbers(scene.solid), []
    for table in scene.solid:
        about = table.own_solid()
        if isinstance(about, Sheet):
            own = about if table.moves else about.placed(table.middle(), table.turn(scene.dimension))
            placed.append(PlacedSheet(numbers[table.name], own))
    return placed


LENGTH = 4.0
"""Length of the shortest face that mirrors the fluid [support radii]."""
ON = 1e-6
"""Tolerance for points on a face [spacings]."""


@dataclass(frozen=True)
class FlatFaces:
    """Flat faces of moving solids that mirror the fluid."""

    solids: Numbers
    """Array of shape (f,) with the number of each face's solid."""
    places: Points
    """Array of shape (f, 3) with each face's middle in the frame of its solid [m]."""
    frames: Points
    """Matrices (f, 3, 3) with rows of unit vectors: the normal towards the fluid, and two vectors along the face."""
    sizes: Points
    """Array of shape (f, 3) with half of each face's lengths along the vectors in `frames` [m], 0 along the normal."""

    def behind(self, solid: Numbers, positions: Points, feet: Points, near: float) -> Numbers:
        """Return an array (b,) with the number of the face above each wall particle, or -1. ``near`` [m] is a
        tolerance."""
        found = np.full(len(solid), -1)
        for number, (place, frame, size) in enumerate(zip(self.places, self.frames, self.sizes, strict=True)):
            at, foot = (positions + feet - place) @ frame.T, feet @ frame.T
            on = (solid == self.solids[number]) & (np.abs(at) <= size + near).all(axis=1)
            found[on & (np.abs(foot[:, 1:]) <= near).all(axis=1) & (foot[:, 0] > 0.0)] = number
        return found


def flat_faces(scene: Scene, support: float, most: int) -> FlatFaces:
    """Return up to ``most`` faces that mirror the fluid (`docs/projection_step.md`). ``support`` is a radius [m]."""
    found = []
    if isinstance(scene.solver, ProjectionSolver) and not np.any(scene.container.periods(scene.dimension)[1]):
        for number, table in enumerate(moving(scene.solid)):
            if table.motion != "free" and not (table.sticks or table.is_sheet):
                solid = table.own_solid()
                flat = _edges(solid, scene.discretisation.spacing) if scene.dimension == 2 else _sides(solid)
                found += [(number, *face) for face in flat if (face[2][1:] >= 0.5 * LENGTH * support).all()]
    solids, places, frames, sizes = (np.array([face[k] for face in found[:most]]) for k in range(4))
    return FlatFaces(solids.astype(np.int32), places.reshape(-1, 3), frames.reshape(-1, 3, 3), sizes.reshape(-1, 3))


def _edges(solid: Solid, spacing: float) -> Iterator[tuple[Points, Points, Points]]:
    faces = solid.faces(spacing)
    for start, end in faces.vertices[faces.corners]:
        length = float(np.linalg.norm(end - start))
        x, y = (end - start) / length
        frame = np.array([[y, -x, 0.0], [x, y, 0.0], [0.0, 0.0, 1.0]])
        yield np.append(0.5 * (start + end), 0.0), frame, np.array([0.0, 0.5 * length, np.inf])


def _sides(solid: Solid) -> Iterator[tuple[Points, Points, Points]]:
    box, outwards = (solid.cavity, -1.0) if isinstance(solid, Hollow) else (solid, 1.0)
    if isinstance(box, Box):
        for axis, sign in itertools.product(range(3), (-1.0, 1.0)):
            normal, *along = np.roll(np.eye(3), -axis, axis=0)
            frame = np.stack([outwards * sign * normal, *along])
            yield sign * box.half[axis] * normal, frame, np.append(0.0, np.stack(along) @ box.half)


def nozzles_of(scene: Scene, discrete: DiscreteScene) -> list[Nozzle]:
    spacing, names = scene.discretisation.spacing, [None, *(drain.name for drain in scene.drain)]
    return [
        Nozzle(
            *(emitter.name, first, sample, np.array(emitter.direction), emitter.area(spacing), discrete.fluid.places),
            feeding=np.array([name in emitter.fed_by for name in names]),
        )
        for emitter, (_, first, sample) in zip(scene.emitter, discrete.fluid.emitters, strict=True)
    ]


def drained_of(scene: Scene, discrete: DiscreteScene, precision: Precision) -> Drained | None:
    """Raise `InputError` if the resting positions of removed particles are too far away for the precision."""
    if not scene.drain:
        return None
    fluid, d, spacing = discrete.fluid, scene.dimension, scene.discretisation.spacing
    mouths, pulls = [], {}
    for drain in scene.drain:
        if isinstance(drain, BoxDrain):
            mouths.append(Mouth(drain.name, BOX, drain.middle(d), drain.ends(d) - drain.middle(d)))
        elif isinstance(drain, PlaneDrain):
            mouths.append(Mouth(drain.name, PLANE, np.array(drain.position), np.array([drain.direction] * 2)))
        else:
            place, inner = np.array(drain.position), drain.inner(spacing)
            mouths.append(Mouth(drain.name, BALL, place, np.zeros((2, d)), inner))
            shell = inner + PRESCRIBED * spacing
            sphere = open_sphere(scene.resting_room, place, shell)
            ends = (shell, shell + BLENDED * spacing)
            pulls[drain.name] = Pull(ends, sphere, sphere * (shell / spacing) ** d / d)
    if (furthest := np.abs(fluid.places).max() / spacing) > precision.furthest:
        raise InputError(
            f"The drains would store particles {furthest:.3g} spacings of {spacing:g} m from the "
            f"origin, but at most {precision.furthest:g} are possible in {precision.name}: take another precision."
        )
    return Drained(mouths, pulls, fluid.places, nozzles_of(scene, discrete), discrete.periods)
