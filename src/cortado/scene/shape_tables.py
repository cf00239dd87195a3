"""Tables of shapes for solids and bodies of fluid, and tables of containers."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from itertools import combinations_with_replacement
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
from cortado.scene.tables import Colour, Flag, Length, OneOf, Table, Text, Vector, field_error, quantity

INDEX_OF_AXIS = {"x": 0, "y": 1, "z": 2}
THIN = 2.5
"""Greatest thickness of a thin sheet in a mesh [spacings]."""


def _beside_scene(file: str, info: ValidationInfo) -> str:
    folder = Path((info.context or {}).get("folder", "."))
    try:
        return str((folder / file).absolute())
    except (OSError, ValueError):
        raise field_error((), file, "the name of a file") from None


File = Annotated[Text, AfterValidator(_beside_scene)]


class Ordered(Table):
    """A table with two corners. Each component of `lower` must be less than the same component of `upper`."""

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        own: Any = self
        lower, upper = own.lower or (), own.upper or ()
        if len(lower) == len(upper) and any(b <= a for a, b in zip(lower, upper, strict=True)):
            raise field_error(("upper",), upper, f"greater than lower, {list(lower)}, in every component")
        return self


class BoxShape(Ordered):
    """A box, or a rectangle in 2-D."""

    shape: Literal["box"] = "box"
    lower: Vector[Length]
    """(d,) Corner with the smallest coordinates [m], before a rotation."""
    upper: Vector[Length]
    """(d,) Corner with the greatest coordinates [m], before a rotation."""

    def shape_about(self) -> tuple[Solid, Points]:
        return Box(0.5 * np.subtract(self.upper, self.lower)), 0.5 * np.add(self.lower, self.upper)


class SphereShape(Table):
    """A sphere, or a disc in 2-D."""

    shape: Literal["sphere"] = "sphere"
    centre: Vector[Length]
    """(d,) Centre of the sphere or disc [m]."""
    radius: Annotated[float, quantity("m", gt=0.0)]
    """Radius of the sphere or disc [m]."""

    def shape_about(self) -> tuple[Solid, Points]:
        return Round(np.zeros(len(self.centre)), self.radius), np.array(self.centre)


class CylinderShape(Table):
    """A cylinder, in 3-D."""

    shape: Literal["cylinder"] = "cylinder"
    base: Vector[Length]
    """(3,) Centre of the bottom [m]."""
    radius: Annotated[float, quantity("m", gt=0.0)]
    """Distance from the axis to the side [m]."""
    height: Annotated[float, quantity("m", gt=0.0)]
    """Length along the axis, from the base [m]."""
    axis: Literal["x", "y", "z"] = "y"
    """Coordinate axis parallel to the cylinder's axis, before a rotation."""

    @property
    def along(self) -> int:
        return INDEX_OF_AXIS[self.axis]

    def shape_about(self) -> tuple[Solid, Points]:
        middle = np.array(self.base) + 0.5 * self.height * np.eye(3)[self.along]
        return Revolved(Box(np.array([self.radius, 0.5 * self.height])), self.along), middle


class PolygonShape(Table):
    """A polygon, in 2-D."""

    _instead: ClassVar = {3: '"box", "sphere", "capsule", "cylinder" or "cup"'}
    shape: Literal["polygon"] = "polygon"
    corners: Annotated[
        tuple[Annotated[tuple[Length, ...], Field(min_length=2, max_length=2)], ...], Field(min_length=3)
    ]
    """(m, 2) Corners in order along the boundary, clockwise or counterclockwise [m]."""

    @model_validator(mode="after")
    def _check_sides(self) -> Self:
        if crossing := _crossing(np.array(self.corners)):
            wanted = "corners of sides that do not cross, as sides {} and {} do".format(*crossing)
            raise field_error(("corners",), self.corners, wanted)
        return self

    def shape_about(self) -> tuple[Solid, Points]:
        corners = np.array(self.corners)
        middle = Polygon(corners).moments().centre
        return Polygon(corners - middle), middle


