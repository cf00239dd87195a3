"""From a TOML file and overrides such as ``solver.time_step=0.002`` to a dictionary; and the units of keys."""

import json
import os
import re
import tomllib
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from functools import cache
from typing import Any

from cortado.errors import LONGEST, InputError, SceneError, Words, shown
from cortado.files.disk import SCHEMA, as_path, content, reason

MOST_BYTES = 1_000_000
"""Most bytes of a file: TOML of that size, made to be as bad as it can, takes a few seconds and some hundred MB."""
MOST_PARTS = 10
"""Most parts of a dotted key: the time and the memory that one takes grow with the square of their number."""

_ASIDE = re.compile(
    r'''#[^\n]*|"""(?:[^"\\]|\\.|"(?!""))*+(?:"{3,5}|\Z)|"(?:[^"\\\n]|\\.)*+"?'''
    r"""|'{3}(?:[^']|'(?!''))*+(?:'{3,5}|\Z)|'[^'\n]*+'?""",
    re.DOTALL,
)
"""Finds comments and quoted texts, unfinished ones too."""
_TOO_DEEP = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{MOST_PARTS}}}[\w-]++")
_TWICE = re.compile(r"Cannot declare \('(fluid|phase)',\) twice")
_KEY = re.compile(r"[A-Za-z0-9_-]+(\[\d+\])*(\.[A-Za-z0-9_-]+(\[\d+\])*)*")


def read_toml(
    path: str | os.PathLike[str], overrides: Sequence[str] = (), unread: Sequence[str] = ()
) -> dict[str, Any]:
    """Read a TOML file and return its contents with overrides put in, none of them of the tables that stay ``unread``.
    Raises `SceneError`.

    An override is ``key=value``: ``forces.gravity=[0,-5,0]``, ``fluid.0.upper=[1,1,1]`` or ``fluid[0].upper=[1,1,1]``;
    an entry with a name may be called by it, ``phase.oil.viscosity=0.1``.
    A value that is not TOML is taken as text.
    """
    file = as_path("path", path)
    try:
        text = content(path, MOST_BYTES).decode("utf-8-sig")
        _require_shallow(text, file)
        data = tomllib.loads(text)
    except UnicodeDecodeError as problem:
        line = problem.object[: problem.start].count(b"\n") + 1
        raise _unreadable(file, f"is not text in UTF-8 (at line {line}).") from None
    except (ValueError, RecursionError) as problem:  # among them TOMLDecodeError, which names the line
        problem.__traceback__ = None  # it may have a thousand frames, too many to be pickled where a library does so
        said = _TWICE.sub(r"\g<0>; entries of a list are written [[\1]]", reason(problem))
        raise _unreadable(file, f"is not valid TOML: {said}.") from None
    except OSError as problem:
        beside = _beside(file) if isinstance(problem, FileNotFoundError) else None
        there = f"; did you mean {beside}?" if beside else "."
        raise _unreadable(file, f"cannot be read: {reason(problem)}{there}") from None
    return put_in(data, overrides, file, unread)


def overrides_of(overrides: Sequence[str], tables: Sequence[str]) -> list[str]:
    """Return the overrides, among some, that replace something in tables."""
    return [one for one in overrides if isinstance(one, str) and _table_of(one) in tables]


def _table_of(override: str) -> str:
    return re.split(r"[.\[=\s]", override.strip())[0]


def _beside(file: str) -> str | None:
    """Return the scene file in the same folder whose name is nearly that of one that is not there."""
    folder, name = os.path.split(file)
    try:
        names = [one for one in os.listdir(folder or ".") if one.endswith(".toml")]
    except OSError:
        return None
    close = [f"{name}.toml"] if f"{name}.toml" in names else get_close_matches(name, names, 1, cutoff=0.8)
    return os.path.join(folder, close[0]) if close else None


def put_in(data: dict[str, Any], overrides: Sequence[str], file: str, unread: Sequence[str] = ()) -> dict[str, Any]:
    """Put overrides into the contents of a file, none of them of the tables that stay ``unread``; raise
    `SceneError`."""
    if isinstance(overrides, str):
        sentence = f"must be in a list, as [{shown(overrides)}], as there may be several overrides."
        raise SceneError(file, shown(overrides), sentence=sentence)
    if not isinstance(overrides, Sequence):
        raise InputError(f"overrides is {shown(overrides)}, but must be a list of texts such as 'solver.kind=pcisph'.")
    for idle in overrides_of(overrides, unread):
        key, table = idle.partition("=")[0].strip(), _table_of(idle)
        raise SceneError(file, key, Words("given"), f"left out, as the table [{table}] is not looked at here")
    for override in overrides:
        if not isinstance(override, str):
            sentence = "is no override, which is a text such as 'solver.time_step=0.002'."
            raise SceneError(file, shown(override), sentence=sentence)
        _apply(data, override, file)
    return data


