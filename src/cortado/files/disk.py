"""Read and write files. User files must be regular files of limited size, because pipes may block and devices may have
no end. Files are written completely or not at all. Only one process at a time writes to a folder."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import secrets
import socket
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cortado.errors import ComputationError, InputError, shown

Found = TypeVar("Found")
OTHERS = (
    (stat.S_ISDIR, "a directory"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def as_path(what: str, value: Any) -> str:
    """Raises `InputError` also for a number, because Python interprets a number as an open file."""
    if isinstance(value, (str, os.PathLike)):
        path = os.fspath(value)
        if isinstance(path, str) and path:
            return path
    raise InputError(f"{what} is {shown(value)}, but must be the path of a file or a folder.")


def regular_file(path: str | os.PathLike[str], most: int) -> os.stat_result:
    """Raises `OSError` unless the file is regular and has at most ``most`` bytes."""
    try:
        found = os.stat(path)
    except ValueError:  # a character that no name has
        raise OSError(errno.ENOENT, "no file can have this name") from None
    if not stat.S_ISREG(found.st_mode):
        kind = next((words for is_kind, words in OTHERS if is_kind(found.st_mode)), "something else")
        raise OSError(errno.EINVAL, f"it is {kind}, but must be a regular file")
    _check_size(found.st_size, most)
    return found


def cached_by_file(kept: int, most: int) -> Callable[[Callable[..., Found]], Callable[..., Found]]:
    """Return a decorator that caches the last ``kept`` results of a function of a path until the file changes. The
    decorated function raises `InputError` unless the file is regular and has at most ``most`` bytes."""

    def decorated(read: Callable[..., Found]) -> Callable[..., Found]:
        known = lru_cache(kept)(lambda version, path, *more: read(path, *more))

        @wraps(read)
        def call(path: str, *more: Any) -> Found:
            try:
                stat = regular_file(path, most)
            except OSError as problem:
                raise InputError(f"{path!r} cannot be opened ({reason(problem)}).") from None
            return known((stat.st_mtime_ns, stat.st_size), path, *more)

        return call

    return decorated


def content(path: str | os.PathLike[str], most: int) -> bytes:
    regular_file(path, most)
    with open(path, "rb") as file:
        found = file.read(most + 1)
    _check_size(len(found), most)  # it grew, or the system makes it up as it is read
    return found


def _check_size(size: int, most: int) -> None:
    if size > most:
        raise OSError(errno.EFBIG, f"it has {size:,} bytes, but must have at most {most:,}")


def reason(problem: BaseException) -> str:
    text = getattr(problem, "strerror", None) or str(problem) or type(problem).__name__
    return " ".join(text.split()).rstrip(".")


MOST_BYTES = 2**28


def read_columns(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Return the columns of a CSV table as arrays (lines,), by the names in the first line. Empty cells become NaN."""
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


def name_and_unit(head: str) -> tuple[str, str | None]:
    name, bracket, unit = head.partition("[")
    return name.strip(), unit.rstrip().removesuffix("]").strip() if bracket else None


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
    installed = _PACKAGE / "examples"
    return installed if installed.is_dir() else _PACKAGE.parents[1] / "examples"


REPLAY_LOG = "replay.log"
"""Name of the file with the evaluations of a search."""
UNFINISHED = ".cortado-*.tmp"
"""Pattern of the names of temporary files. A killed process may leave temporary files behind."""
_REFUSALS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def unfinished(path: Path) -> Path:
    """Return an unpredictable name in the same folder. Open the file with mode "x", which follows no links."""
    return path.with_name(UNFINISHED.replace("*", secrets.token_hex(8)))


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file under a temporary name and rename it, so that readers never see an incomplete file."""
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
    """A broken link counts as an existing file."""
    with sentences(path):
        try:
            path.lstat()
        except (FileNotFoundError, NotADirectoryError):
            return False
        return True


def write_fully(file: Any, content: bytes) -> None:
    """Write all bytes to an unbuffered file, which may accept only some bytes per call."""
    rest = memoryview(content)
    while rest:
        rest = rest[file.write(rest) :]


def parsed_json(text: bytes) -> Any:
    """Raises `ValueError` also for excessive nesting."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


@contextmanager
def sentences(path: Path) -> Iterator[None]:
    """Turn an `OSError` into a `ComputationError` for a full or broken disk, and otherwise into an `InputError`."""
    try:
        yield
    except OSError as problem:
        reason = problem.strerror or problem
        if problem.errno in _REFUSALS:
            raise ComputationError(
                f"{path} cannot be written: {reason}; free some space, or choose another place."
            ) from problem
        raise InputError(f"{path} cannot be written: {reason}; choose another place.") from problem


def make_folder(path: Path) -> None:
    with sentences(path):
        path.mkdir(parents=True, exist_ok=True)


BEYOND = 2**30
"""Offset of the byte locked on Windows, far behind the content, so that other programs can read the file."""


def lock(file: int) -> None:
    """Lock an open file until it is closed. Raises `BlockingIOError` if another process holds the lock."""
    if sys.platform != "win32":
        import fcntl

        return fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    import msvcrt

    os.lseek(file, BEYOND, os.SEEK_SET)
    try:
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
    except OSError as error:  # of a kind that is the same for every reason
        raise BlockingIOError(*error.args) from error
    finally:
        os.lseek(file, 0, os.SEEK_SET)


LOCK = ".lock"
_NOT_SUPPORTED = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Create a folder and lock it against other processes. A network drive without locks is accepted."""
    path = folder / LOCK
    with sentences(folder):
        folder.mkdir(parents=True, exist_ok=True)
        file = _open_locked(path)
    try:
        yield
    finally:
        with suppress(PermissionError):  # on Windows no open file can be removed: it stays, unlocked
            path.unlink(missing_ok=True)
        os.close(file)


def _open_locked(path: Path) -> int:
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        with ExitStack() as stack:
            stack.callback(os.close, file)
            _lock(file, path.parent)
            if _is_at(path, file):
                with suppress(OSError):  # a full disk: the lock holds without the name
                    os.ftruncate(file, 0)
                    os.write(file, f"process {os.getpid()} on {socket.gethostname()}".encode())
                stack.pop_all()
                return file


def _lock(file: int, folder: Path) -> None:
    try:
        lock(file)
    except BlockingIOError:
        owner = os.read(file, 200).decode(errors="replace") or "another process"
        raise InputError(
            f"{folder} is being written by {owner}; wait until that has ended, or choose another --out."
        ) from None
    except OSError as problem:
        if problem.errno not in _NOT_SUPPORTED:
            raise


def _is_at(path: Path, file: int) -> bool:
    """Test whether a path still leads to the open file. Another process may have removed the file."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(file))
    except FileNotFoundError:
        return False
