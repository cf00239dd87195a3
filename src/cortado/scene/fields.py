"""The types of the fields of a scene, for pydantic.

A field is ``Annotated[float, quantity("kg/m3", gt=0.0)]``. Pydantic checks its value, and describes it in the JSON
schema of its table. From this schema `cortado.scene.tables` makes the sentences of errors, so that the checks, the
sentences and the help of an editor always agree.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from cortado.errors import Words

GREATEST = 1e50
"""No number of a scene is larger, as its cube must fit into a float64, and no positive one smaller than its inverse."""
MISSING = Words("missing")
FieldPath = Sequence[str | int]


@dataclass(frozen=True, repr=False)
class FieldError:
    """An error in a field: its path, what was found, and what was wanted.

    Its ``repr`` does not show the value that was found, as pydantic puts it into messages, and the value may be of any
    length.
    """

    path: tuple[str | int, ...]
    found: Any
    wanted: str
    sentence: str | None


def field_error(path: FieldPath, found: Any, wanted: str, sentence: str | None = None) -> PydanticCustomError:
    """The exception that a check raises; the path (names and indices) starts at the model that is being checked."""
    return PydanticCustomError("scene", "wrong value", {"error": FieldError(tuple(path), found, wanted, sentence)})


# ---- field types -------------------------------------------------------------------------------------------------


def quantity(unit: str = "-", *, gt: float | None = None, ge: float = -GREATEST, le: float = GREATEST) -> Any:
    """A finite number with a unit; "-" is a plain number."""
    least = ge if gt is None else max(ge, 1.0 / GREATEST)
    return Field(strict=True, allow_inf_nan=False, gt=gt, ge=least, le=le, json_schema_extra={"unit": unit})


def count(least: int, most: int) -> Any:
    """A whole number."""
    return Field(strict=True, ge=least, le=most)


def components(*names: str) -> Any:
    """A list of components that each have a name, as many in 2-D as in 3-D: a colour."""
    extra: Any = {"components": list(names)}
    return Field(min_length=len(names), max_length=len(names), fail_fast=True, json_schema_extra=extra)


@dataclass(frozen=True)
class OneOf:
    """One of the names of a registry."""

    names: Collection[str]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.literal_schema(list(self.names))


@dataclass(frozen=True)
class OrWord:
    """A number, or a word that says how it is found."""

    number: Any
    """Of `quantity`."""
    word: str

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        number = handler.generate_schema(Annotated[float, self.number])
        as_it_is = core_schema.plain_serializer_function_ser_schema(lambda value: value)
        return core_schema.no_info_wrap_validator_function(self._checked, number, serialization=as_it_is)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"anyOf": [handler(schema), {"const": self.word, "type": "string"}]}

    def _checked(self, value: Any, number: Any) -> Any:
        return value if isinstance(value, str) and value == self.word else number(value)


Item = TypeVar("Item")
PER_AXIS = "per axis"
"""Marks the fields with one component for each axis of the scene."""
Vector = Annotated[tuple[Item, ...], PER_AXIS, Field(min_length=2, max_length=3, fail_fast=True)]
"""One component for each axis: a vector, or flags. In 2-D the default is the first two components of that in 3-D."""
Several = Annotated[tuple[Item, ...], Field(min_length=1, fail_fast=True)]
"""A list of at least one entry."""
Text = Annotated[str, Field(strict=True, pattern=r"\S")]
"""A text that is not empty."""
Flag = Annotated[bool, Field(strict=True)]
"""Yes or no."""
Length = Annotated[float, quantity("m")]
Colour = Annotated[tuple[Annotated[float, quantity(ge=0.0, le=1.0)], ...], components("red", "green", "blue")]


def without_numpy(value: Any) -> Any:
    """The value with arrays and numbers of NumPy, also those in a list, as lists and numbers of Python."""
    if isinstance(value, (list, tuple)):
        return [entry.tolist() if isinstance(entry, (np.ndarray, np.generic)) else entry for entry in value]
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


def as_number(value: Any) -> float | None:
    """A finite number as a float; None for anything else, a bool included."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


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
