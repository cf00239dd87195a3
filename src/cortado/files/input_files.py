"""Files of users: only regular ones of a modest size are read, as a pipe may wait and a device may go on for ever."""

import errno
import os
import stat
from typing import Any

from cortado.errors import InputError, shown

OTHERS = (
    (stat.S_ISDIR, "a directory"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
"""What a path may lead to that is no regular file."""


def as_path(what: str, value: Any) -> str:
    """A path as text, or an `InputError` in a sentence that begins with ``what``; a number is none, though Python opens
    it as a file that is already open."""
    if isinstance(value, (str, os.PathLike)):
        path = os.fspath(value)
        if isinstance(path, str) and path:
            return path
    raise InputError(f"{what} is {shown(value)}, but must be the path of a file or a folder.")


def regular_file(path: str | os.PathLike[str], most: int) -> os.stat_result:
    """What is known of a file that may be read; links are followed.

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
