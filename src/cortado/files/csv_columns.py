"""Tables of numbers in CSV files, with a line of names above them."""

import csv
import io
import os

import numpy as np

from cortado.errors import InputError, shown
from cortado.files.input_files import content, reason

MOST_BYTES = 2**28
"""Of a file."""


def read_columns(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """(lines,) by the names in the first line; an entry that is left out is NaN. Raises `InputError`."""
    try:
        text = content(path, MOST_BYTES).decode("utf-8-sig")
        lines = [line for line in csv.reader(io.StringIO(text)) if any(entry.strip() for entry in line)]
    except (OSError, UnicodeDecodeError, csv.Error) as problem:
        raise InputError(f"{path} cannot be read: {reason(problem)}.") from None
    names = [name.strip() for name in lines[0]] if lines else []
    if len(names) == 1 and ";" in names[0]:
        raise InputError(f"{path} has semicolons between its columns, but must have commas, and points in numbers.")
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{path} has {names.count(name)} columns {name!r}, but must have each of them once.")
    if len(lines) < 2 or not all(names):
        raise InputError(f"{path} must have a line of different names, such as time,force_x, and lines of numbers.")
    rows = []
    for number, line in enumerate(lines[1:], 2):
        if len(line) != len(names):
            raise InputError(f"{path}: line {number} has {len(line)} entries, but must have {len(names)}.")
        rows.append([_number(entry, f"{path}: line {number}, {name}") for entry, name in zip(line, names, strict=True)])
    return dict(zip(names, np.array(rows).T, strict=True))


def _number(entry: str, where: str) -> float:
    if not entry.strip():
        return np.nan
    try:
        return float(entry)
    except ValueError:
        raise InputError(f"{where} is {shown(entry)}, but must be a number, or left out.") from None
