"""Solids without an end: all that is behind a plane."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import PrivateAttr

from cortado.arrays import unit
from cortado.discretise.primitives import HalfSpace
from cortado.discretise.shapes import Points
from cortado.discretise.solid import Solid
from cortado.errors import Words
from cortado.scene.containers import Container
from cortado.scene.fields import FieldPath, Length, Vector, field_error, quantity
from cortado.scene.solids import SolidTable

ALONG = 1e-9
"""Component of a normal along a period, of one that is none."""


class PlaneSolid(SolidTable):
    """All that is behind a plane, such as a slope or a wall, at rest; fluid is on the side that `normal` points to. It
    has no end, and so needs a container, which it cuts."""

    shape: Literal["plane"] = "plane"
    position: Vector[Length]
    """(d,) A point of the plane [m]."""
    normal: Vector[Annotated[float, quantity()]]
    """(d,) Away from it into the fluid, of any length."""
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
