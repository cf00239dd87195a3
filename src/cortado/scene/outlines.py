"""Shapes that solids and bodies of fluid may both have: polygons, and meshes from files."""

from functools import lru_cache
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from cortado.discretise.mesh import Mesh
from cortado.discretise.mesh_checks import FoundMesh
from cortado.discretise.mesh_files import mesh_in_file, thickness_of
from cortado.discretise.primitives import Polygon
from cortado.discretise.shapes import Points
from cortado.discretise.solid import Solid
from cortado.scene.fields import FieldPath, Length, Text, field_error, quantity
from cortado.scene.fluids import beside_scene
from cortado.scene.tables import Table

THIN = 2.5
"""In spacings: sheets of meshes that are thicker are thick."""


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
        """The mesh about its centroid, and where that is (3,) [m]."""
        return _about_middle(mesh_in_file(self.file), self.scale)

    def thinnest_sheet(self, spacing: float) -> float:
        """How thick its thinnest sheet is [m]; infinite where all are thicker than `THIN` spacings [m]."""
        return _thinnest_sheet(mesh_in_file(self.file), self.scale, THIN * spacing)


@lru_cache(maxsize=8)
def _about_middle(found: FoundMesh, scale: float) -> tuple[Mesh, Points]:
    """A mesh times a scale, about its middle, and where that is (3,) [m]; once, as looking it up takes a tree."""
    middle = found.mesh.moments().centre
    return found.mesh.moved(scale, -scale * middle), scale * (found.origin + middle)


@lru_cache(maxsize=8)
def _thinnest_sheet(found: FoundMesh, scale: float, reach: float) -> float:
    """Of a mesh times a scale [m]; infinite where all are thicker than a reach [m]. Once, as it takes thousands of
    points."""
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
