"""A file of JSON lines, to which the record of each cell is added as soon as it is computed."""

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from cortado import InputError
from cortado.files.disk import lock

from .cells import Cell, Record


class Results:
    """What is known of the cells: a line of settings, then a line for each record."""

    def __init__(self, path: Path):
        """Reads a file, or starts with none. A last line that was cut off when the command was killed is dropped."""
        self.path = path
        whole = path.read_bytes() if path.exists() else b""
        self._read, self._whole = len(whole), whole.rfind(b"\n") + 1
        try:
            lines = [json.loads(line) for line in whole[: self._whole].splitlines()]
            self.settings: dict[str, Any] | None = lines[0]["settings"] if lines else None
            self.records: dict[Cell, Record] = {Cell.of(line): line for line in lines[1:]}
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path} is no file of results of the leaderboard: choose another name.") from error

    @contextmanager
    def adding(self, settings: dict[str, Any], environment: dict[str, Any]) -> Iterator[Callable[[Record], None]]:
        """Gives a function that writes the record of one cell, computed with these settings; raises `InputError` where
        the file has those of others, and where another command writes it."""
        if self.settings not in (None, settings):
            raise InputError(f"{self.path} was computed with {self.settings}, but must have {settings}.")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with open(self.path, "ab") as file:

            def append(line: dict[str, Any]) -> None:
                file.write(json.dumps(line, allow_nan=False).encode() + b"\n")
                file.flush()
                os.fsync(file.fileno())

            def add(record: Record) -> None:
                self.records[Cell.of(record)] = record
                append(record)

            self._own(file)
            if self.settings is None:
                self.settings = settings
                append({"settings": settings, "environment": environment})
            yield add

    def _own(self, file: BinaryIO) -> None:
        """Keeps others from the open file, and drops what is no whole line."""
        try:
            lock(file.fileno())
            changed = file.tell() != self._read
        except BlockingIOError:
            changed = True
        if changed:
            raise InputError(f"{self.path} is being written by another command; wait for it, or choose another name.")
        file.truncate(self._whole)
