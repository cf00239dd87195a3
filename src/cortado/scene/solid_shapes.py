"""The shapes that solids may have."""

from dataclasses import replace
from functools import lru_cache
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from cortado.discretise.shapes import Points
from cortado.discretise.solids.mesh import Mesh
from cortado.discretise.solids.mesh_files import mesh_in_file
from cortado.discretise.solids.solid import Box, Polygon, Revolved, Round, Solid
from cortado.scene.fields import FieldPath, Length, Text, Vector, field_error, quantity
from cortado.scene.fluids import INDEX_OF_AXIS, beside_scene, check_order, refuse_plane
from cortado.scene.solids import SolidTable

Size = Annotated[float, quantity("m", gt=0.0)]
Axis = Literal["x", "y", "z"]


class BoxSolid(SolidTable):
    """A box, or a rectangle in 2-D."""

    shape: Literal["box"] = "box"
    lower: Vector[Length]
    """(d,) Corner with the least coordinates, before it is turned [m]."""
    upper: Vector[Length]
    """(d,) Corner with the greatest coordinates [m]."""

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        check_order(self.lower, self.upper)
        return self

    def shape_about(self) -> tuple[Solid, Points]:
        lower, upper = np.array(self.lower), np.array(self.upper)
        return Box(0.5 * (upper - lower)), 0.5 * (lower + upper)

    def thinnest(self) -> float:
        return float(np.subtract(self.upper, self.lower).min())


class SphereSolid(SolidTable):
    """A sphere, or a disc in 2-D."""

    shape: Literal["sphere"] = "sphere"
    centre: Vector[Length]
    """(d,) Middle [m]."""
    radius: Size
    """From the middle to the surface [m]."""

    def shape_about(self) -> tuple[Solid, Points]:
        centre = np.array(self.centre)
        return Round(np.zeros_like(centre), self.radius), centre

    def thinnest(self) -> float:
        return 2.0 * self.radius


class CapsuleSolid(SolidTable):
    """All that is no further than a radius from a segment."""

    shape: Literal["capsule"] = "capsule"
    start: Vector[Length]
    """(d,) One end of the segment [m]."""
    end: Vector[Length]
    """(d,) The other end [m]."""
    radius: Size
    """From the segment to the surface [m]."""

    def shape_about(self) -> tuple[Solid, Points]:
        start, end = np.array(self.start), np.array(self.end)
        return Round(0.5 * (end - start), self.radius), 0.5 * (start + end)

    def thinnest(self) -> float:
        return 2.0 * self.radius


class CylinderSolid(SolidTable):
    """A cylinder, in 3-D."""

    shape: Literal["cylinder"] = "cylinder"
    base: Vector[Length]
    """(3,) Middle of the bottom [m]."""
    radius: Size
    """From the axis to the side [m]."""
    height: Size
    """From the base, along the axis [m]."""
    axis: Axis = "y"
    """The axis of space along which it stands, before it is turned."""

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        refuse_plane(dimension, path, '"box", "sphere", "capsule", "cup" or "polygon"')
        return super().in_dimension(dimension, path)

    def shape_about(self) -> tuple[Solid, Points]:
        axis = INDEX_OF_AXIS[self.axis]
        profile = Box(np.array([self.radius, 0.5 * self.height]))
        return Revolved(profile, axis), np.array(self.base) + 0.5 * self.height * np.eye(3)[axis]

    def thinnest(self) -> float:
        return min(2.0 * self.radius, self.height)


