"""The shapes that solids of a scene may have."""

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from cortado.arrays import unit
from cortado.discretise.primitives import HalfSpace, Polygon, Revolved, Round
from cortado.discretise.shapes import Points
from cortado.discretise.solid import Solid
from cortado.errors import Words
from cortado.scene.shape_tables import (
    INDEX_OF_AXIS,
    BoxShape,
    Container,
    CylinderShape,
    MeshShape,
    PolygonShape,
    SphereShape,
)
from cortado.scene.solids import SolidTable
from cortado.scene.tables import FieldPath, Length, Vector, field_error, quantity

ALONG = 1e-9
"""Component of a normal along a period, of one that is none."""


class PlaneSolid(SolidTable):
    """All that is behind a plane, such as a slope or a wall, at rest; fluid is on the side that `normal` points to. It
    has no end, and so needs a container, which it cuts."""

    shape: Literal["plane"] = "plane"
    position: Vector[Length]
    """(d,) A point of the plane [m]."""
    normal: Vector[Annotated[float, quantity()]]
    """(d,) Normal from the plane into the fluid, of any length."""
    _ends: tuple[tuple[float, ...], ...] | None = PrivateAttr(None)

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        turned = super().in_dimension(dimension, path)
        if not any(self.normal):
            raise field_error((*path, "normal"), self.normal, "a vector that is not 0")
        if self.side == "inside":
            raise field_error((*path, "side"), self.side, '"outside": fluid is where the normal of a plane points')
        if self.rotation is not None:
            raise field_error((*path, "rotation"), self.rotation, "left out, as normal says how a plane is turned")
        for name, value in (("motion", self.motion), ("surface_velocity", self.surface_velocity)):
            if value not in ("fixed", None):
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

    def thinnest(self, spacing: float) -> float:
        return np.inf

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
    """A solid capsule: all that is no further than a radius from a segment."""

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


class CylinderSolid(CylinderShape, SolidTable):
    """A solid cylinder, in 3-D."""

    measures: ClassVar = ("base", "radius", "height")
    instead: ClassVar = '"box", "sphere", "capsule", "cup" or "polygon"'

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
    """Thickness of the side and the bottom [m]."""
    axis: Literal["x", "y", "z"] = "y"
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
        """Return the height of its centroid above the base [m]."""
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

    def thinnest(self, spacing: float) -> float:
        return self.thinnest_sheet(spacing)


AnySolid = Annotated[
    BoxSolid | SphereSolid | CapsuleSolid | CylinderSolid | CupSolid | PolygonSolid | PlaneSolid | MeshSolid,
    Field(discriminator="shape"),
]
