"""The region open to particles: the container and solids in the form that solvers use. Solids are given by wall
particles, and by meshes for computing depths in solids. Flat faces of moving solids mirror the fluid
(`cortado.particles.mirrors`).

This module also has emitters and drains in the form that parts of a step use, and the places where their particles
rest.
"""

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
"""In spacings: the width of the mesh faces of round solids."""
HEIGHT = 100.0
"""Height over width of the mesh of a plane shape."""
DEEPEST, THINNEST = 1.0, 0.45
"""Depths in a solid, in spacings and as a part of its thickness, beyond which particles are lost. At sharp edges,
behind which there are few wall particles, some fluid particles enter by half a spacing."""
FURTHEST = 1e6
"""In spacings from the region of the first particles and walls: particles beyond are lost."""


@dataclass(frozen=True)
class Obstacle:
    """A solid, which particles cannot enter."""

    name: str
    solid: Solid
    is_hollow: bool
    """True if the fluid is inside of the shape."""
    thickness: float
    """Thickness of the solid's thinnest part [m]; infinite if it is unknown."""


@dataclass(frozen=True)
class NamedSolid:
    """A solid of a scene: the number that its wall particles have, and its middle at the start."""

    number: int
    """Number of its wall particles (`cortado.scene.motions.wall_numbers`)."""
    middle: NDArray
    """(3,) middle of the solid at the start [m]"""


@dataclass(frozen=True)
class Walled:
    """The places where particles may go: the region of the container and the solids in it."""

    region: Region
    """The container, without open sides: those across a periodic axis, and all sides if no pressure acts."""
    near: Region
    """A box around the first particles and the walls."""
    spacing: float
    """[m]"""
    solids: tuple[Obstacle, ...]
    """Solids at rest, in their places."""
    moving: tuple[Obstacle, ...]
    """Solids that move, each about its middle."""
    periods: Points
    """(d,) the lengths of the period [m], 0 for axes without one"""

    @property
    def dimension(self) -> int:
        """Return the number of dimensions, 2 or 3."""
        return len(self.near.lower)

    def tolerance(self, one: Obstacle) -> float:
        """Return how deep in a solid a particle may be [m]: a spacing, or 0.45 of a thin solid's thickness."""
        return min(DEEPEST * self.spacing, THINNEST * one.thickness)

    def furthest(self, precision: Precision) -> Region:
        """Return the box that positions must not leave [m]: a large box within which the precision resolves positions.
        Fluid spilled over the rim of an open cup may fall on inside it."""
        spilled, reach = np.isfinite(self.region.rim), FURTHEST * self.spacing
        limit = np.inf if spilled else precision.furthest * self.spacing
        return Region.between(np.maximum(self.near.lower - reach, -limit), np.minimum(self.near.upper + reach, limit))


def middle_of(one: Obstacle) -> Points:
    """Return the middle (d,) of the box around the shape of an obstacle [m]."""
    lower, upper = one.solid.extent()
    return np.asarray(0.5 * (lower + upper))


def obstacle_mesh(one: Obstacle, spacing: float, device: wp.Device) -> wp.Mesh:
    """Make the surface mesh of an obstacle about its middle; a plane shape becomes a prism of great height."""
    faces = one.solid.faces(FINE * spacing)
    faces = faces.reversed() if one.is_hollow else faces
    vertices, corners = faces.vertices - middle_of(one), faces.corners
    if vertices.shape[1] == 2:
        height = HEIGHT * (np.ptp(vertices) + spacing)
        low, high, count = (
            np.insert(vertices, 2, -height, axis=1),
            np.insert(vertices, 2, height, axis=1),
            len(vertices),
        )
        a, b = corners.T
        vertices = np.concatenate([low, high])
        corners = np.concatenate([np.stack([a, b, b + count], axis=1), np.stack([a, b + count, a + count], axis=1)])
    return wp.Mesh(
        points=wp.array(vertices, dtype=wp.vec3f, device=device),
        indices=wp.array(corners.ravel(), dtype=wp.int32, device=device),
        support_winding_number=True,
    )


