"""From ``--set solver.time_step=0.001,0.002`` to combinations of values, each with the name of its folder."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from itertools import product
from math import prod

from cortado.errors import InputError, shown

MOST = 100_000
"""Combinations; more are taken for a mistake."""
_LONGEST_NAME = 120
"""Characters of a folder's name."""
_PAIRS = {"[": "]", "{": "}"}
_PLAIN = re.compile(r"[A-Za-z0-9_=,.+-]+")
"""Names of folders that need no quotes in a shell."""


@dataclass(frozen=True)
class Combination:
    """One value for each key of a sweep."""

    values: tuple[tuple[str, str], ...]
    """(key, value as the user wrote it) in the order of the options."""

    @property
    def overrides(self) -> list[str]:
        """As `cortado run` and `cortado optimise` take them."""
        return [f"{key}={value}" for key, value in self.values]

    @property
    def name(self) -> str:
        """Of its folder: the values; where these are long or strange, some of them with a checksum. It does not depend
        on the other combinations of a sweep."""
        name = ",".join(self.overrides)
        if _PLAIN.fullmatch(name) and len(name) <= _LONGEST_NAME and not name.startswith(("-", ".")):
            return name
        plain = re.sub(r"[^A-Za-z0-9_=,.+-]+", "_", name).lstrip("-.")[:_LONGEST_NAME]
        return f"{plain}-{sha256(name.encode()).hexdigest()[:8]}"


def combinations(options: Sequence[str], zipped: Sequence[str] = ()) -> list[Combination]:
    """Every combination of the values of all keys, the first key changing slowest; the values of ``zipped`` keys go
    together, the first of one with the first of the others, and change fastest. Raises `InputError`."""
    if not options and not zipped:
        raise InputError("--set is missing, but must name what changes, such as --set solver.time_step=0.001,0.002.")
    keys, together = _values(options, "--set"), _values(zipped, "--zip")
    if both := keys.keys() & together.keys():
        raise InputError(f"--zip gives {min(both)}, which --set gives too, but must give other keys.")
    lengths = {len(values) for values in together.values()}
    if len(lengths) > 1:
        told = ", ".join(f"{len(values)} of {key}" for key, values in together.items())
        raise InputError(f"--zip gives {told}, but must give as many values of each, as they go together.")
    rows = [tuple(zip(together, row, strict=True)) for row in zip(*together.values(), strict=True)]
    number = prod(map(len, keys.values())) * max(len(rows), 1)
    if number > MOST:
        raise InputError(f"--set makes {number:,} combinations, but there may be {MOST:,} at most.")
    own = [tuple(zip(keys, values, strict=True)) for values in product(*keys.values())]
    return [Combination((*values, *row)) for values in own for row in rows or [()]]


def _values(options: Sequence[str], name: str) -> dict[str, list[str]]:
    """The values of each key; raises `InputError`, in which the option has its name."""
    keys: dict[str, list[str]] = {}
    for option in options:
        key, equals, text = option.partition("=")
        key, values = key.strip(), [value.strip() for value in _split(text)]
        if not equals or not key or not all(values):
            raise InputError(f"{name} is {shown(option)}, but must have the form key=value,value.")
        if key in keys:
            raise InputError(f"{name} gives {key} twice, but must give each key once, with all its values.")
        if len(set(values)) < len(values) and name == "--set":
            raise InputError(f"{name} is {shown(option)}, but must give each value of {key} once.")
        keys[key] = values
    return keys


def _split(text: str) -> list[str]:
    """Text at its commas, but not at those within brackets or quotes."""
    parts, closing, quote = [""], [], ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in _PAIRS:
            closing.append(_PAIRS[letter])
        elif closing and letter == closing[-1]:
            closing.pop()
        elif letter == "," and not closing:
            parts.append("")
            continue
        parts[-1] += letter
    return parts