class MeshShape(Table):
    """The inside of a mesh of triangles, in 3-D."""

    _instead: ClassVar = {2: '"box", "sphere", "capsule", "cup" or "polygon"'}
    shape: Literal["mesh"] = "mesh"
    file: File
    """Name of an STL, OBJ, PLY, glTF or GLB file. A relative path starts at the scene file's folder."""
    scale: Annotated[float, quantity(gt=0.0)] = 1.0
    """Factor that converts lengths in the file to metres, such as 0.001 for millimetres."""

    def shape_about(self) -> tuple[Mesh, Points]:
        return _about_middle(mesh_in_file(self.file), self.scale)

    def thinnest(self, spacing: float) -> float:
        return _thickness(self.shape_about()[0], THIN * spacing)


@lru_cache(maxsize=8)  # as this takes thousands of points
def _thickness(mesh: Mesh, reach: float) -> float:
    return thickness_of(mesh, reach).thinnest


@lru_cache(maxsize=8)  # as a mesh builds a tree
def _about_middle(found: FoundMesh, scale: float) -> tuple[Mesh, Points]:
    middle = found.mesh.moments().centre
    return found.mesh.moved(scale, -scale * middle), scale * (found.origin + middle)


def surface_cells(lower: Points, upper: Points, spacing: float) -> float:
    """Return the number of cells of width ``spacing`` [m] on the surface of a box with corners (d,) [m]."""
    cells = np.maximum((upper - lower) / spacing, 1.0)
    return float(2.0 * np.sum(np.prod(cells) / cells))


def _crossing(corners: Points) -> tuple[int, int] | None:
    """Return the indices of two crossing sides of a polygon, or twice the index of a side without length."""
    count, sides = len(corners), np.roll(corners, -1, axis=0) - corners

    def turned(a: Points, b: Points) -> float:
        return float(a[0] * b[1] - a[1] * b[0])

    for first, second in combinations_with_replacement(range(count), 2):
        one, other, apart = sides[first], sides[second], corners[second] - corners[first]
        across = turned(one, other)
        if first == second:
            crosses = not one.any()
        elif second - first in (1, count - 1):  # neighbours, which may only lie on each other
            crosses = across == 0.0 and one @ other < 0.0
        else:
            along = (turned(apart, side) / across for side in (other, one))
            crosses = across != 0.0 and all(0.0 <= part <= 1.0 for part in along)
        if crosses:
            return first, second
    return None


class Container(Table):
    """A container of the fluid. The base class of containers is free space."""

    sticks: ClassVar[Any] = False
    finish: ClassVar[Any] = None
    """Appearance of the walls in pictures; None for the default appearance."""

    def extent(self) -> tuple[Points, Points] | None:
        """Return the lower and the upper corner (d,) [m] of the bounding box; None for free space."""
        return None

    def region(self, dimension: int) -> Region:
        return Region.everywhere(dimension)

    def contains(self, points: Points, tolerance: float) -> np.ndarray:
        return self.region(points.shape[1]).contains(points, tolerance)

    def walls(self, dimension: int, spacing: float, depth: float) -> Points:
        """Return the positions (b, d) [m] of a layer of wall particles, ``depth`` [m] outside the container."""
        return np.zeros((0, dimension))

    def places(self, dimension: int, spacing: float, reach: float) -> Places:
        """Return points where fluid may rest, at distances less than ``reach`` [m] from a wall."""
        return Places.upright(np.zeros((0, dimension)))

    def shortened(self, spacing: float, support: float) -> "tuple[Container, Callable[[Points], Points]]":
        """Return a shorter container with wall particles of the same weights. Also return a function that maps points
        (b, d) [m] on the walls of this container to the walls of the shorter container."""
        return self, lambda points: points

    def solids(self, dimension: int, reach: float) -> tuple[Solid, ...]:
        """Return the solids that form the walls. At periodic ends the solids are extended by ``reach`` [m]."""
        return ()

    def wall_count(self, spacing: float) -> float:
        ends = self.extent()
        return 0.0 if ends is None else surface_cells(*ends, spacing)

    def periods(self, dimension: int) -> tuple[Points, Points]:
        """Return the lower corner and the lengths (d,) [m] of the periodic box. Non-periodic axes have the length 0."""
        return np.zeros(dimension), np.zeros(dimension)

    def mirrors(self, dimension: int, support: float) -> tuple[Points, Points]:
        """Return the coordinates of the lower and the upper flat walls that mirror the fluid, (d,) [m]. A coordinate is
        infinite if no wall mirrors."""
        return np.full(dimension, -np.inf), np.full(dimension, np.inf)

    def domain(self, dimension: int) -> Domain:
        return Domain.of(*self.periods(dimension))


