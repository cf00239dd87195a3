"""Frames of particles in one temporal VTKHDF file, which ParaView opens and a killed run leaves readable.

A frame's bytes are written at the offsets of its datasets (`FileLayout`) without HDF5, which may crash on a full disk.
Then one write of eight bytes stores the number of frames and their CRC-32. HDF5's checksums are not used, as a killed
process leaves the index of its chunks half written.
"""

from __future__ import annotations

import os
import shutil
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.errors import ComputationError, InputError
from cortado.files.disk import sentences, unfinished, write_fully
from cortado.files.vtkhdf_layout import FORMAT, WRITTEN, FileLayout, frame_checksum, frames_seed, steps_seed


class TrajectoryWriter:
    """Writes frames to one VTKHDF file; a context manager. The file appears at ``path`` when its first ``kept`` frames
    are written, and can be opened while it grows. Missing frames contain no particles."""

    def __init__(self, path: str | Path, *, expected: int | None = None, kept: int = 1, **fields: Any) -> None:
        """Create the file; ``fields`` are arguments of `FileLayout`. The disk must have room for ``expected`` frames,
        by default for all. Raise `InputError` for impossible sizes or paths, and `ComputationError` if the disk lacks
        room."""
        self.path, self._layout = Path(path), FileLayout(**fields)
        self.frames_written, self.steps_written, self._kept = 0, 0, kept
        self._unfinished = unfinished(self.path)
        with sentences(self.path):
            _require_room(self._layout, self.path, expected)
            self._file = open(self._unfinished, "x+b", buffering=0)  # noqa: SIM115
            try:
                pages, self._places = self._layout.create()
                pages.save(self._file)
            except BaseException:
                self.close()
                raise
        self._frames_checksum, self._steps_checksum = self._layout.seed, steps_seed(self._layout.records)

    def append(
        self,
        positions: ArrayLike,
        velocities: ArrayLike,
        *,
        step: int | None = None,
        time: float | None = None,
        others: Mapping[str, ArrayLike] | None = None,
        **scalars: ArrayLike,
    ) -> None:
        """Write one frame: positions (n, d) [m], velocities (n, d) [m/s], and exactly the fields named at construction.
        ``step`` is the number of steps so far, by default of frames; ``time`` [s] replaces the announced one. Raise
        `InputError` for other shapes or names or for too many frames, and `ComputationError` if the disk is full;
        earlier frames stay readable."""
        frame = self.frames_written
        frames = len(self._layout.times)
        if frame >= frames:
            raise InputError(f"{self.path} has room for {frames} frames, but one more was given.")
        for what, found, wanted in (
            ("scalar fields", scalars, (*self._layout.scalars, *self._layout.vectors)),
            ("other fields", others or {}, self._layout.others),
        ):
            if set(found) != set(wanted):
                raise InputError(f"Expected the {what} {sorted(wanted)}, found {sorted(found)}.")
        fields = {"VTKHDF/Points": self._vectors("positions", positions)}
        fields["VTKHDF/PointData/velocity"] = self._vectors("velocities", velocities)
        for name, values in scalars.items():
            shape = self._layout.shape[:1]
            array = self._vectors(name, values) if name in self._layout.vectors else self._checked(name, values, shape)
            fields[f"VTKHDF/PointData/{name}"] = array
        number = np.int64(frame if step is None else step)
        rows = {name: fields[name].tobytes() for name in self._layout.rows}
        for name, first in sorted(self._layout.others.items()):
            array = np.asarray((others or {})[name], dtype=first.dtype)
            if array.shape != first.shape:
                raise InputError(f"Expected {name} of shape {first.shape}, found {array.shape}.")
            rows[f"cortado/states/{name}"] = array.tobytes()
        moment = self._layout.times[frame] if time is None else np.float64(time)
        checksum = frame_checksum(self._frames_checksum, moment, number, rows.values())
        with self._refusal():
            for name, row in rows.items():
                self._write(name, frame * len(row), row)
            self._write("cortado/frame_steps", 8 * frame, number.tobytes())
            if time is not None:
                self._write("VTKHDF/Steps/Values", 8 * frame, moment.tobytes())
            self._write("VTKHDF/Steps/PartOffsets", 8 * frame, struct.pack("<q", WRITTEN))
            self._write("cortado/progress", 0, struct.pack("<II", frame + 1, checksum))
            if frame + 1 == self._kept:
                os.replace(self._unfinished, self.path)
        self.frames_written, self._frames_checksum = frame + 1, checksum

    def append_steps(self, **diagnostics: ArrayLike) -> None:
        """Write the diagnostics, by name, of one step (scalars) or of k steps (arrays (k,)); raise errors as `append`
        does."""
        kinds = self._layout.diagnostics
        if set(diagnostics) != set(kinds):
            raise InputError(f"Expected the diagnostics {sorted(kinds)}, found {sorted(diagnostics)}.")
        records = _records(diagnostics, self._layout.records)
        first, last = self.steps_written, self.steps_written + len(records)
        if last > self._layout.steps:
            raise InputError(f"{self.path} has room for {self._layout.steps} steps, but {last} were given.")
        checksum = zlib.crc32(records.tobytes(), self._steps_checksum)
        with self._refusal():
            for name, dtype in kinds.items():
                self._write(f"cortado/diagnostics/{name}", first * dtype.itemsize, records[name].tobytes())
            self._write("cortado/progress", 8, struct.pack("<II", last, checksum))
        self.steps_written, self._steps_checksum = last, checksum

    def close(self) -> None:
        """Finish the file; remove it if not all ``kept`` frames were written."""
        self._file.close()
        if self.frames_written < self._kept:
            self._unfinished.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _checked(self, name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[Any]:
        array = np.asarray(values, dtype=self._layout.dtype)
        if array.shape != shape:
            raise InputError(f"Expected {name} of shape {shape}, found {array.shape}.")
        return array

    def _vectors(self, name: str, values: ArrayLike) -> NDArray[Any]:
        array = self._checked(name, values, self._layout.shape)
        return np.pad(array, ((0, 0), (0, 3 - array.shape[1])))

    def _write(self, name: str, offset: int, content: bytes) -> None:
        self._file.seek(self._places[name] + offset)
        write_fully(self._file, content)

    @contextmanager
    def _refusal(self) -> Iterator[None]:
        try:
            yield
        except OSError as problem:
            raise ComputationError(
                f"{self.path} cannot be written: {problem.strerror or problem}; the {self.frames_written} frames so "
                f"far are kept, free some space or choose another place."
            ) from problem


def read(path: str | Path) -> dict[str, Any]:
    """Read the completed frames and steps, also while the writer is running or after it was killed.

    Returns:
        times (frames,) [s], steps (frames,), positions (frames, n, d) [m], velocities (frames, n, d) [m/s], and every
        scalar field (frames, n) by name. Tables by name: others (arrays of every frame), constants (arrays of the run),
        diagnostics (steps,). Also origin, a text, and marks, None or two numbers.

    Raises:
        InputError: the file is missing, damaged, or none of Cortado's trajectories.
    """
    import h5py

    if not Path(path).is_file():
        raise InputError(f"There is no trajectory file {path}.")
    try:
        with h5py.File(path, "r") as file:
            if "cortado" not in file:
                raise InputError(f"{path} is an HDF5 file, but not a trajectory that Cortado wrote.")
            if file["cortado"].attrs.get("format") != FORMAT:
                raise InputError(f"{path} was written by another version of Cortado, or is damaged; repeat the run.")
            arrays = _read_arrays(file, os.path.getsize(path))
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError, OverflowError) as problem:
        reason = " ".join(str(problem).split())
        raise InputError(f"{path} cannot be read as a VTKHDF trajectory: {reason}.") from problem
    if arrays is None:
        raise InputError(f"{path} is damaged: its checksums do not fit its content; restore it, or repeat the run.")
    return arrays


