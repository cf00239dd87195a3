"""Files that appear whole or not at all, and disks that refuse: one sentence instead of a traceback."""

from __future__ import annotations

import errno
import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cortado.errors import ComputationError, InputError

UNFINISHED = ".cortado-*.tmp"
"""Pattern of the names under which files are written before they appear; a killed process leaves them behind."""
_REFUSALS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
"""What a disk answers that is full, has a quota or a limit, or is broken."""


def unfinished(path: Path) -> Path:
    """A name beside `path` that nobody can guess; open it with "x", which follows no links."""
    return path.with_name(UNFINISHED.replace("*", secrets.token_hex(8)))


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes a whole file under a temporary name and then renames it, so that no reader meets half of it.

    Raises:
        ComputationError: the disk is full.
        InputError: there can be no such file, or something of that name is no file, such as a device.
    """
    temporary = unfinished(path)
    with sentences(path):
        if path.exists() and not path.is_file() and not path.is_dir():
            raise InputError(f"{path} is a device or a pipe, which would be replaced; choose the name of a file.")
        try:
            with open(temporary, "xb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


def is_taken(path: Path) -> bool:
    """Whether something of that name is there, also a link that leads nowhere. Raises `InputError` where nothing can be
    looked for, as with a name that is too long."""
    with sentences(path):
        try:
            path.lstat()
        except (FileNotFoundError, NotADirectoryError):
            return False
        return True


def write_fully(file: Any, content: bytes) -> None:
    """Writes to a file without a buffer, which may take a part at a time."""
    rest = memoryview(content)
    while rest:
        rest = rest[file.write(rest) :]


def parsed_json(text: bytes) -> Any:
    """What a text in JSON says; raises `ValueError`, also for one that is nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


@contextmanager
def sentences(path: Path) -> Iterator[None]:
    """What goes wrong with the disk within becomes a sentence about this file or folder.

    Raises:
        ComputationError: the disk is full or broken.
        InputError: any other `OSError`, such as a folder that may not be written.
    """
    try:
        yield
    except OSError as problem:
        reason = problem.strerror or problem
        if problem.errno in _REFUSALS:
            raise ComputationError(
                f"{path} cannot be written: {reason}; free some space, or choose another place."
            ) from problem
        raise InputError(f"{path} cannot be written: {reason}; choose another place.") from problem
