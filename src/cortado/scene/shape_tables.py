"""Tables of shapes that solids and bodies of fluid share, and tables of containers with their walls."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo, model_validator

from cortado.discretise.mesh import Mesh
from cortado.discretise.mesh_checks import FoundMesh
from cortado.discretise.mesh_files import mesh_in_file, thickness_of
from cortado.discretise.primitives import Box, HalfSpace, Polygon, Revolved, Round
from cortado.discretise.room import Domain, Region
from cortado.discretise.shapes import Points
from cortado.discretise.solid import Hollow, Placed, Solid
from cortado.discretise.walls import Places, box_places, box_walls, cup_places, cup_walls, short_box
from cortado.errors import Words
from cortado.scene.appearance import FINISHES, Finish
from cortado.scene.tables import Colour, FieldPath, Flag, Length, OneOf, Table, Text, Vector, field_error, quantity

INDEX_OF_AXIS = {"x": 0, "y": 1, "z": 2}
THIN = 2.5
"""Thickness of parts of meshes that do not count as sheets [spacings]."""


def check_order(lower: tuple[float, ...], upper: tuple[float, ...]) -> None:
    """Check that each component of ``upper`` is greater than that of ``lower``."""
    if len(lower) == len(upper) and any(b <= a for a, b in zip(lower, upper, strict=True)):
        raise field_error(("upper",), upper, f"greater than lower, {list(lower)}, in every component")


def _beside_scene(file: str, info: ValidationInfo) -> str:
    """Return the absolute path of a file; relative paths start at the scene file's folder."""
    folder = Path((info.context or {}).get("folder", "."))
    try:
        return str((folder / file).absolute())
    except (OSError, ValueError):
        raise field_error((), file, "the name of a file") from None


File = Annotated[Text, AfterValidator(_beside_scene)]


class BoxShape(Table):
    """A box, or a rectangle in 2-D."""

    shape: Literal["box"] = "box"
    lower: Vector[Length]
    """(d,) Corner with the least coordinates [m], before a rotation if the table has one."""
    upper: Vector[Length]
    """(d,) Corner with the greatest coordinates [m]."""

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        check_order(self.lower, self.upper)
        return self

    def shape_about(self) -> tuple[Solid, Points]:
        return Box(0.5 * np.subtract(self.upper, self.lower)), 0.5 * np.add(self.lower, self.upper)


class SphereShape(Table):
    """A sphere, or a disc in 2-D."""

    shape: Literal["sphere"] = "sphere"
    centre: Vector[Length]
    """(d,) Middle [m]."""
    radius: Annotated[float, quantity("m", gt=0.0)]
    """Distance from the middle to the surface [m]."""

    def shape_about(self) -> tuple[Solid, Points]:
        return Round(np.zeros(len(self.centre)), self.radius), np.array(self.centre)


class CylinderShape(Table):
    """A cylinder, in 3-D."""

    instead: ClassVar[str]
    """Names of corresponding shapes in 2-D."""
    shape: Literal["cylinder"] = "cylinder"
    base: Vector[Length]
    """(3,) Centre of the bottom [m]."""
    radius: Annotated[float, quantity("m", gt=0.0)]
    """Distance from the axis to the side [m]."""
    height: Annotated[float, quantity("m", gt=0.0)]
    """Length along the axis, from the base [m]."""
    axis: Literal["x", "y", "z"] = "y"
    """Axis of space along which the cylinder stands, before a rotation if the table has one."""

    @property
    def along(self) -> int:
        """Return the index of the axis."""
        return INDEX_OF_AXIS[self.axis]

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        if dimension == 2:
            raise field_error((*path, "shape"), "cylinder", f"{self.instead} in 2-D")
        return super().in_dimension(dimension, path)

    def shape_about(self) -> tuple[Solid, Points]:
        middle = np.array(self.base) + 0.5 * self.height * np.eye(3)[self.along]
        return Revolved(Box(np.array([self.radius, 0.5 * self.height])), self.along), middle