def _read_arrays(file: Any, size: int) -> dict[str, Any] | None:
    vtk, own = file["VTKHDF"], file["cortado"]
    (frames, frames_checksum), (steps, steps_checksum) = own["progress"][:].tolist()
    dimension, particles = int(own.attrs["dimension"]), int(vtk["NumberOfPoints"][0])
    rows = {"VTKHDF/Points": vtk["Points"]}
    rows |= {f"VTKHDF/PointData/{name}": dataset for name, dataset in sorted(vtk["PointData"].items())}
    groups = {name: dict(sorted(own[name].items())) for name in ("constants", "states", "diagnostics")}
    columns = [vtk["Steps/Values"], own["frame_steps"]]
    for dataset in (*columns, *rows.values(), *(dataset for group in groups.values() for dataset in group.values())):
        if dataset.nbytes > size or dataset.dtype.kind not in "fiub":
            return None
    constants = {name: dataset[()] for name, dataset in groups["constants"].items()}
    others = {name: dataset[:frames] for name, dataset in groups["states"].items()}
    times, numbers = (column[:frames] for column in columns)
    diagnostics = {name: dataset[:steps] for name, dataset in groups["diagnostics"].items()}
    record = np.dtype([(name, column.dtype) for name, column in diagnostics.items()])
    points = {name: dataset[: frames * particles] for name, dataset in rows.items()}
    points = {name: field.reshape(frames, particles, *field.shape[1:]) for name, field in points.items()}

    fields = points | others
    kinds = {name: (field.dtype, field.shape[1:]) for name, field in fields.items()}
    origin = str(own.attrs.get("origin", ""))
    marks = tuple(map(float, own.attrs.get("marks", ())))
    checksum = frames_seed((particles, dimension), kinds, constants, origin, marks)
    for k in range(frames):
        checksum = frame_checksum(checksum, times[k], numbers[k], [field[k].tobytes() for field in fields.values()])
    records = _records(diagnostics, record) if record.names else np.zeros(0)
    if checksum != frames_checksum or zlib.crc32(records.tobytes(), steps_seed(record)) != steps_checksum:
        return None
    arrays = {name.rpartition("/")[2]: field for name, field in points.items()}
    arrays["velocities"] = np.ascontiguousarray(arrays.pop("velocity")[..., :dimension])
    arrays["positions"] = np.ascontiguousarray(arrays.pop("Points")[..., :dimension])
    named = {"others": others, "constants": constants, "diagnostics": diagnostics}
    return arrays | {"times": times, "steps": numbers, "origin": origin, "marks": marks or None, **named}


def _records(columns: Mapping[str, ArrayLike], record: np.dtype[Any]) -> NDArray[Any]:
    arrays = {name: np.atleast_1d(column) for name, column in columns.items()}
    records = np.zeros(max((len(array) for array in arrays.values()), default=0), record)
    for name, array in arrays.items():
        records[name] = array
    return records


def _require_room(layout: FileLayout, path: Path, expected: int | None) -> None:
    free = shutil.disk_usage(path.absolute().parent).free
    frames = len(layout.times) if expected is None else min(expected, len(layout.times))
    if (needed := layout.size * frames / len(layout.times)) > free:
        raise ComputationError(
            f"{path} needs {needed / 1e6:.4g} MB for {frames} frames, but {free / 1e6:.4g} MB are "
            f"free on its disk; record fewer frames, free some space, or choose another place."
        )
