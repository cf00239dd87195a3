"""In which values scenes differ, and what tells each of several runs from the others in a few words."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from cortado.errors import shown
from cortado.runs.run_files import computed
from cortado.scene.scene import Scene
from cortado.scene.units import unit_of

_MISSING = "missing"
MOST_KEYS, LONGEST = 3, 64
"""Values and characters of a label; where it has more, it is another one."""


def differences(one: Any, other: Any, name: str = "") -> dict[str, list[Any]]:
    """Both values of whatever differs, by dotted names."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        pairs = {key: (one.get(key, _MISSING), other.get(key, _MISSING)) for key in {**one, **other}}
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other) and _has_tables(one):
        pairs = {str(k): pair for k, pair in enumerate(zip(one, other, strict=True))}
    else:
        return {} if one == other else {name: [one, other]}
    before = f"{name}." if name else ""
    return {
        key: pair for part, values in pairs.items() for key, pair in differences(*values, f"{before}{part}").items()
    }


def _has_tables(values: list[Any]) -> bool:
    return any(isinstance(value, Mapping) for value in values)


def labels(scenes: Sequence[Scene], otherwise: Sequence[str]) -> list[str]:
    """What each of several scenes is called beside the others: its name if all names differ, or else the values in
    which the scenes differ, such as ``viscosity = 0.1 Pa s``. ``otherwise``: what they are called where no values
    differ, or too many."""
    tables = [computed(json.loads(scene.to_json())) for scene in scenes]
    keys = list(dict.fromkeys(key for table in tables[1:] for key in differences(tables[0], table)))
    short = [key.rpartition(".")[2] for key in keys]
    names = short if len(set(short)) == len(keys) else keys
    by_value = [
        ", ".join(f"{name.replace('_', ' ')} = {_value(table, key)}" for name, key in zip(names, keys, strict=True))
        for table in tables
    ]
    few = len(keys) <= MOST_KEYS and max(map(len, by_value)) <= LONGEST
    for found in ([scene.name for scene in scenes], by_value if few else []):
        if len(set(found)) == len(scenes):
            return found
    return list(otherwise)


def _value(table: Any, key: str) -> str:
    """What a table of a scene has under a dotted name, in words."""
    for part in key.split("."):
        try:
            table = table[int(part)] if isinstance(table, list) else table[part]
        except (LookupError, TypeError, ValueError):
            return "none"
    if table is None or isinstance(table, str):
        return table or "none"
    text = f"{table:g}" if isinstance(table, float) else shown(table)
    return f"{text} {unit_of(key)}".rstrip()
