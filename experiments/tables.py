"""Measurements in long format: one row an observation, one column a quantity; in a CSV file with all digits."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError
from cortado.files.disk import content, reason, write_atomically

MOST_BYTES = 2**30
"""Of a file of results that is read again."""


@dataclass(frozen=True, eq=False, init=False)
class Table:
    """Columns of one length: whole numbers, floats (also inf and nan) or texts."""

    columns: dict[str, NDArray[Any]]
    """By name, (rows,) each."""

    def __init__(self, columns: Mapping[str, Any]):
        """``columns``: arrays or lists of one length; a single value stands for a column of it."""
        arrays = {name: np.asarray(values) for name, values in columns.items()}
        try:
            broadcast = np.broadcast_arrays(*(np.atleast_1d(array) for array in arrays.values()))
        except ValueError:
            shapes = {name: array.shape for name, array in arrays.items()}
            raise InputError(f"The columns of a table have the shapes {shapes}, but must have one length.") from None
        if any(array.ndim != 1 for array in broadcast):
            raise InputError("The columns of a table must have one dimension.")
        object.__setattr__(self, "columns", dict(zip(arrays, broadcast, strict=True)))

    @classmethod
    def joined(cls, parts: Iterable[Table | Mapping[str, Any]]) -> Table:
        """The rows of several tables with the same columns, one after the other."""
        tables = [part if isinstance(part, Table) else cls(part) for part in parts]
        names = list(tables[0].columns) if tables else []
        for table in tables:
            if list(table.columns) != names:
                raise InputError(f"A table has the columns {list(table.columns)}, but must have {names} to be joined.")
        return cls({name: np.concatenate([table[name] for table in tables]) for name in names})

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.columns[name]

    def where(self, **values: Any) -> Table:
        """The rows in which the columns named have these values."""
        chosen = np.ones(len(self), dtype=bool)
        for name, value in values.items():
            chosen &= self[name] == value
        return self.chosen(chosen)

    def chosen(self, rows: Any) -> Table:
        """Some rows, by a mask or by their numbers."""
        return Table({name: column[rows] for name, column in self.columns.items()})

    def values(self, name: str) -> list[Any]:
        """The different values of a column, in the order in which they first come."""
        return list(dict.fromkeys(self[name].tolist()))

    def groups(self, *names: str) -> Iterator[tuple[tuple[Any, ...], Table]]:
        """The rows for each combination of values of these columns, in the order in which they first come."""
        keys = list(zip(*(self[name].tolist() for name in names), strict=True))
        for key in dict.fromkeys(keys):
            yield key, self.chosen(np.array([other == key for other in keys]))

    def write_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the table, floats with all their digits."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(zip(*(column.tolist() for column in self.columns.values()), strict=True))
        write_atomically(Path(path), text.getvalue())

    @classmethod
    def read_csv(cls, path: str | os.PathLike[str]) -> Table:
        """The table that `write_csv` wrote."""
        try:
            text = content(path, MOST_BYTES).decode("utf-8")
            header, *rows = csv.reader(io.StringIO(text, newline=""))
        except (OSError, ValueError, csv.Error) as problem:
            raise InputError(f"The table {path} cannot be read: {reason(problem)}.") from problem
        if any(len(row) != len(header) for row in rows):
            raise InputError(f"The table {path} has rows that are longer or shorter than its first line.")
        columns = list(zip(*rows, strict=True)) or [()] * len(header)
        return cls({name: _parsed(column) for name, column in zip(header, columns, strict=True)})


def _parsed(texts: tuple[str, ...]) -> NDArray[Any]:
    """Whole numbers, else floats, else texts."""
    for kind in (int, float):
        try:
            return np.array([kind(text) for text in texts])
        except ValueError:
            continue
    return np.array(texts, dtype=str)
