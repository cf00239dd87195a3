"""Shapes of solids."""

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from cortado.arrays import unit
from cortado.discretise.mesh_files import MOST_BYTES, triangles_in_file
from cortado.discretise.primitives import HalfSpace, Polygon, Revolved, Round
from cortado.discretise.shapes import Points
from cortado.discretise.sheet import Sheet, Thickened
from cortado.discretise.solid import Solid
from cortado.errors import InputError, Words
from cortado.files.disk import cached_by_file
from cortado.scene.shape_tables import BoxShape, Container, CylinderShape, File, MeshShape, PolygonShape, SphereShape
from cortado.scene.solids import SolidTable
from cortado.scene.tables import MISSING, Direction, FieldPath, Length, Vector, field_error, quantity, usable_file

ALONG = 1e-9


class PlaneSolid(SolidTable):
    """The half space behind a plane at rest, such as a slope or a wall. A scene with a plane needs a container."""

    shape: Literal["plane"] = "plane"
    position: Vector[Length]
    """(d,) A point of the plane [m]."""
    normal: Direction
    """(d,) Normal that points from the plane into the fluid; its length has no effect."""
    _ends: tuple[tuple[float, ...], ...] | None = PrivateAttr(None)

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        turned = super().in_dimension(dimension, path)
        if self.side == "inside":
            raise field_error((*path, "side"), self.side, '"outside": fluid is where the normal of a plane points')
        if self.rotation is not None:
            raise field_error((*path, "rotation"), self.rotation, "left out, as normal says how a plane is turned")
        for name in ("motion", "surface_velocity"):
            if (value := getattr(self, name)) not in ("fixed", None):
                raise field_error((*path, name), value, 'left out, as a plane is at rest; a "box" may move')
        return turned

    def in_container(self, container: Container, path: FieldPath) -> Self:
        ends, dimension = container.extent(), len(self.position)
        if ends is None:
            wanted = "another one in a scene without a container, as a plane has no end: give it a [container] to cut"
            raise field_error((*path, "shape"), self.shape, f'{wanted}, or take a "box"')
        along = (container.periods(dimension)[1] > 0.0) & (np.abs(self._unit()) > ALONG)
        if along.any():
            where = f"0 along axis {int(np.argmax(along))}, where the container is periodic"
            raise field_error((*path, "normal"), self.normal, f"{where} and the plane would not meet itself")
        corners = np.where(self._unit() > 0.0, *ends) - np.array(self.position)
        if corners @ self._unit() >= 0.0:
            found = Words("outside of the container, all of which is in front of it")
            raise field_error((*path, "position"), found, "such that the plane cuts the container")
        bounded = self.model_copy()
        object.__setattr__(bounded, "__pydantic_private__", {"_ends": tuple(map(tuple, np.array(ends).tolist()))})
        return bounded

    def shape_about(self) -> tuple[Solid, Points]:
        position, unit = np.array(self.position), self._unit()
        lower, upper = np.array(self._ends or (position - 1.0, position + 1.0))
        return HalfSpace(unit, 0.0, lower - position, upper - position), position

    def _unit(self) -> Points:
        return unit(np.array(self.normal))


Size = Annotated[float, quantity("m", gt=0.0)]


class BoxSolid(BoxShape, SolidTable):
    """A solid box, or a rectangle in 2-D."""

    measures: ClassVar = ("lower", "upper")

    def thinnest(self, spacing: float) -> float:
        return float(np.subtract(self.upper, self.lower).min())


class SphereSolid(SphereShape, SolidTable):
    """A solid sphere, or a disc in 2-D."""

    measures: ClassVar = ("centre", "radius")

    def thinnest(self, spacing: float) -> float:
        return 2.0 * self.radius


