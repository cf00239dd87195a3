"""The interface between optimisers and problems, and the replay log of evaluations.

Optimisers are deterministic: equal losses and gradients lead to equal steps. The replay log of all evaluations
therefore serves as a checkpoint for every optimiser. The replay log is an append-only file, because an sqlite3 database
needs file locks, and some cluster file systems have none.
"""

import json
import os
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from cortado.errors import ComputationError, InputError
from cortado.files.disk import REPLAY_LOG, parsed_json, sentences, write_atomically, write_fully

Vector = npt.NDArray[np.float64]
FORMAT = "cortado replay log 1"


@dataclass(frozen=True)
class ParameterLayout:
    """The order and shapes of named parameters in the optimiser's vector. The shape of a scalar parameter is ()."""

    names: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]

    @property
    def sizes(self) -> list[int]:
        return [int(np.prod(shape)) for shape in self.shapes]

    @property
    def size(self) -> int:
        return sum(self.sizes)

    def ravel(self, parameters: Mapping[str, Any]) -> Vector:
        return np.concatenate([np.asarray(parameters[name], dtype=np.float64).ravel() for name in self.names])

    def unravel(self, vector: Vector) -> dict[str, Vector]:
        """Return copies of the parameters in a vector (size,), by name. Scalar parameters become arrays of shape ()."""
        parts = np.split(vector, np.cumsum(self.sizes)[:-1])
        each = zip(self.names, self.shapes, parts, strict=True)
        return {name: part.reshape(shape).copy() for name, shape, part in each}

    def spread(self, values: float | Mapping[str, float]) -> Vector:
        """Expand a number, or one number for each parameter, to a vector (size,)."""
        by_name = values if isinstance(values, Mapping) else dict.fromkeys(self.names, values)
        return np.repeat([float(by_name[name]) for name in self.names], self.sizes)


@dataclass(frozen=True, eq=False)
class LoggedEvaluation:
    """One evaluation in a replay log: the loss and its gradient (size,) at parameters (size,)."""

    parameters: Vector
    loss: float
    gradient: Vector


class MemoryLog(list[LoggedEvaluation]):
    fate = "were not kept, as there is no checkpoint"

    def read(self, index: int) -> LoggedEvaluation:
        return self[index]

    def close(self) -> None: ...


