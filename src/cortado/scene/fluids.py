"""Bodies of fluid with various shapes, and their particles."""

from abc import abstractmethod
from dataclasses import replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from cortado.discretise.primitives import block_around, points_inside
from cortado.discretise.room import Region, Room
from cortado.discretise.shapes import ROUND_OFF, Block, Points, block_about, block_filling, grid
from cortado.discretise.solid import Placed, Solid, rotation_matrix
from cortado.scene.point_files import read_points
from cortado.scene.shape_tables import BoxShape, CylinderShape, File, MeshShape, PolygonShape, SphereShape
from cortado.scene.tables import Angle, Length, OnAxes, Table, Text, Turns, Vector, quantity

ALIGNED = 1e-3
"""Tolerance for a surface along faces of lattice cells [spacings]."""


class FluidBody(Table):
    """Base of tables that create particles of one phase: bodies of fluid and emitters."""

    phase: Text
    """Name of the phase."""

    @abstractmethod
    def count(self, spacing: float) -> float:
        """Return an upper bound on the number of particles, without creating them."""

    @abstractmethod
    def extent(self, spacing: float) -> tuple[Points, Points]:
        """Return the lower and the upper corner (d,) [m] of a box around all particles."""

    @abstractmethod
    def particles(self, spacing: float) -> Points: ...


class Fluid(FluidBody):
    """A body of fluid."""

    velocity: Vector[Annotated[float, quantity("m/s")]] = (0.0, 0.0, 0.0)
    """(d,) Initial velocity [m/s]."""
    angular_velocity: Turns[Annotated[float, quantity("rad/s")]] = None
    """Initial angular velocity about the middle of the body [rad/s]; no rotation if left out. The value is a vector in
    3-D, and one number in 2-D, positive counterclockwise."""

    def velocities(self, points: Points) -> Points:
        found = np.tile(np.array(self.velocity, dtype=np.float64), (len(points), 1))
        if self.angular_velocity is None:
            return found
        arms = points - points.mean(axis=0)
        if len(self.angular_velocity) == 1:
            return found + self.angular_velocity[0] * np.stack([-arms[:, 1], arms[:, 0]], axis=1)
        return found + np.cross(self.angular_velocity, arms)

    def greatest_speed(self, spacing: float) -> float:
        spin = np.linalg.norm(self.angular_velocity or 0.0)
        lower, upper = self.extent(spacing) if spin else (np.zeros(1), np.zeros(1))
        return float(np.linalg.norm(self.velocity) + 0.5 * spin * np.linalg.norm(upper - lower))

    def particles_in(self, room: Room, spacing: float) -> Points:
        return self.particles(spacing)

    @abstractmethod
    def volume(self, spacing: float) -> float: ...


class RegionFluid(Fluid):
    @abstractmethod
    def block(self, spacing: float) -> Block: ...

    @abstractmethod
    def shape_about(self) -> tuple[Solid, Points]:
        """Return the unrotated shape with its centroid at the origin, and the position of the centroid (d,) [m]."""

    def volume(self, spacing: float) -> float:
        return self.shape_about()[0].moments().volume

    def count(self, spacing: float) -> float:
        return self.block(spacing).size

    def extent(self, spacing: float) -> tuple[Points, Points]:
        return self.block(spacing).extent

    def particles(self, spacing: float) -> Points:
        return self.block(spacing).points()

    def particles_in(self, room: Room, spacing: float) -> Points:
        """Return the particles (n, d) [m] that are at least half a spacing from the walls of ``room``."""
        everything = self.particles(spacing)
        return everything[room.contains(everything, (ROUND_OFF - 0.5) * self.block(spacing).spacings.min())]

    @abstractmethod
    def distance(self, points: Points, spacing: float, reach: float = np.inf) -> Points:
        """Return signed distances (n,) [m] of points (n, d) [m] from the fluid, negative inside. Returned distances
        greater than ``reach`` [m] are only lower bounds."""

    def cuts_cells(self, spacing: float) -> bool:
        return False

    def lattice(self, spacing: float, reach: float) -> Points:
        """Return the lattice points (n, d) [m] in a box that extends ``reach`` [m] beyond the shape."""
        return self.block(spacing).grown(int(np.ceil(reach / spacing))).points()


class Turnable(RegionFluid):
    """Base of bodies of fluid that may be rotated. The particles of a rotated body are packed."""

    rotation: Turns[Angle] = None
    """Rotation about the middle of the body [rad]; no rotation if left out. The value is a rotation vector in 3-D, and
    one number in 2-D, positive counterclockwise."""


class BoxFluid(BoxShape, Turnable):
    """A box of fluid. Particles are at ``lower + (i + 1/2) spacing``. In a rotated box, particles are packed.

    If a side is no multiple of the spacing, the lattice is stretched or compressed by up to 3 %. The mass of the
    stretched lattice is right within 0.3 %. If no such lattice fits, the particles are packed, and the mass is up to
    0.8 % too small. `describe` and a run then print the prescribed and the actual mass.
    """

    def block(self, spacing: float) -> Block:
        return block_filling(self.lower, self.upper, spacing)

    def cuts_cells(self, spacing: float) -> bool:
        lattice, sides = self.block(spacing), np.subtract(self.upper, self.lower)
        return bool((np.abs(lattice.counts * lattice.spacings - sides) > ROUND_OFF * spacing).any())

    def distance(self, points: Points, spacing: float, reach: float = np.inf) -> Points:
        if self.cuts_cells(spacing):
            return Region.between(np.array(self.lower), np.array(self.upper)).distance(points)
        lattice = self.block(spacing)
        (first, last), half = lattice.extent, 0.5 * lattice.spacings
        return Region.between(first - half, last + half).distance(points)


