"""Tables in Markdown that describe the keys of a TOML table, from the JSON schema of the table's model."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from cortado.scene.tables import GREATEST

Schema = Mapping[str, Any]
Row = tuple[str, str, str, str]
"""Name of a key, its type, its default, and its meaning."""
WORDS = {"number": "number", "integer": "whole number", "boolean": "`true` or `false`", "string": "text"}
HEAD = "| key | what it is | if left out | meaning |\n|---|---|---|---|\n"
TAGS = ("shape", "kind")
"""Keys whose value selects one of several tables."""


def rows(
    schema: Schema,
    links: Mapping[str, tuple[str, str]] | None = None,
    defaults: Mapping[str, str] | None = None,
) -> str:
    """Return a table with a row for each key.

    Args:
        schema: that of the table, part of `model_json_schema()`.
        links: for keys that are tables themselves, where the page describes them, and what they are.
        defaults: of keys whose default depends on others what it is, in words.
    """
    found, defaults = rows_of(schema, links or {}), defaults or {}
    return shown(
        (name, kind, defaults.get(key, default), meaning) for key, (name, kind, default, meaning) in found.items()
    )


def rows_of(schema: Schema, links: Mapping[str, tuple[str, str]]) -> dict[str, Row]:
    """Return the row of each key, by the name of the key."""
    needed = [*schema.get("required", []), "shape"]
    return {key: _row(key, field, key in needed, links.get(key)) for key, field in schema["properties"].items()}


def shown(found: Iterable[Row]) -> str:
    """Return rows as a Markdown table, or an empty text without rows."""
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |\n" for row in found]
    return HEAD + "".join(lines) if lines else ""


def split(
    schemas: Iterable[Schema], links: Mapping[str, tuple[str, str]] | None = None
) -> tuple[list[Row], list[list[Row]]]:
    """Return the rows that several tables share, each row once, and the other rows of each table.

    A shared row that some tables lack names the tables with this row. The key that selects a table gives one row.
    """
    tables = [rows_of(schema, links or {}) for schema in schemas]
    tags = [key for key in TAGS if key in tables[0]]
    names = [" ".join(table[tag][1] for tag in tags) for table in tables]
    common, held = [_tag_row([table.pop(tag) for table in tables]) for tag in tags], set[Row]()
    for row in dict.fromkeys(row for table in tables for row in table.values()):
        having = [name for name, table in zip(names, tables, strict=True) if row in table.values()]
        if len(having) > 1:
            held.add(row)
            common.append((*row[:3], _of_some(row[3], having, names)))
    return common, [[row for row in table.values() if row not in held] for table in tables]


def _tag_row(found: Sequence[Row]) -> Row:
    """Join rows of the key that selects a table into one. The row shows a default if only one table has a default."""
    defaults = {default for _, _, default, _ in found} - {"*needed*"}
    names = listed([name for _, name, _, _ in found])
    return found[0][0], names, defaults.pop() if len(defaults) == 1 else "*needed*", "Which of them it is."


def _of_some(meaning: str, having: Sequence[str], names: Sequence[str]) -> str:
    """Add the names of the tables with the key to a meaning, or the fewer names of the tables without the key."""
    lacking = [name for name in names if name not in having]
    if not lacking:
        return meaning
    fewer, word = (having, "With") if len(having) <= len(lacking) else (lacking, "Not with")
    return f"{meaning} {word} {listed(fewer)}."


def listed(names: Sequence[str]) -> str:
    """Join names with commas and "or"."""
    return " or ".join([", ".join(names[:-1]), names[-1]] if names[1:] else names)


def _row(key: str, field: Schema, needed: bool, link: tuple[str, str] | None) -> Row:
    value = field["anyOf"][0] if "anyOf" in field else field
    number = value.get("items", value)
    number = number.get("items", number)  # of a list of lists
    unit = {"-": ""}.get(number.get("unit", ""), number.get("unit", ""))
    words = [one["const"] for one in field.get("anyOf", ()) if "const" in one and one is not value]
    if link:
        return f"`{key}`", link[0], _default(field, needed), link[1]
    between = _range(number)
    measure = (f" [{unit}]" if unit else "") + (f", {between}" if between else "")
    own = _kind(value)
    if "maxItemsIn2D" in value:
        own = f"{'3 or 9' if value['maxItems'] == 9 else '3'} numbers, in 2-D one"
    kinds = (", or " if between else " or ").join([f"{own}{measure}", *(f'`"{word}"`' for word in words)])
    return f"`{key}`", kinds, _default(field, needed), _meaning(key, field, unit)


def _kind(value: Schema) -> str:
    match value:
        case {"const": one}:
            return f'`"{one}"`'
        case {"enum": names}:
            return listed([f'`"{name}"`' for name in names])
        case {"type": "array", "components": names}:
            return f"{len(names)} {_plural(value['items'])}"
        case {"type": "array", "items": items, "maxItems": _}:
            return f"d {_plural(items)}"
        case {"$ref": _} | {"oneOf": _}:
            return "table"
        case {"type": "array", "items": {"items": items}}:
            return f"list of lists of {_plural(items)}"
        case {"type": "array", "items": {"enum": _}}:
            return "list of names"
        case {"type": "array", "items": items}:
            return f"list of {_plural(items)}"
        case {"type": "object"}:
            return "[parameters](parameters.md) by name"
    return WORDS[value["type"]]


def _plural(items: Schema) -> str:
    words = {"number": "numbers", "integer": "whole numbers", "boolean": "times `true` or `false`", "string": "names"}
    return words[items["type"]]


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
    """Return a key's description without shape and unit, which have their own columns."""
    words = " ".join(field.get("description", "").split())
    if key == "shape":
        words = "Which shape it is."
    words = re.sub(r"^\((\w+, )*\w+,?\) ?", "", words)
    words = re.sub(r"^\[[^\]]+\] | \[[^\]]+\](?=[.;,]|$)", "", words) if unit else words
    words = words if re.match(r"[a-z]\b", words) else words[:1].upper() + words[1:]  # a symbol stays as it is
    return words if words.endswith(".") else f"{words}."


def toml(text: str) -> str:
    """Return an example as a code block."""
    return f"```toml\n{text.strip()}\n```\n"
