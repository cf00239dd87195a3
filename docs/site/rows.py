"""A table of a file as a table for people: what the JSON schema of its model says, in Markdown."""

import json
import re
from collections.abc import Mapping
from typing import Any

from cortado.scene.tables import GREATEST

Schema = Mapping[str, Any]
WORDS = {"number": "number", "integer": "whole number", "boolean": "`true` or `false`", "string": "text"}
HEAD = "| key | what it is | unit | range | if left out | meaning |\n|---|---|---|---|---|---|\n"


def rows(schema: Schema, links: Mapping[str, tuple[str, str]] | None = None) -> str:
    """A row for each key of a table.

    Args:
        schema: that of the table, part of `model_json_schema()`.
        links: for keys that are tables themselves, where the page describes them, and what they are.
    """
    needed = schema.get("required", [])
    links = links or {}
    found = [_row(key, field, key in [*needed, "shape"], links.get(key)) for key, field in schema["properties"].items()]
    return HEAD + "".join(found)


def _row(key: str, field: Schema, needed: bool, link: tuple[str, str] | None) -> str:
    value = field["anyOf"][0] if "anyOf" in field else field
    number = value.get("items", value)
    number = number.get("items", number)  # of a list of lists
    unit = {"-": ""}.get(number.get("unit", ""), number.get("unit", ""))
    words = [one["const"] for one in field.get("anyOf", ()) if "const" in one and one is not value]
    kinds = " or ".join([_kind(value), *(f'`"{word}"`' for word in words)]) if link is None else ""
    kind, meaning = link or (kinds, _meaning(key, field, unit))
    cells = (f"`{key}`", kind, unit, _range(number), _default(field, needed), meaning)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def _kind(value: Schema) -> str:
    match value:
        case {"const": one}:
            return f'`"{one}"`'
        case {"enum": names}:
            return " or ".join(f'`"{name}"`' for name in names)
        case {"type": "array", "components": names}:
            return f"{len(names)} {_plural(value['items'])}"
        case {"type": "array", "items": items, "maxItems": _}:
            return f"d {_plural(items)}"
        case {"$ref": _} | {"oneOf": _}:
            return "table"
        case {"type": "array", "items": {"items": items}}:
            return f"list of lists of {_plural(items)}"
        case {"type": "array", "items": {"enum": _}}:
            return "list of names of parameters"
        case {"type": "array", "items": items}:
            return f"list of {_plural(items)}"
        case {"type": "object"}:
            return "[parameters](parameters.md) by name"
    return WORDS[value["type"]]


def _plural(items: Schema) -> str:
    return {"number": "numbers", "integer": "whole numbers", "boolean": "times `true` or `false`"}[items["type"]]


def _range(number: Schema) -> str:
    least, most = number.get("minimum"), number.get("maximum")
    least = None if least in (-GREATEST, 1.0 / GREATEST) else least
    most = None if most == GREATEST else most
    if "exclusiveMinimum" in number:
        low = f"greater than {number['exclusiveMinimum']:g}"
        return low if most is None else f"{low}, at most {_shown(most)}"
    if least is not None and most is not None:
        return f"{_shown(least)} to {_shown(most)}"
    return f"at least {least:g}" if least is not None else ""


def _shown(number: float) -> str:
    return f"{number:,}" if isinstance(number, int) else f"{number:g}"


def _default(field: Schema, needed: bool) -> str:
    if needed:
        return "*needed*"
    default = field.get("default")
    if default is None or isinstance(default, dict) or default == [] or default == GREATEST:
        return ""
    return f"`{json.dumps(default)}`"


def _meaning(key: str, field: Schema, unit: str) -> str:
    """Without its shape and unit, which other columns have."""
    words = " ".join(field.get("description", "").split())
    if key == "shape":
        words = "Which shape it is."
    words = re.sub(r"^\((\w+, )*\w+,?\) ?", "", words)
    words = re.sub(r"^\[[^\]]+\] | \[[^\]]+\](?=[.;,]|$)", "", words) if unit else words
    words = words[:1].upper() + words[1:]
    return words if words.endswith(".") else f"{words}."


def toml(text: str) -> str:
    """An example."""
    return f"```toml\n{text.strip()}\n```\n"
