"""A file of JSON lines, to which the record of each cell is added as soon as it is computed."""

import json
import os
from pathlib import Path
from typing import Any

from cortado import InputError

from .cells import Cell, Record


class Results:
    """What is known of the cells: a line of settings, then a line for each record."""

    def __init__(self, path: Path):
        """Reads a file, or starts with none. A last line that was cut off when the command was killed is dropped."""
        self.path = path
        whole = path.read_bytes() if path.exists() else b""
        self._length = whole.rfind(b"\n") + 1
        try:
            lines = [json.loads(line) for line in whole[: self._length].splitlines()]
            self.settings: dict[str, Any] | None = lines[0]["settings"] if lines else None
            self.records: dict[Cell, Record] = {Cell.of(line): line for line in lines[1:]}
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path} is no file of results of the leaderboard: choose another name.") from error

    def begin(self, settings: dict[str, Any], environment: dict[str, Any]) -> None:
        """Get ready to add records that are computed with these settings; raises `InputError` where the file has
        those of others."""
        if self.settings is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.settings = settings
            self._append({"settings": settings, "environment": environment})
        elif self.settings != settings:
            raise InputError(f"{self.path} was computed with {self.settings}, but must have {settings}.")

    def add(self, record: Record) -> None:
        """Write the record of one cell."""
        self.records[Cell.of(record)] = record
        self._append(record)

    def _append(self, line: dict[str, Any]) -> None:
        with open(self.path, "ab") as file:
            file.truncate(self._length)
            file.write(json.dumps(line, allow_nan=False).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
            self._length = file.tell()