class CupSolid(SolidTable):
    """A cup that is open at the top; in 2-D its cut through the axis."""

    shape: Literal["cup"] = "cup"
    base: Vector[Length]
    """(d,) Middle of the bottom, outside [m]."""
    radius: Size
    """From the axis to the side, inside [m]."""
    height: Size
    """From the bottom, outside, to the rim [m]."""
    thickness: Size
    """Of the side and the bottom [m]."""
    axis: Axis = "y"
    """The axis of space along which it stands, before it is turned; in 2-D it stands along y."""

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
        dimension, middle = len(self.base), self._middle()
        outside, rim, bottom = self.radius + self.thickness, self.height - middle, self.thickness - middle
        half = [(outside, -middle), (outside, rim), (self.radius, rim), (self.radius, bottom)]
        profile = Polygon(np.array([*half, *((-x, y) for x, y in half[::-1])]))
        up = np.eye(dimension)[INDEX_OF_AXIS[self.axis]]
        shape = profile if dimension == 2 else Revolved(profile, INDEX_OF_AXIS[self.axis])
        return shape, np.array(self.base) + middle * up

    def thinnest(self) -> float:
        return self.thickness

    def _middle(self) -> float:
        """How high its centroid is above the base [m]."""
        power = len(self.base) - 1
        solid, hollow = (self.radius + self.thickness) ** power, self.radius**power
        whole, cavity = solid * self.height, hollow * (self.height - self.thickness)
        moment = 0.5 * whole * self.height - 0.5 * cavity * (self.height + self.thickness)
        return moment / (whole - cavity)


class PolygonSolid(SolidTable):
    """A polygon, in 2-D."""

    shape: Literal["polygon"] = "polygon"
    corners: Annotated[
        tuple[Annotated[tuple[Length, ...], Field(min_length=2, max_length=2)], ...], Field(min_length=3)
    ]
    """(m, 2) The corners, one after the other along the edge, either way round [m]."""

    @model_validator(mode="after")
    def _check_sides(self) -> Self:
        if crossing := _crossing(np.array(self.corners)):
            first, second = crossing
            wanted = f"corners of sides that do not cross, as sides {first} and {second} do"
            raise field_error(("corners",), self.corners, wanted)
        return self

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        if dimension == 3:
            raise field_error((*path, "shape"), "polygon", '"box", "sphere", "capsule", "cylinder" or "cup" in 3-D')
        return super().in_dimension(dimension, path)

    def shape_about(self) -> tuple[Solid, Points]:
        corners = np.array(self.corners)
        following = np.roll(corners, -1, axis=0)
        parts = corners[:, 0] * following[:, 1] - following[:, 0] * corners[:, 1]
        middle = ((corners + following) * parts[:, None]).sum(axis=0) / (3.0 * parts.sum())
        return Polygon(corners - middle), middle

    def thinnest(self) -> float:
        return np.inf


class MeshSolid(SolidTable):
    """What a mesh of triangles holds, in 3-D."""

    shape: Literal["mesh"] = "mesh"
    file: Text
    """Its name: STL, OBJ, PLY, glTF or GLB; beside the scene file, and absolute once read."""
    scale: Annotated[float, quantity(gt=0.0)] = 1.0
    """What its lengths are multiplied with, such as 0.001 where they are millimetres."""

    @field_validator("file")
    @classmethod
    def _make_absolute(cls, file: str, info: ValidationInfo) -> str:
        return beside_scene(file, info)

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        if dimension == 2:
            raise field_error((*path, "shape"), "mesh", '"box", "sphere", "capsule", "cup" or "polygon" in 2-D')
        return super().in_dimension(dimension, path)

    def shape_about(self) -> tuple[Solid, Points]:
        return _about_middle(mesh_in_file(self.file).mesh, self.scale)

    def thinnest(self) -> float:
        return np.inf


AnySolid = Annotated[
    BoxSolid | SphereSolid | CapsuleSolid | CylinderSolid | CupSolid | PolygonSolid | MeshSolid,
    Field(discriminator="shape"),
]


@lru_cache(maxsize=8)
def _about_middle(mesh: Mesh, scale: float) -> tuple[Mesh, Points]:
    """A mesh times a scale, about its middle, and where that is (3,) [m]; once, as looking it up takes a tree."""
    middle = scale * mesh.middle()
    return replace(mesh, vertices=scale * mesh.vertices - middle), middle


def _crossing(corners: Points) -> tuple[int, int] | None:
    """The numbers of two sides of a polygon that meet beside its corners, or of one without a length."""
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