def placed_sheets(scene: Scene) -> list[PlacedSheet]:
    """Return the sheets of a scene, with the numbers of their wall particles."""
    numbers, placed = wall_numbers(scene.solid), []
    for table in scene.solid:
        about = table.own_solid()
        if isinstance(about, Sheet):
            own = about if table.moves else about.placed(table.middle(), table.turn(scene.dimension))
            placed.append(PlacedSheet(numbers[table.name], own))
    return placed


LENGTH = 4.0
"""Length of the shortest face that mirrors, in support radii."""
ON = 1e-6
"""In spacings: a point nearer to a face than this is on the face."""


@dataclass(frozen=True)
class FlatFaces:
    """Flat faces of moving solids, in the frames of the solids."""

    solids: Numbers
    """(f,) numbers of the faces' solids"""
    places: Points
    """(f, 3) middles of the faces [m]"""
    frames: Points
    """(f, 3, 3) rows: the normal towards the fluid and two unit vectors along the face"""
    sizes: Points
    """(f, 3) 0, and half lengths along these two vectors [m]"""

    def behind(self, solid: Numbers, positions: Points, feet: Points, near: float) -> Numbers:
        """Return, for wall particles (b,), the number of the face that each is behind, or -1. The foot of a wall
        particle ends on a face if its end is nearer to the face than ``near`` [m]."""
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
    """Find the mirroring faces, at ``most`` so many, of a scene with a ``support`` radius [m]. They are long enough
    edges of boxes and polygons in the plane, and sides of boxes in space. Their solids have prescribed paths, and fluid
    slips freely along them. Other solvers, and scenes with periods, have no such faces."""
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
    """Yield the middle, the frame and half the size of each edge of a solid in the plane, as `FlatFaces` has them."""
    faces = solid.faces(spacing)
    for start, end in faces.vertices[faces.corners]:
        length = float(np.linalg.norm(end - start))
        x, y = (end - start) / length
        frame = np.array([[y, -x, 0.0], [x, y, 0.0], [0.0, 0.0, 1.0]])
        yield np.append(0.5 * (start + end), 0.0), frame, np.array([0.0, 0.5 * length, np.inf])


def _sides(solid: Solid) -> Iterator[tuple[Points, Points, Points]]:
    """Yield the middle, the frame and half the size of each of the six sides of a box in space; nothing for other
    solids."""
    box, outwards = (solid.cavity, -1.0) if isinstance(solid, Hollow) else (solid, 1.0)
    if isinstance(box, Box):
        for axis, sign in itertools.product(range(3), (-1.0, 1.0)):
            normal, *along = np.roll(np.eye(3), -axis, axis=0)
            frame = np.stack([outwards * sign * normal, *along])
            yield sign * box.half[axis] * normal, frame, np.append(0.0, np.stack(along) @ box.half)


def nozzles_of(scene: Scene, discrete: DiscreteScene) -> list[Nozzle]:
    """Return the emitters of a scene with their particles."""
    spacing, names = scene.discretisation.spacing, [None, *(drain.name for drain in scene.drain)]
    return [
        Nozzle(
            name=emitter.name,
            first=first,
            sample=sample,
            direction=np.array(emitter.direction),
            area=emitter.area(spacing),
            places=discrete.fluid.places,
            feeding=np.array([name in emitter.fed_by for name in names]),
        )
        for emitter, (_, first, sample) in zip(scene.emitter, discrete.fluid.emitters, strict=True)
    ]


def drained_of(scene: Scene, discrete: DiscreteScene, precision: Precision) -> Drained | None:
    """Return the drains of a scene; None for a scene without drains. Raises `InputError` if there is no place for the
    particles that drains remove."""
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
            f"The drains would store drained particles as far as {furthest:.3g} spacings of {spacing:g} m from the "
            "origin, "
            f"but must stay within {precision.furthest:g} in {precision.name}: take another precision."
        )
    return Drained(mouths, pulls, fluid.places, nozzles_of(scene, discrete), discrete.periods)