class PolygonShape(Table):
    """A polygon, in 2-D."""

    shape: Literal["polygon"] = "polygon"
    corners: Annotated[
        tuple[Annotated[tuple[Length, ...], Field(min_length=2, max_length=2)], ...], Field(min_length=3)
    ]
    """(m, 2) Corners in order along the boundary, clockwise or counterclockwise [m]."""

    @model_validator(mode="after")
    def _check_sides(self) -> Self:
        if crossing := _crossing(np.array(self.corners)):
            first, second = crossing
            wanted = f"corners of sides that do not cross, as sides {first} and {second} do"
            raise field_error(("corners",), self.corners, wanted)
        return self

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        if dimension == 3:
            others = '"box", "sphere", "capsule", "cylinder" or "cup" in 3-D'
            raise field_error((*path, "shape"), "polygon", others)
        return super().in_dimension(dimension, path)

    def shape_about(self) -> tuple[Solid, Points]:
        corners = np.array(self.corners)
        middle = Polygon(corners).moments().centre
        return Polygon(corners - middle), middle


class MeshShape(Table):
    """The inside of a mesh of triangles, in 3-D."""

    shape: Literal["mesh"] = "mesh"
    file: File
    """Name of an STL, OBJ, PLY, glTF or GLB file. A relative path starts at the scene file's folder."""
    scale: Annotated[float, quantity(gt=0.0)] = 1.0
    """Factor by which lengths are multiplied, such as 0.001 for millimetres."""

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        if dimension == 2:
            raise field_error((*path, "shape"), "mesh", '"box", "sphere", "capsule", "cup" or "polygon" in 2-D')
        return super().in_dimension(dimension, path)

    def shape_about(self) -> tuple[Solid, Points]:
        return _about_middle(mesh_in_file(self.file), self.scale)

    def thinnest_sheet(self, spacing: float) -> float:
        """Return the thickness of the thinnest sheet [m]; infinite if all are thicker than `THIN` spacings [m]."""
        return _thinnest_sheet(mesh_in_file(self.file), self.scale, THIN * spacing)


@lru_cache(maxsize=8)  # as a mesh builds a tree
def _about_middle(found: FoundMesh, scale: float) -> tuple[Mesh, Points]:
    middle = found.mesh.moments().centre
    return found.mesh.moved(scale, -scale * middle), scale * (found.origin + middle)


@lru_cache(maxsize=8)  # as this takes thousands of points
def _thinnest_sheet(found: FoundMesh, scale: float, reach: float) -> float:
    return thickness_of(_about_middle(found, scale)[0], reach).thinnest


def surface_cells(lower: Points, upper: Points, spacing: float) -> float:
    """Return the number of cells with this spacing [m] on the surface of a box with corners (d,) [m]."""
    cells = np.maximum((upper - lower) / spacing, 1.0)
    return float(2.0 * np.sum(np.prod(cells) / cells))


def _crossing(corners: Points) -> tuple[int, int] | None:
    """Return the indices of two sides of a polygon that cross or overlap, or twice that of a side without length."""
    count, sides = len(corners), np.roll(corners, -1, axis=0) - corners

    def turned(a: Points, b: Points) -> float:
        return float(a[0] * b[1] - a[1] * b[0])

    for first in range(count):
        if not sides[first].any():
            return first, first
        for second in range(first + 1, count):
            apart = corners[second] - corners[first]
            across = turned(sides[first], sides[second])
            if (second - first) in (1, count - 1):  # neighbours, which may only lie on each other
                if across == 0.0 and sides[first] @ sides[second] < 0.0:
                    return first, second
            elif across != 0.0:
                along = turned(apart, sides[second]) / across, turned(apart, sides[first]) / across
                if all(0.0 <= part <= 1.0 for part in along):
                    return first, second
    return None


