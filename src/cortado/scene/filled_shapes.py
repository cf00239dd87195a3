"""Bodies of fluid that fill a mesh or a polygon."""

from abc import abstractmethod
from typing import Annotated, Self

import numpy as np
from pydantic import Field

from cortado.discretise.shapes import Block, Points
from cortado.discretise.solids.inside_points import block_around, points_inside
from cortado.discretise.solids.solid import Placed, Solid
from cortado.scene.fields import FieldPath, Length
from cortado.scene.fluids import ALIGNED, BoxFluid, CylinderFluid, PointsFluid, RegionFluid, SphereFluid
from cortado.scene.outlines import MeshShape, PolygonShape
from cortado.scene.turns import Rotation, check_turn, rotation_matrix


class FilledShape(RegionFluid):
    """A body of fluid that fills a shape, which may be turned; its particles are packed unless its surface goes along
    cells of the lattice from the lower corner of the box around it."""

    position: tuple[Length, ...] | None = None
    """(d,) Where the middle of its shape, its centroid, is [m]; left out, it is where its measures put it."""
    rotation: Rotation | None = None
    """How it is turned about its middle [rad], not at all if left out: in 3-D a rotation vector, in 2-D one number,
    counterclockwise."""

    @abstractmethod
    def shape_about(self) -> tuple[Solid, Points]:
        """The shape about its middle, not turned, and where its measures put the middle, (d,) [m]."""

    def body(self) -> Solid:
        """The shape in its place."""
        shape, middle = self.shape_about()
        turn = rotation_matrix(self.rotation or (0.0,) * (2 * len(middle) - 3))
        return Placed(shape, middle if self.position is None else np.array(self.position), turn)

    def block(self, spacing: float) -> Block:
        return block_around(self.body(), spacing)

    def distance(self, points: Points, spacing: float, reach: float = np.inf) -> Points:
        return self.body().distance_up_to(points, reach)

    def particles(self, spacing: float) -> Points:
        return points_inside(self.body(), spacing)

    def cuts_cells(self, spacing: float) -> bool:
        points = self.block(spacing).grown(1).points()
        return bool((np.abs(self.distance(points, spacing, spacing)) < (0.5 - ALIGNED) * spacing).any())

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        self.check_components(("position",), dimension, path)
        check_turn((*path, "rotation"), self.rotation, dimension)
        return super().in_dimension(dimension, path)


class PolygonFluid(PolygonShape, FilledShape):
    """What a polygon holds, in 2-D."""


class MeshFluid(MeshShape, FilledShape):
    """What a mesh of triangles holds, in 3-D."""


AnyFluid = Annotated[
    BoxFluid | CylinderFluid | SphereFluid | PointsFluid | MeshFluid | PolygonFluid, Field(discriminator="shape")
]
