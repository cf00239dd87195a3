"""Bodies of fluid that fill a mesh, a polygon, or a box or a cylinder that is turned."""

from abc import abstractmethod
from dataclasses import replace
from typing import Annotated, Self

import numpy as np
from pydantic import Field

from cortado.discretise.primitives import block_around, points_inside
from cortado.discretise.shapes import Block, Points
from cortado.discretise.solid import Placed, Solid
from cortado.scene.fields import FieldPath, Length
from cortado.scene.fluids import (
    ALIGNED,
    BoxFluid,
    CylinderFluid,
    Fluid,
    PointsFluid,
    RegionFluid,
    SphereFluid,
    Turnable,
    box_about,
    cylinder_about,
)
from cortado.scene.outlines import MeshShape, PolygonShape
from cortado.scene.turns import rotation_matrix


class Filled(Turnable):
    """A body of fluid that fills a solid shape; its particles are packed unless its surface goes along cells of the
    lattice from the lower corner of the box around it."""

    @abstractmethod
    def shape_about(self) -> tuple[Solid, Points]:
        """The shape about its middle, not turned, and where its measures put the middle, (d,) [m]."""

    def body(self) -> Placed:
        """The shape in its place."""
        shape, middle = self.shape_about()
        return Placed(shape, middle, rotation_matrix(self.rotation or (0.0,) * (2 * len(middle) - 3)))

    def block(self, spacing: float) -> Block:
        return block_around(self.body(), spacing)

    def distance(self, points: Points, spacing: float, reach: float = np.inf) -> Points:
        return self.body().distance_up_to(points, reach)

    def volume(self, spacing: float) -> float:
        return self.shape_about()[0].moments().volume

    def particles(self, spacing: float) -> Points:
        return points_inside(self.body(), spacing)

    def witnesses(self, spacing: float) -> Points:
        return self.particles(spacing)

    def lattice(self, spacing: float, reach: float) -> Points:
        return RegionFluid.lattice(self, spacing, reach)

    def cuts_cells(self, spacing: float) -> bool:
        points = self.block(spacing).grown(1).points()
        return bool((np.abs(self.distance(points, spacing, spacing)) < (0.5 - ALIGNED) * spacing).any())


class FilledShape(Filled):
    """One with a place of its own."""

    position: tuple[Length, ...] | None = None
    """(d,) Where the centroid of its volume is [m]; left out, it is where its measures put it."""

    def body(self) -> Placed:
        placed = super().body()
        return placed if self.position is None else replace(placed, position=np.array(self.position))

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        self.check_components(("position",), dimension, path)
        return super().in_dimension(dimension, path)


class TurnedBox(Filled, BoxFluid):
    """A box of fluid with a rotation."""

    def shape_about(self) -> tuple[Solid, Points]:
        return box_about(self.lower, self.upper)


class TurnedCylinder(Filled, CylinderFluid):
    """A cylinder of fluid with a rotation."""

    def shape_about(self) -> tuple[Solid, Points]:
        return cylinder_about(self.base, self.radius, self.height, self.axis)


def turned(fluid: Fluid) -> Fluid:
    """The same body of fluid; one that has a rotation where it can do without, as one that is packed."""
    kinds: dict[type[Fluid], type[Filled]] = {BoxFluid: TurnedBox, CylinderFluid: TurnedCylinder}
    kind = kinds.get(type(fluid))
    if kind is None or not isinstance(fluid, Turnable) or fluid.rotation is None:
        return fluid
    return kind.model_construct(fluid.model_fields_set, **dict(fluid))


class PolygonFluid(PolygonShape, FilledShape):
    """What a polygon holds, in 2-D."""


class MeshFluid(MeshShape, FilledShape):
    """What a mesh of triangles holds, in 3-D."""


AnyFluid = Annotated[
    BoxFluid | CylinderFluid | SphereFluid | PointsFluid | MeshFluid | PolygonFluid, Field(discriminator="shape")
]