class Container(Table):
    """A container of the fluid, of any shape; without other methods it is free space."""

    sticks: ClassVar[Any] = False
    finish: ClassVar[Any] = None
    """`Finish` of the walls; None without a material or colour."""

    def extent(self) -> tuple[Points, Points] | None:
        """Return the lower and the upper corner (d,) [m] of the box around the container; None without a container."""
        return None

    def region(self, dimension: int) -> Region:
        """Return the region for fluid, within one period."""
        return Region.everywhere(dimension)

    def contains(self, points: Points, tolerance: float) -> np.ndarray:
        """Return a mask (n,) of the points (n, d) [m] that are at most ``tolerance`` [m] outside."""
        return self.region(points.shape[1]).contains(points, tolerance)

    def walls(self, dimension: int, spacing: float, depth: float) -> Points:
        """Return one layer (b, d) of wall particles [m], ``depth`` [m] outside of the container."""
        return np.zeros((0, dimension))

    def places(self, dimension: int, spacing: float, reach: float) -> Places:
        """Return places for fluid less than ``reach`` [m] from a wall."""
        return Places.upright(np.zeros((0, dimension)))

    def shortened(self, spacing: float, support: float) -> "tuple[Container, Callable[[Points], Points]]":
        """Return a shorter container with equal weights of walls, for a spacing and a support [m]. Also return a
        function from points (b, d) [m] on these walls to points of equal weight on the shorter walls."""
        return self, lambda points: points

    def solids(self, dimension: int, reach: float) -> tuple[Solid, ...]:
        """Return the solids that form the container's walls, extended by ``reach`` [m] beyond the ends of a period."""
        return ()

    def wall_count(self, spacing: float) -> float:
        ends = self.extent()
        return 0.0 if ends is None else surface_cells(*ends, spacing)

    def periods(self, dimension: int) -> tuple[Points, Points]:
        """Return the start and the length of the period, each (d,) [m]; the length is 0 along other axes."""
        return np.zeros(dimension), np.zeros(dimension)

    def mirrors(self, dimension: int, support: float) -> tuple[Points, Points]:
        """Return the coordinates of flat walls that mirror the fluid, for a support [m]: at the lower and the upper end
        of each axis, each (d,) [m]; -inf or inf without a mirroring wall."""
        return np.full(dimension, -np.inf), np.full(dimension, np.inf)

    def domain(self, dimension: int) -> Domain:
        return Domain.of(*self.periods(dimension))


class NoContainer(Container):
    """Free space without a container."""

    shape: Literal["none"] = "none"


class Walled(Table):
    """Keys of a container's walls."""

    slip: Literal["free", "no"] = "free"
    """"no": the viscous force acts between fluid and wall; "free": it does not."""
    material: Annotated[str, OneOf(tuple(FINISHES))] | None = None
    """Look of the walls in pictures; clear glass if left out."""
    colour: Colour | None = None
    """(3,) Colour of the walls in pictures: red, green and blue, each from 0 to 1, in linear light. With a colour but
    without a material the walls are opaque."""

    @property
    def sticks(self) -> bool:
        return self.slip == "no"

    @property
    def finish(self) -> Finish | None:
        if self.material is None:
            return None if self.colour is None else Finish(self.colour)
        own = FINISHES[self.material]
        return own if self.colour is None else replace(own, colour=self.colour)


