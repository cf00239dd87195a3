"""Sweeps: combinations of values from --set solver.time_step=0.001,0.002, a table of the results, extrapolation."""

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from itertools import product
from math import isclose, log, prod
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import InputError, shown
from cortado.files.disk import write_atomically

MOST_COMBINATIONS = 100_000
"""Most combinations of a sweep; more are taken for a mistake."""
_LONGEST_NAME = 120
"""Most characters of a folder's name."""
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
        """Return the values as options ``--set`` of `cortado run` and `cortado optimise`."""
        return [f"{key}={value}" for key, value in self.values]

    @property
    def name(self) -> str:
        """Return the name of its folder: the values; where these are long or strange, some of them with a checksum. It
        does not depend on the other combinations of a sweep."""
        name = ",".join(self.overrides)
        if _PLAIN.fullmatch(name) and len(name) <= _LONGEST_NAME and not name.startswith(("-", ".")):
            return name
        plain = re.sub(r"[^A-Za-z0-9_=,.+-]+", "_", name).lstrip("-.")[:_LONGEST_NAME]
        return f"{plain}-{sha256(name.encode()).hexdigest()[:8]}"


def combinations(options: Sequence[str], zipped: Sequence[str] = ()) -> list[Combination]:
    """Return every combination of the values of all keys, the first key changing slowest; the values of ``zipped`` keys
    go together, the first of one with the first of the others, and change fastest. Raises `InputError`."""
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
    if number > MOST_COMBINATIONS:
        raise InputError(f"--set makes {number:,} combinations, but there may be {MOST_COMBINATIONS:,} at most.")
    own = [tuple(zip(keys, values, strict=True)) for values in product(*keys.values())]
    return [Combination((*values, *row)) for values in own for row in rows or [()]]


def _values(options: Sequence[str], name: str) -> dict[str, list[str]]:
    """Return the values of each key; raise `InputError` in a sentence with the name of the option."""
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
    """Split a text at its commas, but not at those within brackets or quotes."""
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


NAME = "sweep.csv"
MOST_NUMBERS = 12
"""Most numbers of a list that the table shows; longer ones are in the result.json of each folder alone."""


def write_table(folder: Path, combinations: Sequence[Combination], results: Mapping[int, Mapping[str, Any]]) -> None:
    """Write the table, whole or not at all.

    ``results``: what came out, as in result.json, by the number of the combination. Columns: the folder, every key that
    changes, "done" or "failed", every number that came out, and why it failed.
    """
    rows = [
        {
            "folder": combinations[number].name,
            **dict(combinations[number].values),
            "status": "failed" if failed(result) else "done",
            **_flat({name: value for name, value in result.items() if name != "failures"}),
            "failures": " ".join(result["failures"]),
        }
        for number, result in sorted(results.items())
    ]
    columns = list(dict.fromkeys(column for row in rows for column in row if column != "failures")) + ["failures"]
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(folder / NAME, text.getvalue())


def folders_in(folder: Path) -> list[str]:
    """Return the names of the folders in the table of a sweep, in its order; none without a table that can be read."""
    try:
        with open(folder / NAME, newline="", encoding="utf-8") as file:
            return [row["folder"] for row in csv.DictReader(file)]
    except (OSError, ValueError, KeyError, csv.Error):
        return []


def failed(result: Mapping[str, Any]) -> bool:
    """Return True if a result has failures."""
    return bool(result["failures"])


def _flat(result: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Return tables within tables as one, with names joined by full stops; short lists as JSON, longer ones not."""
    found: dict[str, Any] = {}
    for name, value in result.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{before}{name}.")
        elif not isinstance(value, list):
            found[f"{before}{name}"] = value
        elif len(text := json.dumps(value)) and text.count(",") < MOST_NUMBERS:
            found[f"{before}{name}"] = text
    return found


LEAST_ORDER, MOST_ORDER = 1e-3, 20.0
"""Range of orders in which one is looked for."""
LOWEST, HIGHEST = 0.5, 2.0
"""Orders that are believed; the methods have 1 to 2. Values with another one are not in the range where differences
shrink by a power of the size."""
ROUND_OFF = 1e-6
"""Relative deviation within which an order at either end of the range is believed."""
SAFE, UNSURE = 1.25, 3.0
"""Safety factors of Roache (1994): of three sizes whose order is believed, and of all others."""


@dataclass(frozen=True)
class Extrapolation:
    """An extrapolation of a number f(h) = limit + C h^order from its values at the three finest sizes h.

    Source: L. F. Richardson, Phil. Trans. R. Soc. A 210 (1911), 307; the grid convergence index of P. J. Roache, J.
    Fluids Eng. 116 (1994), 405, by the procedure of I. B. Celik et al., J. Fluids Eng. 130 (2008), 078001, for sizes
    whose ratios differ. Where there is no order, the error is that of L. Eca and M. Hoekstra, J. Comput. Phys. 262
    (2014), 104: three times the greatest difference.
    """

    order: float | None
    """Observed order; None where there is none."""
    limit: float | None
    """Limit in the values' unit, by the order within `LOWEST` and `HIGHEST` that is nearest to the observed one."""
    error: float | None
    """Error of the value at the finest size, in its unit, with a safety factor: the limit is probably no further away.
    None where a value is not a number."""
    flag: str = ""
    """Why no order is observed, or the observed one not believed, in words; empty in the asymptotic range."""

    @classmethod
    def of(cls, sizes: Sequence[float], values: Sequence[float]) -> "Extrapolation":
        """Extrapolate ``values`` (k,) at ``sizes`` (k,), k of at least 3, the finest one last."""
        (h_3, h_2, h_1), (f_3, f_2, f_1) = sizes[-3:], values[-3:]
        fine, coarse = f_2 - f_1, f_3 - f_2
        if not np.isfinite([fine, coarse]).all():
            return cls(None, None, None, "not a number")
        widest = UNSURE * float(np.ptp([f_1, f_2, f_3]))
        if fine == 0.0:
            return cls(None, f_1, widest, "the two finest are equal")
        if fine * coarse < 0.0:
            return cls(None, None, widest, "it goes up and down")
        ratio, r_21, r_32 = coarse / fine, h_2 / h_1, h_3 / h_2
        if ratio <= log(r_32) / log(r_21):
            return cls(None, None, widest, "it does not come to rest")

        def excess(p: float) -> float:
            return float(r_21**p * (r_32**p - 1.0) / (r_21**p - 1.0) / ratio - 1.0)

        if excess(LEAST_ORDER) * excess(MOST_ORDER) > 0.0:
            return cls(None, None, widest, "it has no order that can be told")
        from scipy.optimize import brentq

        order = float(brentq(excess, LEAST_ORDER, MOST_ORDER, xtol=1e-12))
        used = min(max(order, LOWEST), HIGHEST)
        away, is_believed = fine / (r_21**used - 1.0), isclose(used, order, rel_tol=ROUND_OFF)
        flag = "" if is_believed else f"the order is taken as {used:g}"
        return cls(order, f_1 - away, (SAFE if is_believed else UNSURE) * abs(away), flag)
