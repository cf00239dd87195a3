"""Base class of the tables of a scene, types of their fields for pydantic, and error messages.

A field is written as ``Annotated[float, quantity("kg/m3", gt=0.0)]``. Pydantic checks the value and describes the field
in the JSON schema of its table. Error messages are made from the JSON schema. Docstrings below fields become
descriptions in the schema.
"""

import ast
import inspect
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from itertools import pairwise
from sys import modules
from typing import Annotated, Any, ClassVar, Self, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from pydantic.annotated_handlers import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from cortado.errors import LONGEST, InputError, SceneError, Words, shown
from cortado.scene.schema_words import GREATEST, Documented, Schema, any_of, wanted

MISSING = Words("missing")
FieldPath = Sequence[str | int]


@dataclass(frozen=True, repr=False)
class FieldError:
    """An error in a field. The ``repr`` of the error hides the invalid value, which may be long."""

    path: tuple[str | int, ...]
    found: Any
    wanted: str
    sentence: str | None


def field_error(path: FieldPath, found: Any, wanted: str, sentence: str | None = None) -> PydanticCustomError:
    """Make the exception for a failed check. ``path`` is relative to the checked table."""
    return PydanticCustomError("scene", "wrong value", {"error": FieldError(tuple(path), found, wanted, sentence)})


def check_name(path: FieldPath, name: str | None, names: Sequence[str], kind: str, otherwise: str = "") -> None:
    """Raise a `field_error` if a name is not in ``names``. If ``names`` is empty, the message is ``otherwise``."""
    if name not in names:
        raise field_error(path, name, f"the name of {kind}, of {shown(names)}" if names else otherwise)


def quantity(unit: str = "-", *, gt: float | None = None, ge: float = -GREATEST, le: float = GREATEST) -> Any:
    """Describe a field for a finite number. The unit "-" means that the number has no unit."""
    least = ge if gt is None else max(ge, 1.0 / GREATEST)
    return Field(strict=True, allow_inf_nan=False, gt=gt, ge=least, le=le, json_schema_extra={"unit": unit})


def count(least: int, most: int) -> Any:
    return Field(strict=True, ge=least, le=most)


def components(*names: str) -> Any:
    extra: Any = {"components": list(names)}
    return Field(min_length=len(names), max_length=len(names), fail_fast=True, json_schema_extra=extra)


@dataclass(frozen=True)
class OneOf:
    """Marks a field that contains a name from a registry."""

    names: Collection[str]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.literal_schema(list(self.names))


@dataclass(frozen=True)
class OrWord:
    """Marks a field that contains a number or a special word such as "auto"."""

    number: Any
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
PER_AXIS, PER_ROTATION = "per axis", "per rotation"
Vector = Annotated[tuple[Item, ...], PER_AXIS, Field(min_length=2, max_length=3, fail_fast=True)]
"""In 2-D the default is the first two components of the default in 3-D."""
Several = Annotated[tuple[Item, ...], Field(min_length=1, fail_fast=True)]
Text = Annotated[str, Field(strict=True, pattern=r"\S")]
Flag = Annotated[bool, Field(strict=True)]
Length = Annotated[float, quantity("m")]
Colour = Annotated[tuple[Annotated[float, quantity(ge=0.0, le=1.0)], ...], components("red", "green", "blue")]


def without_numpy(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return [entry.tolist() if isinstance(entry, (np.ndarray, np.generic)) else entry for entry in value]
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


Angle = Annotated[float, quantity("rad")]


def _not_zero(vector: tuple[float, ...]) -> tuple[float, ...]:
    if not any(vector):
        raise field_error((), vector, "a vector that is not zero")
    return vector


Direction = Annotated[Vector[Annotated[float, quantity()]], AfterValidator(_not_zero)]


def _in_a_list(value: Any) -> Any:
    return [value] if isinstance(value, (int, float)) else value


def _few(most: int) -> Any:
    return Field(min_length=1, max_length=most, fail_fast=True, json_schema_extra={"maxItemsIn2D": 1})


Few = Annotated[tuple[Item, ...], _few(3), BeforeValidator(_in_a_list)]
OnAxes = Annotated[tuple[Item, ...] | None, PER_AXIS]
Turns = Annotated[Few[Item] | None, PER_ROTATION]
Inertia = Annotated[tuple[Annotated[float, quantity("kg m2")], ...], _few(9), BeforeValidator(_in_a_list)]


def field_docstrings(cls: type) -> dict[str, str]:
    """Return the docstrings of fields, with base classes, by name; empty if the source code is missing."""
    found: dict[str, str] = {}
    for one in reversed(cls.__mro__):
        found |= _of_module(one.__module__).get(one.__qualname__, {})
    return found


@cache
def _of_module(name: str) -> dict[str, dict[str, str]]:
    try:
        source = inspect.getsource(modules[name])
    except (KeyError, OSError, TypeError):
        return {}
    return {one.name: _in_body(one) for one in ast.parse(source).body if isinstance(one, ast.ClassDef)}


def _in_body(node: ast.ClassDef) -> dict[str, str]:
    return {
        field.target.id: inspect.cleandoc(text.value.value)
        for field, text in pairwise(node.body)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant) and isinstance(text.value.value, str)
    }