def _unreadable(file: str, sentence: str) -> SceneError:
    return SceneError(file, "", sentence=sentence)


def _require_shallow(text: str, file: str) -> None:
    """Raise `SceneError` for a key of very many parts, wherever it stands, before anything is made of it."""
    plain = _ASIDE.sub(lambda found: "" if found[0].startswith("#") else "text", text)
    deep = _TOO_DEEP.search(plain)
    if deep:
        raise _too_deep(file, deep[0])


def _too_deep(file: str, key: str) -> SceneError:
    return _unreadable(file, f"has a key of more than {MOST_PARTS} parts, {shown(key)}, but no table lies that deep.")


def _apply(data: dict[str, Any], override: str, file: str) -> None:
    """Put one override into the contents of a file."""
    if len(override) > MOST_BYTES:
        sentence = f"is the beginning of {len(override)} characters, but an override must have at most {MOST_BYTES}."
        raise SceneError(file, shown(override), sentence=sentence)
    _require_shallow(override, file)
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals or not _KEY.fullmatch(key):
        raise SceneError(file, shown(override), sentence="is not an override of the form key=value.")
    parts = key.replace("[", ".").replace("]", "").split(".")
    if len(parts) > MOST_PARTS:
        raise _too_deep(file, key)
    field = key if len(key) <= LONGEST else shown(key)
    place: Any = data
    for depth, part in enumerate(parts):
        last = depth == len(parts) - 1
        index: str | int = part
        if isinstance(place, list):
            found = _entry(place, part)
            if found is None:
                entry = ".".join(parts[: depth + 1])
                raise SceneError(file, entry if len(entry) <= LONGEST else shown(entry), part, _entries(place))
            index = found
        elif not isinstance(place, dict):
            raise SceneError(
                file, field, sentence=f"cannot be set, as {'.'.join(parts[:depth])[:LONGEST]} is not a table."
            )
        elif not last:
            place.setdefault(part, {})
        if last:
            place[index] = _value(text.strip())
        else:
            place = place[index]


def _entry(tables: list[Any], part: str) -> int | None:
    """Return the index of an entry in a list, given its index or its name; None if there is none."""
    if part.isdecimal():
        return int(part) if len(part) <= 9 and int(part) < len(tables) else None
    return next((k for k, table in enumerate(tables) if part in _names([table])), None)


def _entries(tables: list[Any]) -> str:
    """Say in words how entries of a list are addressed."""
    if not tables:
        return "left out, as the list is empty"
    names = _names(tables)
    wanted = f"an index from 0 to {len(tables) - 1}"
    return f"{wanted}, or the name {' or '.join(names)}" if names else wanted


def _names(tables: list[Any]) -> list[str]:
    """Return the names of entries that have one, or the kinds of forces that have no other name."""
    found = (table.get("name", table.get("kind")) for table in tables if isinstance(table, dict))
    return [str(name) for name in found if name is not None]


def _value(text: str) -> Any:
    """Parse a text as a TOML value, or return the text itself."""
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return parsed["value"] if parsed.keys() == {"value"} else text


JsonSchema = dict[str, Any]


def unit_of(key: str) -> str:
    """Return the unit of the value of a scene with a dotted key, such as "Pa s" of ``phase.0.viscosity``; nothing where
    it has none, or where shapes of a body have different ones."""
    found = list(_choices(_schema()))
    for part in key.split("."):
        found = [choice for one in found for choice in _choices(_part(one, part))]
    units = {choice["unit"] for one in found for choice in (one, *_choices(one.get("items", {}))) if "unit" in choice}
    return units.pop() if len(units) == 1 and units != {"-"} else ""


@cache
def _schema() -> JsonSchema:
    """Read the shipped JSON schema, which `Scene` is compared with in the tests."""
    read: JsonSchema = json.loads(SCHEMA.read_text(encoding="utf-8"))
    return read


def _part(schema: JsonSchema, part: str) -> JsonSchema:
    """Return the schema of an entry of a list, by its number, or of a table's field."""
    found: JsonSchema = schema.get("items", {}) if part.isdigit() else schema.get("properties", {}).get(part, {})
    return found


def _choices(schema: JsonSchema) -> Iterator[JsonSchema]:
    """Yield a schema, and those of which it has one or all."""
    yield schema
    if "$ref" in schema:
        yield from _choices(_schema()["$defs"][schema["$ref"].rpartition("/")[2]])
    for word in ("anyOf", "oneOf", "allOf"):
        for one in schema.get(word, ()):
            yield from _choices(one)
