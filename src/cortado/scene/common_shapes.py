"""Shapes that solids and bodies of fluid may both have."""

from functools import lru_cache
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo, model_validator

from cortado.discretise.mesh import Mesh
from cortado.discretise.mesh_checks import FoundMesh
from cortado.discretise.mesh_files import mesh_in_file, thickness_of
from cortado.discretise.primitives import Box, Polygon, Revolved, Round
from cortado.discretise.shapes import Points
from cortado.discretise.solid import Solid
from cortado.scene.fields import FieldPath, Length, Text, Vector, field_error, quantity
from cortado.scene.tables import Table

INDEX_OF_AXIS = {"x": 0, "y": 1, "z": 2}
THIN = 2.5
"""In spacings: sheets of meshes that are thicker are thick."""


def check_order(lower: tuple[float, ...], upper: tuple[float, ...]) -> None:
    """Every component of upper must be greater than that of lower."""
    if len(lower) == len(upper) and any(b <= a for a, b in zip(lower, upper, strict=True)):
        raise field_error(("upper",), upper, f"greater than lower, {list(lower)}, in every component")


def refuse_plane(dimension: int, path: FieldPath, others: str) -> None:
    """A cylinder needs three dimensions."""
    if dimension == 2:
        raise field_error((*path, "shape"), "cylinder", f"{others} in 2-D")


def _beside_scene(file: str, info: ValidationInfo) -> str:
    """The absolute name of a file that a scene names, which is beside the scene's own."""
    folder = Path((info.context or {}).get("folder", "."))
    try:
        return str((folder / file).absolute())
    except (OSError, ValueError):
        raise field_error((), file, "the name of a file") from None


File = Annotated[Text, AfterValidator(_beside_scene)]
"""The name of a file beside the scene's own."""


class BoxShape(Table):
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
        """The box about its middle, not turned, and where that is (d,) [m]."""
        return Box(0.5 * np.subtract(self.upper, self.lower)), 0.5 * np.add(self.lower, self.upper)


class SphereShape(Table):
    """A sphere, or a disc in 2-D."""

    shape: Literal["sphere"] = "sphere"
    centre: Vector[Length]
    """(d,) Middle [m]."""
    radius: Annotated[float, quantity("m", gt=0.0)]
    """From the middle to the surface [m]."""

    def shape_about(self) -> tuple[Solid, Points]:
        """The sphere about its middle, and where that is (d,) [m]."""
        return Round(np.zeros(len(self.centre)), self.radius), np.array(self.centre)


class CylinderShape(Table):
    """A cylinder, in 3-D."""

    instead: ClassVar[str]
    """Shapes that there are in 2-D, in words."""
    shape: Literal["cylinder"] = "cylinder"
    base: Vector[Length]
    """(3,) Middle of the bottom [m]."""
    radius: Annotated[float, quantity("m", gt=0.0)]
    """From the axis to the side [m]."""
    height: Annotated[float, quantity("m", gt=0.0)]
    """From the base, along the axis [m]."""
    axis: Literal["x", "y", "z"] = "y"
    """The axis of space along which it stands, before it is turned."""

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        refuse_plane(dimension, path, self.instead)
        return super().in_dimension(dimension, path)

    def shape_about(self) -> tuple[Solid, Points]:
        """The cylinder about its middle, not turned, and where that is (3,) [m]."""
        along = INDEX_OF_AXIS[self.axis]
        middle = np.array(self.base) + 0.5 * self.height * np.eye(3)[along]
        return Revolved(Box(np.array([self.radius, 0.5 * self.height])), along), middle


class PolygonShape(Table):
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
            others = '"box", "sphere", "capsule", "cylinder" or "cup" in 3-D'
            raise field_error((*path, "shape"), "polygon", others)
        return super().in_dimension(dimension, path)

    def shape_about(self) -> tuple[Solid, Points]:
        """The polygon about its centroid, and where that is (2,) [m]."""
        corners = np.array(self.corners)
        middle = Polygon(corners).moments().centre
        return Polygon(corners - middle), middle


class MeshShape(Table):
    """What a mesh of triangles holds, in 3-D."""

    shape: Literal["mesh"] = "mesh"
    file: File
    """Its name: STL, OBJ, PLY, glTF or GLB; beside the scene file, and absolute once read."""
    scale: Annotated[float, quantity(gt=0.0)] = 1.0
    """What its lengths are multiplied with, such as 0.001 where they are millimetres."""

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        if dimension == 2:
            raise field_error((*path, "shape"), "mesh", '"box", "sphere", "capsule", "cup" or "polygon" in 2-D')
        return super().in_dimension(dimension, path)

    def shape_about(self) -> tuple[Solid, Points]:
        """The mesh about its centroid, and where that is (3,) [m]."""
        return _about_middle(mesh_in_file(self.file), self.scale)

    def thinnest_sheet(self, spacing: float) -> float:
        """The thickness of its thinnest sheet [m]; infinite where all are thicker than `THIN` spacings [m]."""
        return _thinnest_sheet(mesh_in_file(self.file), self.scale, THIN * spacing)


@lru_cache(maxsize=8)
def _about_middle(found: FoundMesh, scale: float) -> tuple[Mesh, Points]:
    """A mesh times a scale, about its middle, and where that is (3,) [m]; once, as looking it up takes a tree."""
    middle = found.mesh.moments().centre
    return found.mesh.moved(scale, -scale * middle), scale * (found.origin + middle)


@lru_cache(maxsize=8)
def _thinnest_sheet(found: FoundMesh, scale: float, reach: float) -> float:
    """The thickness of the thinnest sheet of a mesh times a scale [m]; infinite where all are thicker than a reach [m].
    Once, as it takes thousands of points."""
    return thickness_of(_about_middle(found, scale)[0], reach).thinnest


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
