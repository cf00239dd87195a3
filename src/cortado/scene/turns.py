"""Rotations and angular velocities as scenes write them: a number in 2-D, a vector in 3-D."""

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from cortado.scene.fields import FieldPath, field_error, quantity

Angle = Annotated[float, quantity("rad")]


def _in_a_list(value: Any) -> Any:
    return [value] if isinstance(value, (int, float)) else value


Rotation = Annotated[tuple[Angle, ...], Field(min_length=1, max_length=3, fail_fast=True), BeforeValidator(_in_a_list)]
Turning = Annotated[
    tuple[Annotated[float, quantity("rad/s")], ...],
    Field(min_length=1, max_length=3, fail_fast=True),
    BeforeValidator(_in_a_list),
]


def check_turn(path: FieldPath, value: tuple[float, ...] | None, dimension: int) -> None:
    """A rotation or an angular velocity, if given, is a number in 2-D and a vector in 3-D."""
    if value is not None and len(value) != 2 * dimension - 3:
        wanted = "one number in 2-D" if dimension == 2 else "a list of 3 components in 3-D"
        raise field_error(path, value, wanted)


def rotation_matrix(rotation: tuple[float, ...]) -> NDArray[np.float64]:
    """(d, d) of a rotation vector [rad], or in 2-D of an angle."""
    from scipy.spatial.transform import Rotation as Turn

    if len(rotation) == 1:
        return np.asarray(Turn.from_rotvec([0.0, 0.0, rotation[0]]).as_matrix()[:2, :2])
    return np.asarray(Turn.from_rotvec(rotation).as_matrix())
