"""Every key of every table, found in the models themselves, and values in its place."""

import inspect
import json
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, get_args

import h5py
import numpy as np

from cortado import CortadoWarning
from cortado.scene.tables import Table

LATER = ("times", "rotations", "extinction_schedule")
"""Lists whose first entry has to be what it is."""
json_schema = cache(lambda table: table.model_json_schema())
Key = tuple[str, str]
"""The name of the table that declares a key, and the key."""


def tables_in(annotation: Any) -> Iterator[type[Table]]:
    """Those that the type of a field may be, or hold."""
    if isinstance(annotation, type) and issubclass(annotation, Table):
        yield annotation
    for part in get_args(annotation):
        yield from tables_in(part)


def keys_of(*models: type[Table]) -> set[Key]:
    """Of the models and of all tables within them, those keys that are no tables."""
    found, seen, left = set(), set(), list(models)
    while left:
        table = left.pop()
        for name, field in table.model_fields.items() if table not in seen else ():
            within = list(tables_in(field.annotation))
            left += within
            found |= set() if within else {declared_in(table, name)}
        seen.add(table)
    return found


def declared_in(table: type[Table], name: str) -> Key:
    """A key with the table that declares it, of which others inherit it."""
    return next(one.__name__ for one in table.__mro__ if name in inspect.get_annotations(one)), name


def places(value: Any, path: tuple = ()) -> Iterator[tuple]:
    """The path of every key that is given in a table, and in those within it."""
    if isinstance(value, Table):
        written = value.model_dump()
        for name, field in type(value).model_fields.items():
            if list(tables_in(field.annotation)):
                yield from places(getattr(value, name), (*path, name))
            elif written[name] not in (None, ()):
                yield (*path, name)
    elif isinstance(value, tuple):
        for k, one in enumerate(value):
            yield from places(one, (*path, k))


def table_at(made: Table, path: tuple) -> type[Table]:
    table: Any = made
    for part in path[:-1]:
        table = table[part] if isinstance(part, int) else getattr(table, part)
    return type(table)


def key_at(made: Table, path: tuple) -> Key:
    return declared_in(table_at(made, path), path[-1])


def put(data: Any, path: tuple, made: Table) -> None:
    """Another value of the same kind in the place of that at a path, which is the default where none is given."""
    table, there, name = data, made, path[-1]
    for part in path[:-1]:
        there = there[part] if isinstance(part, int) else getattr(there, part)
        table = table[part] if isinstance(part, int) or part in table else table.setdefault(part, {})
    schema = json_schema(type(there))["properties"][name]
    value = table[name] if name in table else there.model_dump()[name]
    table[name] = changed(value, schema, -1 if name in LATER else 0)


def changed(value: Any, schema: dict[str, Any], index: int = 0) -> Any:
    """Of a list its entry with that index, of a list of lists the last one's first."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return next(one for one in reversed(_words(schema) or ["other", "else"]) if one != value)
    if isinstance(value, int):
        return value + 1
    if isinstance(value, float):
        return 0.9 * value if value else 0.01
    if isinstance(value, dict):
        return {name: changed(one, {}) for name, one in value.items()}
    which = -1 if isinstance(value[0], list) else index
    return [changed(one, schema.get("items", {})) if k == which % len(value) else one for k, one in enumerate(value)]


def _words(schema: dict[str, Any]) -> list[str]:
    return [word for part in (schema, *schema.get("anyOf", ())) for word in part.get("enum", ())]


def same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and np.array_equal(one, other, equal_nan=True)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[name], other[name]) for name in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    if hasattr(one, "__dict__"):
        return same(vars(one), vars(other))
    return bool(one == other)


def numbers(path: Path) -> Any:
    """In a file that a command leaves, but times that it took."""
    if path.suffix == ".json" and path.name not in ("environment.json", "dataset.json", "scene.json"):
        return {name: value for name, value in json.loads(path.read_text()).items() if "seconds" not in name}
    if path.suffix == ".h5":
        with h5py.File(path) as file:
            found = {}
            file.visititems(lambda name, one: found.update({name: one[()]} if isinstance(one, h5py.Dataset) else {}))
            return found
    return path.read_text() if path.name == "metrics.jsonl" else None


def told(make: Any) -> tuple[Any, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CortadoWarning)
        return make(), sorted(str(one.message) for one in caught)


def given(made: Table) -> Any:
    """The contents of a table without what is left out, as a file has them."""
    return _given(json.loads(made.model_dump_json()))


def _given(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _given(one) for name, one in value.items() if one is not None}
    return [_given(one) for one in value] if isinstance(value, list) else value
