"""What may lie in the place of a file and is none: folders, pipes, links, and files without end."""

import os
import socket
from collections.abc import Callable
from pathlib import Path


def _a_folder(path: Path, good: bytes) -> None:
    path.mkdir()


def _a_pipe(path: Path, good: bytes) -> None:
    os.mkfifo(path)


def _a_socket(path: Path, good: bytes) -> None:
    here = os.getcwd()
    os.chdir(path.parent)  # the path of a socket must be short
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(path.name)
    os.chdir(here)


def _endless_zeros(path: Path, good: bytes) -> None:
    path.symlink_to("/dev/zero")


def _endless_noise(path: Path, good: bytes) -> None:
    path.symlink_to("/dev/urandom")


def _a_full_disk(path: Path, good: bytes) -> None:
    path.symlink_to("/dev/full")


def _a_link_to_itself(path: Path, good: bytes) -> None:
    path.symlink_to(path.name)


def _a_link_to_nothing(path: Path, good: bytes) -> None:
    path.symlink_to("nothing")


def _huge(path: Path, good: bytes) -> None:
    path.write_bytes(good)
    os.truncate(path, 8_000_000_000)


def _missing(path: Path, good: bytes) -> None:
    path.unlink(missing_ok=True)


PLACES: tuple[Callable[[Path, bytes], None], ...] = (
    _a_folder,
    _a_pipe,
    _a_socket,
    _endless_zeros,
    _endless_noise,
    _a_full_disk,
    _a_link_to_itself,
    _a_link_to_nothing,
    _huge,
    _huge,
    _missing,
)
