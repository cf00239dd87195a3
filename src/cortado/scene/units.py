"""The units of the values of scenes, by their keys."""

import json
from collections.abc import Iterator
from functools import cache
from typing import Any

from cortado.files.input_files import SCHEMA

Schema = dict[str, Any]


def unit_of(key: str) -> str:
    """The unit of the value of a scene that has a dotted key, such as "Pa s" of ``phase.0.viscosity``; nothing where it
    has none, or where shapes of a body have different ones."""
    found = list(_choices(_schema()))
    for part in key.split("."):
        found = [choice for one in found for choice in _choices(_part(one, part))]
    units = {choice["unit"] for one in found for choice in (one, *_choices(one.get("items", {}))) if "unit" in choice}
    return units.pop() if len(units) == 1 and units != {"-"} else ""


@cache
def _schema() -> Schema:
    """The shipped one, which `Scene` is compared with in the tests."""
    read: Schema = json.loads(SCHEMA.read_text(encoding="utf-8"))
    return read


def _part(schema: Schema, part: str) -> Schema:
    """What an entry of a list, by its number, or of a table may be."""
    found: Schema = schema.get("items", {}) if part.isdigit() else schema.get("properties", {}).get(part, {})
    return found


def _choices(schema: Schema) -> Iterator[Schema]:
    """A schema, and those of which it has one or all."""
    yield schema
    if "$ref" in schema:
        yield from _choices(_schema()["$defs"][schema["$ref"].rpartition("/")[2]])
    for word in ("anyOf", "oneOf", "allOf"):
        for one in schema.get(word, ()):
            yield from _choices(one)