class ReplayLog:
    """A replay log in one file of a folder. A killed process loses at most the evaluation that it is writing.

    The file is a line of JSON with the format, names, shapes and settings, followed by one record of fixed size per
    evaluation. A record is little-endian and consists of the index (uint64), the loss, parameters and gradient
    (float64), and the CRC-32 of the preceding values (uint32). Every record is on the disk before `append` returns. The
    next evaluation overwrites an incomplete last record.
    """

    def __init__(
        self, folder: str | os.PathLike[str], layout: ParameterLayout, settings: Mapping[str, str], resume: bool
    ):
        """Open the log in ``folder`` to ``resume`` a search, or begin a new log."""
        path, self._size, self._record_size = Path(folder) / REPLAY_LOG, layout.size, 8 + 8 * (1 + 2 * layout.size) + 4
        self._path, self.fate = path, f"are in '{path}'"
        shapes = [list(shape) for shape in layout.shapes]
        header = {"format": FORMAT, "names": list(layout.names), "shapes": shapes, **settings}
        if path.exists() and not path.is_file():
            raise InputError(f"'{path}' is no regular file; give another checkpoint folder.")
        if not resume and path.exists():
            with sentences(path), open(path, "rb") as file:
                file.readline()
                has_records = bool(file.read(1))
            if has_records:
                said = f"'{path}' already holds the evaluations of an optimisation"
                raise InputError(f"{said}; continue the search by resume=True, or give another checkpoint folder.")
        if not resume or not path.exists():
            with sentences(path.parent):
                path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, json.dumps(header) + "\n")
        with sentences(path):
            self._file: BinaryIO = open(path, "r+b", buffering=0)  # noqa: SIM115 closed by close()
        try:
            self._first_record, self._count = self._begun(header)
        except BaseException:
            self._file.close()
            raise

    def __len__(self) -> int:
        return self._count

    def read(self, index: int) -> LoggedEvaluation:
        self._file.seek(self._first_record + index * self._record_size)
        values = np.frombuffer(self._file.read(self._record_size)[8:-4], dtype="<f8").astype(np.float64)
        return LoggedEvaluation(values[1 : 1 + self._size], float(values[0]), values[1 + self._size :])

    def append(self, evaluation: LoggedEvaluation) -> None:
        values = np.concatenate([[evaluation.loss], evaluation.parameters, evaluation.gradient])
        content = self._count.to_bytes(8, "little") + values.astype("<f8").tobytes()
        try:
            self._file.seek(self._first_record + self._count * self._record_size)
            write_fully(self._file, content + zlib.crc32(content).to_bytes(4, "little"))
            os.fsync(self._file.fileno())
        except OSError as problem:
            said = f"An evaluation cannot be written to '{self._path}': {problem.strerror or problem}"
            advice = f"free some space and resume. The {self._count} earlier evaluations are kept"
            raise ComputationError(f"{said}; {advice}.") from problem
        self._count += 1

    def close(self) -> None:
        self._file.close()

    def _begun(self, header: Mapping[str, Any]) -> tuple[int, int]:
        """Return the offset of the first record in the file [bytes], and the number of complete records."""
        try:
            found = parsed_json(self._file.readline(2**20))  # a damaged file may have no line end
        except ValueError:
            found = None
        if not isinstance(found, dict) or found.get("format") != FORMAT:
            raise InputError(f"'{self._path}' is no replay log ('{FORMAT}'); give another checkpoint folder.")
        for key, wanted in header.items():
            if found.get(key) != wanted:
                texts = (one if isinstance(one, str) else json.dumps(one) for one in (found.get(key), wanted))
                former, given = (text.split("; ") for text in texts)
                if len(former) == len(given):
                    differing = [pair for pair in zip(former, given, strict=True) if pair[0] != pair[1]]
                    former, given = ([pair[k] for pair in differing] for k in range(2))
                begun = f"'{self._path}' cannot be resumed, because the search began with {key} = {'; '.join(former)}"
                now = f"now has {key} = {'; '.join(given)}"
                raise InputError(f"{begun} and {now}; repeat the earlier settings, or give another checkpoint folder.")
        first, complete = self._file.tell(), 0
        records = (self._file.seek(0, os.SEEK_END) - first) // self._record_size
        self._file.seek(first)
        while len(record := self._file.read(self._record_size)) == self._record_size:
            index, checksum = (int.from_bytes(part, "little") for part in (record[:8], record[-4:]))
            if index != complete or checksum != zlib.crc32(record[:-4]):
                break
            complete += 1
        if complete < records - 1:
            said = f"Evaluation {complete} of the {records} in '{self._path}' is damaged"
            raise InputError(f"{said}; restore the file from a copy, or begin a search in another checkpoint folder.")
        return first, complete


Log = MemoryLog | ReplayLog


@dataclass(frozen=True, eq=False)
class Search:
    """The problem for an optimiser, as a function of one vector that contains all parameters."""

    evaluate: Callable[[Vector], tuple[float, Vector]]
    """Function that maps a vector (size,) to the loss and the gradient (size,). A failed run raises an error."""
    attempt: Callable[[Vector], tuple[float, Vector] | None]
    """Function that maps a vector (size,) to the loss and the gradient (size,), or to None for a failed run."""
    losses: Callable[[Sequence[Vector]], list[float]]
    """Function that maps several vectors (size,) to their losses. The loss of a failed run is infinite."""
    layout: ParameterLayout
    """Order and shapes of the parameters in the vector."""
    start: Vector
    """First vector (size,), within the bounds."""
    lower: Vector
    """Lower bounds (size,). A missing bound is -inf."""
    upper: Vector
    """Upper bounds (size,). A missing bound is +inf."""
    iterations: int
    updated: Callable[[], None] = lambda: None
    """Function that the optimiser calls after each update."""

    def project(self, vector: Vector) -> Vector:
        """Return the nearest vector within the bounds."""
        return np.clip(vector, self.lower, self.upper)


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of an optimiser: the last iterate, and a description of the end of the search."""

    last: Vector
    """Last iterate (size,), which has been evaluated."""
    converged: bool
    """True if the optimiser's convergence test was met."""
    message: str
    """Sentence on the end of the search."""


@runtime_checkable
class Optimiser(Protocol):
    """An algorithm that lowers the loss."""

    def check(self, layout: ParameterLayout) -> None:
        """Raise `InputError` if the settings do not match the parameters."""

    def minimise(self, search: Search) -> Outcome:
        """Lower the loss by at most `search.iterations` updates."""