class NoContainer(Container):
    """Free space without a container."""

    shape: Literal["none"] = "none"


class Walled(Table):
    """Keys for the walls of a container."""

    slip: Literal["free", "no"] = "free"
    """"no" for no-slip walls; "free" for walls without viscous force."""
    material: Annotated[str, OneOf(tuple(FINISHES))] | None = None
    """Material of the walls in pictures; clear glass if left out."""
    colour: Colour | None = None
    """(3,) Colour of the walls in pictures: red, green and blue from 0 to 1, in linear light. Walls with a colour but
    without a material are opaque."""

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
    """A box-shaped container. The container is closed on all sides except along periodic axes."""

    periodic: Vector[Flag] = (False, False, False)
    """(d,) Whether each axis is periodic. Fluid that leaves through one side of a periodic axis enters through the
    opposite side."""

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
        """No-slip walls and walls of a very narrow box do not mirror the fluid."""
        (lower, upper), periodic = self.extent(), np.array(self.periodic)
        if self.sticks or (upper - lower < support)[~periodic].any():
            return super().mirrors(dimension, support)
        return np.where(periodic, -np.inf, lower), np.where(periodic, np.inf, upper)

    def periods(self, dimension: int) -> tuple[Points, Points]:
        lower, upper = self.extent()
        return lower, np.where(self.periodic, upper - lower, 0.0)


class CylinderContainer(Walled, CylinderShape, Container):
    """A cylindrical container, with or without a lid, in 3-D."""

    _instead: ClassVar = {2: '"box" or "none"'}
    lid: Flag = True
    """Whether the cylinder is closed at the top. Without a lid, fluid may rise above the rim."""

    def extent(self) -> tuple[Points, Points]:
        axis = self.along
        lower, upper = np.array(self.base) - self.radius, np.array(self.base) + self.radius
        lower[axis], upper[axis] = self.base[axis], self.base[axis] + self.height
        return lower, upper

    def region(self, dimension: int) -> Region:
        closed = Region.cylinder(np.array(self.base), self.radius, self.height, self.along)
        if self.lid:
            return closed
        upper = np.where(np.arange(3) == self.along, np.inf, closed.upper)
        return replace(closed, upper=upper, rim=float(closed.upper[self.along]))

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
    ends = container.extent()
    if ends is None:
        return
    lengths = ends[1] - ends[0]
    if lengths.min() < spacing * (1.0 - 1e-6):
        wanted = f"at least one spacing, {spacing:g} m, wide"
        raise field_error(("container",), Words(f"only {lengths.min():g} m wide"), wanted)
    periods = container.periods(len(lengths))[1]
    short = (periods > 0.0) & (periods <= 2.0 * support_radius)
    if short.any():
        axis = int(np.argmax(short))
        reason = f"the {periods[axis]:g} m of this axis are not more than two support radii, {2.0 * support_radius:g} m"
        raise field_error(("container", "periodic", axis), True, f"false, as {reason}")