class BoxContainer(Walled, BoxShape, Container):
    """A container in the shape of a box, closed on all sides except along its periodic axes."""

    periodic: Vector[Flag] = (False, False, False)
    """(d,) Whether each axis is periodic: fluid that leaves on one side comes in on the other."""

    def extent(self) -> tuple[Points, Points]:
        return np.array(self.lower), np.array(self.upper)

    def region(self, dimension: int) -> Region:
        return Region.between(*self.extent())

    def solids(self, dimension: int, reach: float) -> tuple[Solid, ...]:
        (lower, upper), periodic = self.extent(), np.array(self.periodic)
        ends = lower - reach * periodic, upper + reach * periodic
        axes = np.eye(dimension)[~periodic]
        lowest = [HalfSpace(axis, float(lower @ axis), *ends) for axis in axes]
        return (*lowest, *(HalfSpace(-axis, -float(upper @ axis), *ends) for axis in axes))

    def shortened(self, spacing: float, support: float) -> tuple[Container, Callable[[Points], Points]]:
        upper, folded = short_box(*self.extent(), spacing, support)
        return self.model_copy(update={"upper": tuple(upper.tolist())}), folded

    def walls(self, dimension: int, spacing: float, depth: float) -> Points:
        return box_walls(*self.extent(), self.periodic, spacing, depth)

    def places(self, dimension: int, spacing: float, reach: float) -> Places:
        return box_places(*self.extent(), self.periodic, spacing, reach)

    def mirrors(self, dimension: int, support: float) -> tuple[Points, Points]:
        """Return the walls that mirror the fluid: not walls without slip, where mirrored fluid would distort the shear,
        nor walls of a very narrow box, where images would have images."""
        (lower, upper), periodic = self.extent(), np.array(self.periodic)
        if self.sticks or (upper - lower < support)[~periodic].any():
            return super().mirrors(dimension, support)
        return np.where(periodic, -np.inf, lower), np.where(periodic, np.inf, upper)

    def periods(self, dimension: int) -> tuple[Points, Points]:
        lower, upper = self.extent()
        return lower, np.where(self.periodic, upper - lower, 0.0)


class CylinderContainer(Walled, CylinderShape, Container):
    """A container in the shape of a cup, in 3-D."""

    instead: ClassVar = '"box" or "none"'
    lid: Flag = True
    """Whether the cup is closed at the top; without a lid, fluid may rise above the rim."""

    def extent(self) -> tuple[Points, Points]:
        axis = self.along
        lower, upper = np.array(self.base) - self.radius, np.array(self.base) + self.radius
        lower[axis], upper[axis] = self.base[axis], self.base[axis] + self.height
        return lower, upper

    def region(self, dimension: int) -> Region:
        axis = self.along
        closed = Region.cylinder(np.array(self.base), self.radius, self.height, axis)
        if self.lid:
            return closed
        is_along = np.arange(3) == axis
        return replace(closed, upper=np.where(is_along, np.inf, closed.upper), rim=float(closed.upper[axis]))

    def solids(self, dimension: int, reach: float) -> tuple[Solid, ...]:
        axis, height = self.along, self.height if self.lid else 2.0 * self.height
        profile = Box(np.array([self.radius, 0.5 * height]))
        middle = np.array(self.base) + 0.5 * height * np.eye(3)[axis]
        return (Hollow(Placed(Revolved(profile, axis), middle, np.eye(3))),)

    def walls(self, dimension: int, spacing: float, depth: float) -> Points:
        upright = cup_walls(self.radius, self.height, self.lid, spacing, depth)
        return self.base + np.roll(upright, self.along + 1, axis=1)

    def places(self, dimension: int, spacing: float, reach: float) -> Places:
        upright, turn = cup_places(self.radius, self.height, self.lid, spacing, reach), self.along + 1
        return Places(self.base + np.roll(upright.points, turn, axis=1), np.roll(upright.axes, turn, axis=2))


AnyContainer = Annotated[BoxContainer | CylinderContainer | NoContainer, Field(discriminator="shape")]


def check_length(container: Container, spacing: float, support_radius: float) -> None:
    """Check that a container is at least one spacing wide, and a period longer than two support radii, as the neighbour
    search considers only the nearest periodic image."""
    ends = container.extent()
    if ends is None:
        return
    lengths = ends[1] - ends[0]
    if lengths.min() < spacing * (1.0 - 1e-6):
        found = Words(f"only {lengths.min():g} m wide")
        raise field_error(("container",), found, f"at least one spacing, {spacing:g} m, wide")
    periods = container.periods(len(lengths))[1]
    short = (periods > 0.0) & (periods <= 2.0 * support_radius)
    if short.any():
        axis = int(np.argmax(short))
        reason = f"the {periods[axis]:g} m of this axis are not more than two support radii, {2.0 * support_radius:g} m"
        raise field_error(("container", "periodic", axis), True, f"false, as {reason}")
