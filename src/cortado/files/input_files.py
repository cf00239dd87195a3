"""Files that are read: of users only regular ones of a modest size, as a pipe may wait and a device may go on for ever;
and those that come with Cortado."""

import csv
import errno
import io
import os
import stat
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import InputError, shown

OTHERS = (
    (stat.S_ISDIR, "a directory"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
"""Kinds of files that are no regular ones, with their names in a sentence."""


def as_path(what: str, value: Any) -> str:
    """A path as text, or an `InputError` in a sentence that begins with ``what``; a number is none, though Python opens
    it as a file that is already open."""
    if isinstance(value, (str, os.PathLike)):
        path = os.fspath(value)
        if isinstance(path, str) and path:
            return path
    raise InputError(f"{what} is {shown(value)}, but must be the path of a file or a folder.")


def regular_file(path: str | os.PathLike[str], most: int) -> os.stat_result:
    """The size and times of a file that may be read; links are followed.

    Raises `OSError`, whose ``strerror`` says why in words, if it is no regular file, or has more bytes than ``most``.
    """
    try:
        found = os.stat(path)
    except ValueError:  # a character that no name has
        raise OSError(errno.ENOENT, "no file can have this name") from None
    if not stat.S_ISREG(found.st_mode):
        kind = next((words for is_kind, words in OTHERS if is_kind(found.st_mode)), "something else")
        raise OSError(errno.EINVAL, f"it is {kind}, but must be a regular file")
    if found.st_size > most:
        raise _too_large(found.st_size, most)
    return found


def content(path: str | os.PathLike[str], most: int) -> bytes:
    """The bytes of a regular file; raises `OSError` as `regular_file` does."""
    regular_file(path, most)
    with open(path, "rb") as file:
        found = file.read(most + 1)
    if len(found) > most:  # it grew, or the system makes it up as it is read
        raise _too_large(len(found), most)
    return found


def reason(problem: BaseException) -> str:
    """Why a file could not be read, on one line, for a sentence."""
    text = getattr(problem, "strerror", None) or str(problem) or type(problem).__name__
    return " ".join(text.split()).rstrip(".")


def _too_large(size: int, most: int) -> OSError:
    return OSError(errno.EFBIG, f"it has {size:,} bytes, but must have at most {most:,}")


MOST_BYTES = 2**28
"""The largest table in CSV that is read."""


def read_columns(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The columns of a table in CSV, (lines,) by the names in its first line; an entry that is left out is NaN. Raises
    `InputError` for a file that is no such table."""
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


_PACKAGE = Path(__file__).parents[1]
SCHEMA = _PACKAGE / "scene.schema.json"


def examples_folder() -> Path:
    """The folder of examples, in the package where a wheel was installed, or in the repository."""
    installed = _PACKAGE / "examples"
    return installed if installed.is_dir() else _PACKAGE.parents[1] / "examples"
