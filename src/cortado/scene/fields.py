"""The types of the fields of a scene.

A field type is put beside the Python type of a field, ``Annotated[float, Quantity("kg/m3", above=0.0)]``: it checks the
value, and says in words what was wanted.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np
from pydantic import BaseModel, GetCoreSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from cortado.errors import Words

GREATEST = 1e50
"""No number of a scene is larger, as its cube must fit into a float64, and no positive one smaller than its inverse."""
MISSING = Words("missing")
FieldPath = Sequence[str | int]


@dataclass(frozen=True, repr=False)
class FieldError:
    """What is wrong with a field.

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


class FieldType:
    """The type of a field: checks a value, and says what was wanted."""

    @property
    def wanted(self) -> str:
        """What a value must be, in words."""
        raise NotImplementedError

    def check(self, value: Any) -> Any:
        """The value as it is kept; raises a `field_error`."""
        raise NotImplementedError

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(self.check, handler(source))


@dataclass(frozen=True)
class Quantity(FieldType):
    """A finite number with a unit."""

    unit: str = ""
    above: float | None = None
    least: float | None = None
    most: float | None = None

    @property
    def wanted(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        limits = [
            f"{word} {limit:g}{unit}"
            for word, limit in (("greater than", self.above), ("at least", self.least), ("at most", self.most))
            if limit is not None
        ]
        return " and ".join(limits) if limits else f"a number{f' in {self.unit}' if unit else ''}"

    def check(self, value: Any) -> float:
        number = as_number(value)
        if number is None:
            raise field_error((), value, f"a finite number{'' if self.wanted.startswith('a ') else f', {self.wanted}'}")
        if abs(number) > GREATEST or (self.above == 0.0 and 0.0 < number < 1.0 / GREATEST):
            raise field_error((), value, f"a number between {1.0 / GREATEST:g} and {GREATEST:g} in size")
        low = (self.above is not None and number <= self.above) or (self.least is not None and number < self.least)
        if low or (self.most is not None and number > self.most):
            raise field_error((), value, self.wanted)
        return number


@dataclass(frozen=True)
class Count(FieldType):
    """A whole number."""

    least: int
    most: int

    @property
    def wanted(self) -> str:
        return f"a whole number from {self.least} to {self.most}"

    def check(self, value: Any) -> int:
        if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)):
            raise field_error((), value, self.wanted)
        if not self.least <= value <= self.most:
            raise field_error((), value, self.wanted)
        return int(value)


@dataclass(frozen=True)
class Choice(FieldType):
    """One of a few names."""

    options: tuple[str, ...]

    @property
    def wanted(self) -> str:
        return " or ".join(f'"{option}"' for option in self.options)

    def check(self, value: Any) -> str:
        if not isinstance(value, str) or value not in self.options:
            raise field_error((), value, self.wanted)
        return value


class Text(FieldType):
    """A text that is not empty."""

    wanted = "a text that is not empty"

    def check(self, value: Any) -> str:
        if not isinstance(value, str) or not value.strip():
            raise field_error((), value, self.wanted)
        return value


class Flag(FieldType):
    """Yes or no."""

    wanted = "true or false"

    def check(self, value: Any) -> bool:
        if not isinstance(value, (bool, np.bool_)):
            raise field_error((), value, self.wanted)
        return bool(value)


@dataclass(frozen=True)
class Components(FieldType):
    """One component for each axis: a vector, or flags. Left out, it is () until the scene's dimension is known."""

    component: FieldType
    default: tuple[Any, ...] = ()

    @property
    def wanted(self) -> str:
        return f"a list with one component for each axis, each {self.component.wanted}"

    def check(self, value: Any) -> tuple[Any, ...]:
        components = as_sequence(value)
        if not components:
            raise field_error((), value, self.wanted)
        return _check_components(self.component, components)

    def in_dimension(self, path: FieldPath, value: tuple[Any, ...], dimension: int) -> tuple[Any, ...]:
        """The value with as many components as there are dimensions."""
        value = value or self.default[:dimension]
        if len(value) != dimension:
            raise field_error(path, value, f"a list of {dimension} components, as the scene has {dimension} dimensions")
        return value


@dataclass(frozen=True)
class Parts(FieldType):
    """Components that each have a name, as many in 2-D as in 3-D: a colour."""

    component: FieldType
    names: tuple[str, ...]

    @property
    def wanted(self) -> str:
        *first, last = self.names
        return f"a list of {len(self.names)} components: {', '.join(first)} and {last}"

    def check(self, value: Any) -> tuple[Any, ...]:
        components = as_sequence(value)
        if components is None or len(components) != len(self.names):
            raise field_error((), value, self.wanted)
        return _check_components(self.component, components)


@dataclass(frozen=True)
class Tables(FieldType):
    """One table or more, in a list."""

    name: str

    @property
    def wanted(self) -> str:
        return f"a list of at least one table, each written [[{self.name}]]"

    def check(self, value: Any) -> Any:
        if not isinstance(value, (list, tuple)) or not value:
            raise field_error((), value, self.wanted)
        return value


@dataclass(frozen=True)
class Shaped(FieldType):
    """A table whose key ``shape`` says which of several it is."""

    shapes: tuple[str, ...]
    wanted = "a table"

    def check(self, value: Any) -> Any:
        if isinstance(value, Mapping):
            choice = Choice(self.shapes)
            shape = value.get("shape", MISSING)
            if isinstance(shape, Words) or not isinstance(shape, str) or shape not in self.shapes:
                raise field_error(("shape",), shape, choice.wanted)
        elif not isinstance(value, BaseModel):
            raise field_error((), value, self.wanted)
        return value


COLOUR = Parts(Quantity(least=0.0, most=1.0), ("red", "green", "blue"))


def _check_components(component: FieldType, values: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(_check_component(component, index, value) for index, value in enumerate(values))


def _check_component(component: FieldType, index: int, value: Any) -> Any:
    try:
        return component.check(value)
    except PydanticCustomError as error:
        own = (error.context or {})["error"]
        raise field_error((index,), own.found, own.wanted) from None


def as_sequence(value: Any) -> Sequence[Any] | None:
    """A list, tuple or array as the first or second; None for anything else."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    return value if isinstance(value, (list, tuple)) else None


def as_number(value: Any) -> float | None:
    """A finite number as a float; None for anything else, a bool included."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None