class RoundFluid(RegionFluid):
    """Base of bodies of fluid with a curved surface. The particles are packed before a run."""

    def particles(self, spacing: float) -> Points:
        points = self.block(spacing).points()
        return points[self.distance(points, spacing, spacing) <= 0.0]

    def cuts_cells(self, spacing: float) -> bool:
        return True


class SphereFluid(SphereShape, RoundFluid):
    """A sphere of fluid, or a disc in 2-D."""

    def block(self, spacing: float) -> Block:
        return block_about(self.centre, np.full(len(self.centre), self.radius), spacing)

    def distance(self, points: Points, spacing: float, reach: float = np.inf) -> Points:
        return Region.ball(np.array(self.centre), self.radius).distance(points)


class CylinderFluid(CylinderShape, Turnable, RoundFluid):
    """A cylinder of fluid, in 3-D."""

    _instead: ClassVar = {2: '"box", "sphere" or "points"'}

    def block(self, spacing: float) -> Block:
        base, along = np.array(self.base), np.arange(3) == self.along
        block = block_about(base, np.where(along, 0.5 * self.height, self.radius), spacing)
        return replace(block, first=np.where(along, base + 0.5 * spacing, block.first))

    def volume(self, spacing: float) -> float:
        return float(np.pi * self.radius**2 * self.height)

    def distance(self, points: Points, spacing: float, reach: float = np.inf) -> Points:
        return Region.cylinder(np.array(self.base), self.radius, self.height, self.along).distance(points)

    def lattice(self, spacing: float, reach: float) -> Points:
        layers = max(round(self.height / spacing), 1)
        along = self.height / layers
        across = np.sqrt(spacing**3 / along)
        axis, base, cells = self.along, np.array(self.base), int(np.ceil(reach / min(along, across)))
        round_it = block_about(np.zeros(1), [self.radius], across).grown(cells).points()[:, 0]
        axes = [centre + round_it for centre in base]
        axes[axis] = base[axis] + along * (np.arange(-cells, layers + cells) + 0.5)
        return grid(axes)


class PointsFluid(Fluid):
    """Fluid particles at the positions in a file."""

    shape: Literal["points"] = "points"
    file: File
    """A file of positions (n, d) [m]: .npy, .vtk, .vtp or .vtkhdf. Only the first time step is read. A relative path
    starts at the scene file's folder."""

    def points(self) -> Points:
        return read_points(self.file, len(self.velocity))

    def count(self, spacing: float) -> float:
        return float(len(self.points()))

    def volume(self, spacing: float) -> float:
        return self.count(spacing) * spacing ** len(self.velocity)

    def extent(self, spacing: float) -> tuple[Points, Points]:
        return self.points().min(axis=0), self.points().max(axis=0)

    def particles(self, spacing: float) -> Points:
        return self.points().copy()


class Filled(Turnable):
    """Base of bodies of fluid that fill a solid shape with packed particles. If the shape is aligned with the lattice,
    the particles stay on the lattice."""

    def body(self) -> Placed:
        shape, middle = self.shape_about()
        return Placed(shape, middle, rotation_matrix(self.rotation or (0.0,) * (2 * len(middle) - 3)))

    def block(self, spacing: float) -> Block:
        return block_around(self.body(), spacing)

    def distance(self, points: Points, spacing: float, reach: float = np.inf) -> Points:
        return self.body().distance_up_to(points, reach)

    def particles(self, spacing: float) -> Points:
        return points_inside(self.body(), spacing)

    def lattice(self, spacing: float, reach: float) -> Points:
        return RegionFluid.lattice(self, spacing, reach)

    def cuts_cells(self, spacing: float) -> bool:
        points = self.block(spacing).grown(1).points()
        return bool((np.abs(self.distance(points, spacing, spacing)) < (0.5 - ALIGNED) * spacing).any())


class FilledShape(Filled):
    """Base of bodies of fluid with a general shape and an optional position."""

    position: OnAxes[Length] = None
    """(d,) Position of the centroid [m]; if left out, the coordinates of the shape's corners or mesh determine it."""

    def body(self) -> Placed:
        placed = super().body()
        return placed if self.position is None else replace(placed, position=np.array(self.position))


class TurnedBox(Filled, BoxFluid):
    shape_about = BoxShape.shape_about


class TurnedCylinder(Filled, CylinderFluid):
    shape_about = CylinderShape.shape_about


def turned(fluid: Fluid) -> Fluid:
    """Return a rotated box or cylinder as a body that is packed, and any other body unchanged."""
    kinds: dict[type[Fluid], type[Filled]] = {BoxFluid: TurnedBox, CylinderFluid: TurnedCylinder}
    kind = kinds.get(type(fluid))
    if kind is None or not isinstance(fluid, Turnable) or fluid.rotation is None:
        return fluid
    return kind.model_construct(fluid.model_fields_set, **dict(fluid))


class PolygonFluid(PolygonShape, FilledShape):
    """A body of fluid inside a polygon, in 2-D."""


class MeshFluid(MeshShape, FilledShape):
    """A body of fluid inside a mesh of triangles, in 3-D."""


AnyFluid = Annotated[
    BoxFluid | CylinderFluid | SphereFluid | PointsFluid | MeshFluid | PolygonFluid, Field(discriminator="shape")
]
