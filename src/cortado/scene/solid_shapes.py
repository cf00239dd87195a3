"""The shapes that solids may have."""

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from cortado.discretise.primitives import Polygon, Revolved, Round
from cortado.discretise.shapes import Points
from cortado.discretise.solid import Solid
from cortado.scene.fields import FieldPath, Length, Vector, field_error, quantity
from cortado.scene.fluids import INDEX_OF_AXIS, box_about, check_order, cylinder_about, refuse_plane
from cortado.scene.outlines import MeshShape, PolygonShape
from cortado.scene.planes import PlaneSolid
from cortado.scene.solids import SolidTable

Size = Annotated[float, quantity("m", gt=0.0)]
Axis = Literal["x", "y", "z"]


class BoxSolid(SolidTable):
    """A box, or a rectangle in 2-D."""

    measures: ClassVar = ("lower", "upper")
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
        return box_about(self.lower, self.upper)

    def thinnest(self, spacing: float) -> float:
        return float(np.subtract(self.upper, self.lower).min())


class SphereSolid(SolidTable):
    """A sphere, or a disc in 2-D."""

    measures: ClassVar = ("centre", "radius")
    shape: Literal["sphere"] = "sphere"
    centre: Vector[Length]
    """(d,) Middle [m]."""
    radius: Size
    """From the middle to the surface [m]."""

    def shape_about(self) -> tuple[Solid, Points]:
        centre = np.array(self.centre)
        return Round(np.zeros_like(centre), self.radius), centre

    def thinnest(self, spacing: float) -> float:
        return 2.0 * self.radius


class CapsuleSolid(SolidTable):
    """All that is no further than a radius from a segment."""

    measures: ClassVar = ("start", "end", "radius")
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

    def thinnest(self, spacing: float) -> float:
        return 2.0 * self.radius


class CylinderSolid(SolidTable):
    """A cylinder, in 3-D."""

    measures: ClassVar = ("base", "radius", "height")
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
        return cylinder_about(self.base, self.radius, self.height, self.axis)

    def thinnest(self, spacing: float) -> float:
        return min(2.0 * self.radius, self.height)


class CupSolid(SolidTable):
    """A cup that is open at the top; in 2-D its cut through the axis."""

    measures: ClassVar = ("base", "radius", "height", "thickness")
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

    def thinnest(self, spacing: float) -> float:
        return self.thickness

    def _middle(self) -> float:
        """How high its centroid is above the base [m]."""
        power = len(self.base) - 1
        solid, hollow = (self.radius + self.thickness) ** power, self.radius**power
        whole, cavity = solid * self.height, hollow * (self.height - self.thickness)
        moment = 0.5 * whole * self.height - 0.5 * cavity * (self.height + self.thickness)
        return moment / (whole - cavity)


class PolygonSolid(PolygonShape, SolidTable):
    """A polygon, in 2-D."""

    measures: ClassVar = ("corners",)
    least_thickness: ClassVar = 0.5

    def thinnest(self, spacing: float) -> float:
        return Polygon(np.array(self.corners)).thinnest()


class MeshSolid(MeshShape, SolidTable):
    """What a mesh of triangles holds, in 3-D."""

    measures: ClassVar = ("scale",)
    least_thickness: ClassVar = 0.5

    def thinnest(self, spacing: float) -> float:
        return self.thinnest_sheet(spacing)


AnySolid = Annotated[
    BoxSolid | SphereSolid | CapsuleSolid | CylinderSolid | CupSolid | PolygonSolid | PlaneSolid | MeshSolid,
    Field(discriminator="shape"),
]
