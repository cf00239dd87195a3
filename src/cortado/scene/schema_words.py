"""Descriptions of the keys of tables, made from JSON schemas: valid values, units and help."""

import json
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from inspect import Parameter, Signature, cleandoc
from sys import modules
from textwrap import fill
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from cortado.files.disk import SCHEMA

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)

GREATEST = 1e50
"""Greatest number that a scene may contain. The smallest positive number is 1 / ``GREATEST``."""
Schema = Mapping[str, Any]


def wanted(schema: Schema, name: str = "") -> str:
    match schema:
        case {"enum": names}:
            return any_of(names)
        case {"const": constant}:
            return any_of([constant])
        case {"type": "number", "word": word}:
            return f'{_limits(schema)} or "{word}"'
        case {"type": "number"}:
            return _limits(schema)
        case {"type": "integer", "minimum": least, "maximum": most}:
            return f"a whole number from {least} to {most}"
        case {"type": "boolean"}:
            return "true or false"
        case {"type": "string"}:
            return "a text that is not empty"
        case {"type": "array", "components": [*first, last]}:
            return f"a list of {len(first) + 1} components: {', '.join(first)} and {last}"
        case {"type": "array", "items": {"$ref": _} | {"discriminator": _} | {"allOf": _}}:
            return f"a list of at least one table, each written [[{name}]]"
        case {"type": "array", "items": items, "minItems": 1, "maxItems": most}:
            return f"a list of at most {most} components, each {wanted(items)}"
        case {"type": "array", "items": items, "maxItems": _}:
            return f"a list with one component for each axis, each {wanted(items)}"
        case {"type": "array", "items": items}:
            least = schema.get("minItems", 0)
            entries = f" of at least {'one entry' if least == 1 else f'{least} entries'}" if least else ""
            return f"a list{entries}, each {wanted(items)}"
        case {"minProperties": _, "properties": properties}:
            return f"a table of at least one parameter out of {', '.join(properties)}"
    return "a table"


def any_of(names: Iterable[str]) -> str:
    return " or ".join(f'"{name}"' for name in names)


def _limits(schema: Schema) -> str:
    unit = "" if schema["unit"] == "-" else f" {schema['unit']}"
    least, most = schema["minimum"], schema["maximum"]
    limits = [f"greater than {schema['exclusiveMinimum']:g}{unit}"] if "exclusiveMinimum" in schema else []
    limits += [f"at least {least:g}{unit}"] if least not in (-GREATEST, 1.0 / GREATEST) else []
    limits += [f"at most {most:g}{unit}"] if most != GREATEST else []
    return " and ".join(limits) or f"a number{unit and f' in{unit}'}"


def unit_of(key: str) -> str:
    """Return the unit of a key such as ``phase.0.viscosity``. For a key without a unique unit, the text is empty."""
    found = list(_choices(_schema()))
    for part in key.split("."):
        inner = [one.get("items", {}) if part.isdigit() else one.get("properties", {}).get(part, {}) for one in found]
        found = [choice for one in inner for choice in _choices(one)]
    units = {choice["unit"] for one in found for choice in (one, *_choices(one.get("items", {}))) if "unit" in choice}
    return units.pop() if len(units) == 1 and units != {"-"} else ""


@cache
def _schema() -> Schema:
    read: Schema = json.loads(SCHEMA.read_text(encoding="utf-8"))
    return read


def _choices(schema: Schema) -> Iterator[Schema]:
    yield schema
    if "$ref" in schema:
        yield from _choices(_schema()["$defs"][schema["$ref"].rpartition("/")[2]])
    for word in ("anyOf", "oneOf", "allOf"):
        for one in schema.get(word, ()):
            yield from _choices(one)


_HOMES: dict[str, str] = {}  # modules of tables by name


class Documented(ModelMetaclass):
    """Metaclass of tables that lists the keys of a table in its help."""

    def __init__(cls, name: str, *arguments: Any, **named: Any):
        super().__init__(name, *arguments, **named)
        _HOMES[name] = cls.__module__

    @property
    def __doc__(cls) -> str | None:  # type: ignore[override]
        own: str | None = cls.__dict__.get("__doc__")
        schema = _schema() if cls.__name__ == "Scene" else _schema()["$defs"].get(cls.__name__, {})
        known, needed = cls.__dict__.get("__pydantic_fields__", {}), schema.get("required", ())
        lines = [_line(key, part, key in needed) for key, part in schema.get("properties", {}).items() if key in known]
        return "\n".join([cleandoc(own), "", "Keys:", "", *lines]) if own and lines else own

    @property
    def __signature__(cls) -> Signature:
        found = []
        for name, field in vars(cls)["__pydantic_fields__"].items():
            default = Parameter.empty if field.is_required() else field.get_default(call_default_factory=True)
            default = {} if isinstance(default, BaseModel) else default
            found.append(Parameter(name, Parameter.KEYWORD_ONLY, default=default))
        return Signature(found)

    @__signature__.setter
    def __signature__(cls, value: Any) -> None:
        """Ignore the signature that pydantic sets."""


def _line(key: str, schema: Schema, is_needed: bool) -> str:
    given, *others = schema.get("anyOf", (schema,))
    words = [{"word": one["const"]} for one in others if "const" in one]
    what = _tables(given, "a table") or _tables(given.get("items", {}), "a list of tables")
    what = what or wanted({**given, **(words[0] if words else {})}, key)
    default, meaning = schema.get("default"), " ".join(schema.get("description", "").split())
    is_short = isinstance(default, (str, int, float, list)) and default != []
    left_out = "; needed" if is_needed else f"; {json.dumps(default)} if left out" if is_short else ""
    return fill(f"- {key} ({what}{left_out}): {meaning}", 112, subsequent_indent="  ", break_on_hyphens=False)


def _tables(schema: Schema, what: str) -> str:
    names = [one["$ref"].rpartition("/")[2] for one in (schema, *schema.get("oneOf", ())) if "$ref" in one]
    there = [name for name in names if hasattr(modules.get(_HOMES.get(name, "")), name)]
    return f"{what}, {_HOMES[there[0]]}.{' or '.join(there)}" if there else what if names else ""