class CapsuleSolid(SolidTable):
    """A solid capsule: a cylinder with two hemispheres as ends."""

    measures: ClassVar = ("start", "end", "radius")
    shape: Literal["capsule"] = "capsule"
    start: Vector[Length]
    """(d,) Start of the capsule's axis [m]."""
    end: Vector[Length]
    """(d,) End of the capsule's axis [m]."""
    radius: Size
    """Distance from the axis to the surface [m]."""

    def shape_about(self) -> tuple[Solid, Points]:
        start, end = np.array(self.start), np.array(self.end)
        return Round(0.5 * (end - start), self.radius), 0.5 * (start + end)

    def thinnest(self, spacing: float) -> float:
        return 2.0 * self.radius


class CylinderSolid(CylinderShape, SolidTable):
    """A solid cylinder, in 3-D."""

    measures: ClassVar = ("base", "radius", "height")
    _instead: ClassVar = {2: '"box", "sphere", "capsule", "cup" or "polygon"'}

    def thinnest(self, spacing: float) -> float:
        return min(2.0 * self.radius, self.height)


class CupSolid(SolidTable):
    """A cup that is open at the top; in 2-D its cross-section through the axis."""

    measures: ClassVar = ("base", "radius", "height", "thickness")
    shape: Literal["cup"] = "cup"
    base: Vector[Length]
    """(d,) Centre of the outer side of the bottom [m]."""
    radius: Size
    """Inner radius: distance from the axis to the inner side [m]."""
    height: Size
    """Outer height: distance from the outer side of the bottom to the rim [m]."""
    thickness: Size
    """Thickness of the side and the bottom [m]."""
    axis: Literal["x", "y", "z"] = "y"
    """Coordinate axis parallel to the cup's axis, before a rotation. In 2-D the axis is y."""

    @model_validator(mode="after")
    def _check_height(self) -> Self:
        if self.thickness >= self.height:
            raise field_error(("thickness",), self.thickness, f"less than height, {self.height:g}")
        return self

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        if dimension == 2 and self.axis != "y":
            raise field_error((*path, "axis"), self.axis, '"y" in 2-D')
        return super().in_dimension(dimension, path)

    def shape_about(self) -> tuple[Solid, Points]:
        dimension, middle, along = len(self.base), self._middle(), "xyz".index(self.axis)
        outside, rim, bottom = self.radius + self.thickness, self.height - middle, self.thickness - middle
        half = [(outside, -middle), (outside, rim), (self.radius, rim), (self.radius, bottom)]
        profile = Polygon(np.array([*half, *((-x, y) for x, y in half[::-1])]))
        shape = profile if dimension == 2 else Revolved(profile, along)
        return shape, np.array(self.base) + middle * np.eye(dimension)[along]

    def thinnest(self, spacing: float) -> float:
        return self.thickness

    def _middle(self) -> float:
        power = len(self.base) - 1
        solid, hollow = (self.radius + self.thickness) ** power, self.radius**power
        whole, cavity = solid * self.height, hollow * (self.height - self.thickness)
        moment = 0.5 * whole * self.height - 0.5 * cavity * (self.height + self.thickness)
        return moment / (whole - cavity)


class PolygonSolid(PolygonShape, SolidTable):
    """A solid polygon, in 2-D."""

    measures: ClassVar = ("corners",)
    least_thickness: ClassVar = 0.5

    def thinnest(self, spacing: float) -> float:
        return Polygon(np.array(self.corners)).thinnest()


class MeshSolid(MeshShape, SolidTable):
    """A solid inside a mesh of triangles, in 3-D."""

    measures: ClassVar = ("scale",)
    least_thickness: ClassVar = 0.5


FLAT = 1e-6
"""Greatest distance of a flat sheet's corners from a plane, relative to the size of the sheet."""


