"""One process at a time writes a folder."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cortado.errors import InputError
from cortado.files.atomic import sentences
from cortado.files.file_lock import lock

LOCK = ".lock"
"""Name of the file that is locked; it is there while a process writes the folder, or was killed."""
_NOT_SUPPORTED = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Makes the folder, and refuses it to every other process until the block ends.

    The system takes the lock from a process that dies, so that none is left behind. On file systems without
    locks, as some networks have them, folders are not protected.

    Raises:
        InputError: another process has it, or it cannot be written.
        ComputationError: the disk is full.
    """
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
    """The file descriptor of the locked file, which names this process."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        try:
            _lock(file, path.parent)
            if _is_at(path, file):
                with suppress(OSError):  # a full disk: the lock holds without the name
                    os.ftruncate(file, 0)
                    os.write(file, f"process {os.getpid()} on {socket.gethostname()}".encode())
                return file
        except BaseException:
            os.close(file)
            raise
        os.close(file)


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
    """Whether the path still names the open file, which the process before may have removed when it ended."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(file))
    except FileNotFoundError:
        return False