MOST_HOMES = 2
UNKNOWN = Words("unknown")


@contextmanager
def sentences(model: type[BaseModel]) -> Iterator[None]:
    """Convert pydantic's first error about a model to a `SceneError`."""
    try:
        yield
    except ValidationError as error:
        raise _scene_error(error, model) from None


@contextmanager
def usable_file(path: FieldPath, file: str | None, wanted: str) -> Iterator[None]:
    """Convert an `InputError` about a file to a `field_error` about the field at ``path``."""
    try:
        yield
    except InputError as error:
        raise field_error(path, file, wanted, f"cannot be used: {error}") from None


def field_name(path: FieldPath) -> str:
    """Convert a path such as ``("fluid", 0, "upper")`` to ``fluid[0].upper``."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            name = part if part.replace("-", "_").isidentifier() and len(part) < LONGEST else shown(part)
            text += f".{name}" if text else name
    return text


def _scene_error(error: ValidationError, model: type[BaseModel]) -> SceneError:
    first = error.errors(include_url=False)[0]
    whole = _schema_of(model)
    schema, path = _schema_at(whole, first["loc"])
    if first["type"] == "scene":
        own = first["ctx"]["error"]
        path, sentence = [*path, *own.path], own.sentence
        if own.found is UNKNOWN:
            key, here = path[-1], tuple(part for part in path if not isinstance(part, int))
            homes = [home for home in dict.fromkeys(_fields(whole, whole, ())) if home[-1] == key and home != here]
            words = [field_name(home) if len(home) > 1 else f"{key} at the top of the file" for home in homes]
            if 0 < len(words) <= MOST_HOMES:
                sentence = f"is not a key of {{table}}; did you mean {' or '.join(words)}?"
        if sentence:
            sentence = sentence.replace("{table}", f"[{field_name(path[:-1])}]" if path[1:] else "the scene")
        return SceneError(None, field_name(path), own.found, own.wanted, sentence)
    found, valid = first["input"], wanted(schema, field_name(path[-1:]))
    if first["type"] == "missing":
        found = MISSING
    elif "discriminator" in schema and isinstance(found, Mapping):
        union = schema["discriminator"]
        path, found = [*path, union["propertyName"]], found.get(union["propertyName"], MISSING)
        valid = any_of(union["mapping"])
    elif first["type"] in ("float_type", "finite_number"):
        valid = f"a finite number{'' if valid.startswith('a ') else f', {valid}'}"
    elif first["type"].endswith("_than_equal") and schema["type"] == "number":
        is_tiny = 0.0 < found < schema["minimum"] == 1.0 / GREATEST
        if is_tiny or abs(found) > GREATEST:
            valid = f"a number between {1.0 / GREATEST:g} and {GREATEST:g} in size"
    return SceneError(None, field_name(path), found, valid)


@cache
def _schema_of(model: type[BaseModel]) -> Schema:
    return model.model_json_schema()


def _fields(whole: Schema, part: Schema, path: FieldPath) -> Iterator[FieldPath]:
    if "$ref" in part:
        part = whole["$defs"][part["$ref"].rpartition("/")[2]]
    for name, field in part.get("properties", {}).items():
        yield (*path, name)
        yield from _fields(whole, field, (*path, name))
    members = [one for kind in ("anyOf", "oneOf", "allOf") for one in part.get(kind, ())]
    for member in [*members, *([part["items"]] if "items" in part else [])]:
        yield from _fields(whole, member, path)


def _schema_at(whole: Schema, location: FieldPath) -> tuple[Schema, list[str | int]]:
    part, path = whole, list[str | int]()
    for step in location:
        if "discriminator" in part:
            part = {"$ref": part["discriminator"]["mapping"][step]}
        elif "oneOf" in part:  # tables, of which a step names one
            tables = map(_whole, part["oneOf"])
            part = {one.get("title", one.get("$ref", "").rpartition("/")[2]): one for one in tables}[str(step)]
        else:
            part = part["items"] if isinstance(step, int) else part["properties"][step]
            path.append(step)
        if "anyOf" in part:  # a value, or nothing; a number, or a word
            value, other = part["anyOf"]
            part = {**value, "word": other["const"]} if "const" in other else value
        part = _whole(part)
        if "$ref" in part:
            part = whole["$defs"][part["$ref"].rpartition("/")[2]]
    return part, path


def _whole(part: Schema) -> Schema:
    return part["allOf"][0] if "allOf" in part else part


ALSO_CALLED = {
    **dict.fromkeys(("dt", "step_size"), ("time_step",)),
    **dict.fromkeys(("dx", "h", "particle_size", "particle_radius", "resolution"), ("spacing",)),
    **dict.fromkeys(("walls", "boundary", "boundaries", "box", "domain", "tank"), ("container",)),
    **dict.fromkeys(("obstacle", "obstacles", "body", "rigid_body"), ("solid",)),
    **dict.fromkeys(("fluids", "liquid", "water"), ("phase", "fluid")),
    **dict.fromkeys(("rho", "mass"), ("rest_density", "density")),
    **dict.fromkeys(("mu", "eta"), ("viscosity",)),
    **dict.fromkeys(("speed", "flow", "rate"), ("velocity", "flow_rate")),
    **dict.fromkeys(("lr", "step"), ("learning_rate",)),
    **dict.fromkeys(("epochs", "maxiter", "updates"), ("iterations",)),
    **dict.fromkeys(("method", "algorithm"), ("optimiser",)),
    **dict.fromkeys(("initial", "guess"), ("start",)),
    **dict.fromkeys(("min", "from"), ("lower",)),
    **dict.fromkeys(("max", "to", "size"), ("upper",)),
    **{"type": ("kind", "shape"), "n": ("flow_index",), "cfl": ("courant",), "omega": ("angular_velocity",)},
    **{"angle": ("rotation",), "csv": ("path", "file"), "file": ("path",), "path": ("file",), "fps": ("frame_rate",)},
}


class Table(BaseModel, metaclass=Documented):
    """A table of a scene. Tables are immutable. An unknown key or an invalid value raises a `SceneError`."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    beside: ClassVar[tuple[str, ...]] = ()
    """Names of additional tables in a file, which other modules read."""
    _instead: ClassVar[Mapping[int, str]] = {}
    """Names of shapes that replace this shape in 2 or 3 dimensions, if this shape does not exist there."""

    def __init__(self, /, **data: Any):
        with sentences(type(self)):
            super().__init__(**data)

    def __setattr__(self, name: str, value: Any) -> None:
        raise InputError(
            f"{name} cannot be set, as a scene does not change; make another one, such as "
            'scene.replaced("solver.time_step=0.001").'
        )

    # Tells pydantic to build nested tables without this method, so that an error carries its whole path.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        for key in data:
            if key not in cls.model_fields:
                raise _unknown_key(str(key), [*cls.model_fields, *(name for name in cls.beside if name != key)])
        return {name: without_numpy(value) for name, value in data.items()}

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        schema = handler(core_schema)
        own = handler.resolve_ref_schema(schema)
        properties = own.get("properties", {})
        if "description" in own:
            words = inspect.cleandoc(cls.__dict__["__doc__"])  # without the keys that help lists
            own["description"] = words.partition("\n\nExample")[0]
        texts = field_docstrings(cls)
        for name in properties.keys() & texts.keys():
            properties[name].setdefault("description", texts[name])
        return schema

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        """Return the table for 2 or 3 dimensions, after a check of its shape, vectors and rotations."""
        if dimension in self._instead:
            found = getattr(self, "shape", None)
            raise field_error((*path, "shape"), found, f"{self._instead[dimension]} in {dimension}-D")
        marks = {name: field.metadata for name, field in type(self).model_fields.items()}
        vectors = [name for name in marks if PER_AXIS in marks[name] and getattr(self, name) is not None]
        defaults = {name: getattr(self, name)[:dimension] for name in vectors if name not in self.model_fields_set}
        placed = self.model_copy(update=defaults)
        placed.check_components(vectors, dimension, path)
        for name in [name for name in marks if PER_ROTATION in marks[name]]:
            if (value := getattr(self, name)) is not None and len(value) != 2 * dimension - 3:
                wanted = "one number in 2-D" if dimension == 2 else "a list of 3 components in 3-D"
                raise field_error((*path, name), value, wanted)
        return placed

    def check_components(self, names: Iterable[str], dimension: int, path: FieldPath) -> None:
        for name in names:
            value = getattr(self, name, None)
            if value is not None and len(value) != dimension:
                wanted = f"a list of {dimension} components, as the scene has {dimension} dimensions"
                raise field_error((*path, name), value, wanted)


def _unknown_key(key: str, known: list[str]) -> PydanticCustomError:
    longer = [name for name in known if key in name.split("_")]
    other = [name for name in ALSO_CALLED.get(key.lower(), ()) if name in known]
    close = other or longer or get_close_matches(key, known, n=1)
    advice = f"did you mean {close[0]}?" if close else f"its keys are {', '.join(known)}."
    found = Words("short for another") if longer else UNKNOWN
    return field_error((key,), found, f"one of {', '.join(known)}", f"is not a key of {{table}}; {advice}")