class SheetSolid(SolidTable):
    """A wall without thickness that separates the fluids on its two sides. In 2-D a sheet is a line of straight
    segments. In 3-D a sheet is a flat convex polygon, or an open mesh from a file."""

    measures: ClassVar = ("scale",)
    least_thickness: ClassVar = 0.0
    is_sheet: ClassVar = True
    shape: Literal["sheet"] = "sheet"
    corners: Annotated[
        tuple[Annotated[tuple[Length, ...], Field(min_length=2, max_length=3)], ...] | None, Field(min_length=2)
    ] = None
    """(m, d) Corners in order [m]. In 2-D the corners follow the line, and the last corner may equal the first. In 3-D
    the corners are in order around the polygon."""
    file: File | None = None
    """File of a mesh in 3-D, in place of `corners`: STL, OBJ, PLY, glTF or GLB. The sheet's mesh may be open. A
    relative path starts at the scene file's folder."""
    scale: Annotated[float, quantity(gt=0.0)] = 1.0
    """Factor that converts lengths in the file to metres, such as 0.001 for millimetres."""

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        turned = super().in_dimension(dimension, path)
        for name, usual in (("side", "outside"), ("surface_velocity", None)):
            if (value := getattr(self, name)) != usual:
                raise field_error((*path, name), value, "left out, as a sheet has fluid on both sides")
        if self.motion == "free":
            raise field_error((*path, "motion"), "free", '"fixed" or "path", as a sheet has no mass')
        if (self.corners is None) == (self.file is None):
            found = MISSING if self.file is None else Words("given")
            raise field_error((*path, "corners"), found, "a list of corners, or a file in its place")
        if self.file is None:
            self._check_corners(dimension, path)
            return turned
        if dimension == 2:
            raise field_error((*path, "file"), self.file, "left out in 2-D, where corners say where a sheet is")
        with usable_file((*path, "file"), self.file, "a file of a mesh"):
            _sheet_in(self.file)
        return turned

    def shape_about(self) -> tuple[Solid, Points]:
        found = _sheet_in(self.file) if self.corners is None else Sheet.along(np.array(self.corners))
        middle = found.centroid()
        return Sheet(self.scale * (found.vertices - middle), found.corners), self.scale * middle

    def shown_shape(self, spacing: float) -> Solid:
        about = self.shape_about()[0]
        assert isinstance(about, Sheet)
        return Thickened(about, 0.1 * spacing)

    def _check_corners(self, dimension: int, path: FieldPath) -> None:
        assert self.corners is not None
        for index, corner in enumerate(self.corners):
            if len(corner) != dimension:
                raise field_error((*path, "corners", index), corner, f"a list of {dimension} coordinates")
            if corner == self.corners[index - 1] and (index > 0 or dimension == 3):
                raise field_error((*path, "corners", index), corner, "different from the corner before")
        places = np.array(self.corners)
        if dimension == 3:
            if len(places) < 3:
                raise field_error((*path, "corners"), self.corners, "a list of at least 3 corners in 3-D")
            sides = np.roll(places, -1, axis=0) - places
            later = np.roll(sides, -1, axis=0)
            turns = np.cross(sides, later)
            normal = turns.sum(axis=0) / max(np.linalg.norm(turns.sum(axis=0)), 1e-300)
            around = np.arctan2(turns @ normal, (sides * later).sum(axis=1)).sum() / (2.0 * np.pi)
            is_flat = np.ptp(places @ normal) <= FLAT * np.ptp(places, axis=0).max()
            if not is_flat or (turns @ normal <= 0.0).any() or around > 1.5:
                wanted = "the corners of a flat convex polygon, once around, none on a straight edge"
                raise field_error((*path, "corners"), self.corners, wanted)


@cached_by_file(8, MOST_BYTES)
def _sheet_in(path: str) -> Sheet:
    vertices, corners = triangles_in_file(path)
    places, numbers = np.unique(vertices, axis=0, return_inverse=True)
    found = Sheet(places, numbers.reshape(-1)[corners])
    sides = found.pieces[:, 1:] - found.pieces[:, :1]
    with_area = np.cross(sides[:, 0], sides[:, 1]).any(axis=1)
    if not with_area.any():
        raise InputError(f"{path} has no triangle with an area.")
    return Sheet(places, found.corners[with_area])


_Simple = BoxSolid | SphereSolid | CapsuleSolid | CylinderSolid | CupSolid | PolygonSolid
AnySolid = Annotated[_Simple | PlaneSolid | MeshSolid | SheetSolid, Field(discriminator="shape")]
