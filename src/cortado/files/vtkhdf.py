"""Write frames of particles to one temporal VTKHDF file for ParaView. The file remains readable if the run is killed.

The file has room for every frame of the run from the beginning. Every dataset is contiguous, sparse on disk and at a
fixed offset. The dataset `PointOffsets` maps a frame to the data of the frame. Datasets that count points and cells
have two parts: one for all particles, and an empty part for missing frames. The dataset `PartOffsets` selects one of
the two parts for each frame. A change of the selected part makes a frame appear, so that readers never see a change of
size.

HDF5 only creates the file in memory, because it crashes on a full disk (HDF5 2.0). Plain writes copy the file to disk
and add frames. A last write of eight bytes stores the number of frames and the CRC-32 of the frames. HDF5's checksums
and its mode for one writer and many readers are not used. VTK cannot open files with such checksums or in this mode
after the writing process was killed.

Format: https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/vtkhdf_specifications.html
"""

from __future__ import annotations

import io
import os
import shutil
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.errors import ComputationError, InputError
from cortado.files.disk import sentences, unfinished, write_fully

FORMAT = 3
"""Version of the format of the file's group "cortado"."""
WRITTEN, MISSING = 0, 1  # parts of frames
_TOPOLOGIES = ("Vertices", "Lines", "Polygons", "Strips")
_PAGE = 4096
Arrays = Mapping[str, NDArray[Any]]
Kinds = Mapping[str, tuple[np.dtype[Any], tuple[int, ...]]]


@dataclass(frozen=True)
class FileLayout:
    times: NDArray[np.float64]
    """Expected times of the frames (frames,) [s]."""
    particles: int
    dimension: int
    """Dimension, 2 or 3. In 2-D the stored z is 0."""
    precision: str = "float32"
    """Type of positions, velocities and scalars: "float32" or "float64"."""
    steps: int = 0
    scalars: Sequence[str] = ()
    vectors: Sequence[str] = ()
    others: Arrays = field(default_factory=dict)
    """Additional arrays of every frame by name, with the types and shapes of the first frame."""
    constants: Arrays = field(default_factory=dict)
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    origin: str = ""
    marks: tuple[float, ...] = ()
    """Time of the first frame [s] and frames per second [1/s]. Empty if frames are chosen by number of steps."""

    def __post_init__(self) -> None:
        own: dict[str, Any] = {"times": np.array(self.times, dtype=np.float64, ndmin=1)}
        if len(own["times"]) < 1 or self.particles < 1 or self.dimension not in (2, 3) or self.steps < 0:
            raise InputError(
                f"A trajectory needs at least 1 frame, 1 particle and dimension 2 or 3, but was given "
                f"{len(own['times'])} frames, {self.particles} particles, dimension {self.dimension} and {self.steps} "
                "steps."
            )
        own |= {key: {n: np.asarray(a) for n, a in getattr(self, key).items()} for key in ("others", "constants")}
        own["diagnostics"] = {name: np.dtype(kind) for name, kind in self.diagnostics.items()}
        own["marks"] = tuple(map(float, self.marks))
        for name, value in own.items():
            object.__setattr__(self, name, value)

    @property
    def shape(self) -> tuple[int, int]:
        return self.particles, self.dimension

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(self.precision)

    @property
    def rows(self) -> dict[str, tuple[int, ...]]:
        """Shape of one particle's values by the dataset's name, in the order of the checksum."""
        fields: dict[str, tuple[int, ...]] = dict.fromkeys(("velocity", *self.vectors), (3,))
        fields |= dict.fromkeys(self.scalars, ())
        return {"VTKHDF/Points": (3,)} | {f"VTKHDF/PointData/{name}": fields[name] for name in sorted(fields)}

    @property
    def records(self) -> np.dtype[Any]:
        return np.dtype(sorted(self.diagnostics.items()))

    @property
    def seed(self) -> int:
        kinds = {name: (self.dtype, (self.particles, *row)) for name, row in self.rows.items()}
        kinds |= {name: (array.dtype, array.shape) for name, array in sorted(self.others.items())}
        return frames_seed(self.shape, kinds, self.constants, self.origin, self.marks)

    @property
    def size(self) -> int:
        numbers = sum(int(np.prod(row, dtype=int)) for row in self.rows.values())
        others, constants = (sum(a.nbytes for a in arrays.values()) for arrays in (self.others, self.constants))
        offsets = 8 * (17 + len(self.scalars) + len(self.vectors))
        frame = self.particles * numbers * self.dtype.itemsize + others + offsets
        return len(self.times) * frame + self.steps * self.records.itemsize + 8 * 2 * self.particles + constants

    def create(self) -> tuple[Pages, dict[str, int]]:
        """Return the empty file and the byte offset of each dataset."""
        import h5py

        pages = Pages()
        # Numbers that are aligned lie in one page and change in one go.
        with h5py.File(pages, "w", libver=("earliest", "v108"), alignment_threshold=1, alignment_interval=8) as file:
            places = self._create_own(file.create_group("cortado"))
            places |= self._create_vtk(file.create_group("VTKHDF"))
        return pages, places

    def _create_own(self, own: Any) -> dict[str, int]:
        own.attrs["format"], own.attrs["dimension"] = FORMAT, self.dimension
        if self.origin:
            own.attrs["origin"] = self.origin
        if self.marks:
            own.attrs["marks"] = np.array(self.marks)
        constants = own.create_group("constants")
        for name, array in self.constants.items():
            constants[name] = array
        own["progress"] = np.array([[0, self.seed], [0, steps_seed(self.records)]], np.uint32)
        places = {"cortado/progress": own["progress"].id.get_offset()}
        places["cortado/frame_steps"] = _reserve(own, "frame_steps", (len(self.times),), np.int64)
        states, steps = own.create_group("states"), own.create_group("diagnostics")
        for name, array in self.others.items():
            places[f"cortado/states/{name}"] = _reserve(states, name, (len(self.times), *array.shape), array.dtype)
        for name, dtype in self.diagnostics.items():
            places[f"cortado/diagnostics/{name}"] = _reserve(steps, name, (max(self.steps, 1),), dtype)
        return places

    def _create_vtk(self, vtk: Any) -> dict[str, int]:
        import h5py

        frames, particles = len(self.times), self.particles
        vtk.attrs["Version"] = np.array([2, 2], np.int64)
        vtk.attrs.create("Type", b"PolyData", dtype=h5py.string_dtype("ascii", 8))
        vtk["NumberOfPoints"] = np.array([particles, 0])
        for topology in _TOPOLOGIES:
            cells, group = particles if topology == "Vertices" else 0, vtk.create_group(topology)
            # One cell for each point, shared by all frames, and none in the empty part.
            group["NumberOfConnectivityIds"] = group["NumberOfCells"] = np.array([cells, 0])
            group["Connectivity"], group["Offsets"] = np.arange(cells), np.append(np.arange(cells + 1), 0)
        series = vtk.create_group("Steps")
        series.attrs["NSteps"] = np.int64(frames)
        series["Values"], series["PartOffsets"] = self.times, np.full(frames, MISSING)
        series["NumberOfParts"], series["PointOffsets"] = np.ones(frames, np.int64), np.arange(frames) * particles
        for name in ("CellOffsets", "ConnectivityIdOffsets"):
            series[name] = np.zeros((frames, len(_TOPOLOGIES)), np.int64)
        for name in ("velocity", *self.scalars, *self.vectors):
            series[f"PointDataOffsets/{name}"] = np.arange(frames) * particles
        vtk.create_group("PointData")
        places = {f"VTKHDF/Steps/{name}": series[name].id.get_offset() for name in ("Values", "PartOffsets")}
        for name, row in self.rows.items():
            places[name] = _reserve(vtk.file, name, (frames * particles, *row), self.dtype)
        return places


def frames_seed(shape: tuple[int, int], kinds: Kinds, constants: Arrays, origin: str, marks: tuple[float, ...]) -> int:
    """Return the checksum of the fields' types and shapes and of the constants, before any frame."""
    fixed = [(name, array.dtype.str, array.shape, array.tobytes()) for name, array in sorted(constants.items())]
    varying = [(name, dtype.str, sizes) for name, (dtype, sizes) in kinds.items()]
    return zlib.crc32(origin.encode(), zlib.crc32(repr((shape, varying, fixed, *marks)).encode()))


def frame_checksum(checksum: int, time: Any, number: Any, rows: Iterable[bytes]) -> int:
    for content in (time.tobytes(), number.tobytes(), *rows):
        checksum = zlib.crc32(content, checksum)
    return checksum


def steps_seed(records: np.dtype[Any]) -> int:
    return zlib.crc32(repr(records.descr).encode())


def _reserve(group: Any, name: str, shape: tuple[int, ...], dtype: Any) -> int:
    from h5py import h5d, h5p, h5s, h5t

    options = h5p.create(h5p.DATASET_CREATE)
    options.set_alloc_time(h5d.ALLOC_TIME_EARLY)
    options.set_fill_time(h5d.FILL_TIME_NEVER)
    kind = h5t.py_create(np.dtype(dtype), logical=True)
    return h5d.create(group.id, name.encode(), kind, h5s.create_simple(shape), options).get_offset()


class Pages(io.RawIOBase):
    """A file in memory that stores only written pages."""

    def __init__(self) -> None:
        self._pages: dict[int, bytearray] = {}
        self._place = self._end = 0

    def save(self, file: Any) -> None:
        """The file on disk remains sparse."""
        file.truncate(self._end)
        for number, page in sorted(self._pages.items()):
            file.seek(number * _PAGE)
            write_fully(file, bytes(page[: self._end - number * _PAGE]))

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._place = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._place, io.SEEK_END: self._end}[whence]
        return self._place

    def tell(self) -> int:
        return self._place

    def truncate(self, size: int | None = None) -> int:
        self._end = self._place if size is None else size
        return self._end

    def write(self, content: Any) -> int:
        for page, place, part in self._parts(content):
            page[place : place + len(part)] = part
        self._end = max(self._end, self._place)
        return len(content)

    def readinto(self, buffer: Any) -> int:
        for page, place, part in self._parts(buffer):
            part[:] = page[place : place + len(part)]
        return len(buffer)

    def _parts(self, content: Any) -> Iterator[tuple[bytearray, int, memoryview]]:
        rest = memoryview(content)
        while rest:
            number, place = divmod(self._place, _PAGE)
            part, rest = rest[: _PAGE - place], rest[_PAGE - place :]
            yield self._pages.setdefault(number, bytearray(_PAGE)), place, part
            self._place += len(part)


class TrajectoryWriter:
    """A context manager that writes frames to one VTKHDF file. The file appears at ``path`` after its first ``kept``
    frames, and can be opened while it grows. Frames that are not written yet have no particles."""

    def __init__(self, path: str | Path, *, expected: int | None = None, kept: int = 1, **fields: Any) -> None:
        """``fields`` are arguments of `FileLayout`. The disk must have room for ``expected`` frames. By default the
        disk must have room for all frames."""
        self.path, self._layout = Path(path), FileLayout(**fields)
        self.frames_written, self.steps_written, self._kept = 0, 0, kept
        self._unfinished = unfinished(self.path)
        with sentences(self.path):
            free, most = shutil.disk_usage(self.path.absolute().parent).free, len(self._layout.times)
            frames = most if expected is None else min(expected, most)
            if (needed := self._layout.size * frames / most) > free:
                raise ComputationError(
                    f"{path} needs {needed / 1e6:.4g} MB for {frames} frames, but {free / 1e6:.4g} MB are free on its "
                    "disk; record fewer frames, free some space, or choose another place."
                )
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
        """Write one frame: positions (n, d) [m], velocities (n, d) [m/s], and the fields named at construction.
        ``step`` is by default the number of frames. ``time`` [s] replaces the expected time. Earlier frames remain
        readable after an error."""
        frame, frames = self.frames_written, len(self._layout.times)
        if frame >= frames:
            raise InputError(f"{self.path} has room for {frames} frames, but one more was given.")
        named = (*self._layout.scalars, *self._layout.vectors)
        others = others or {}
        for what, found, wanted in ("scalar", scalars, named), ("other", others, self._layout.others):
            if set(found) != set(wanted):
                raise InputError(f"Expected the {what} fields {sorted(wanted)}, found {sorted(found)}.")
        own = {"VTKHDF/Points": self._row("positions", positions)}
        own["VTKHDF/PointData/velocity"] = self._row("velocities", velocities)
        for name, values in scalars.items():
            own[f"VTKHDF/PointData/{name}"] = self._row(name, values, name in self._layout.vectors)
        number = np.int64(frame if step is None else step)
        rows = {name: own[name] for name in self._layout.rows}
        for name, first in sorted(self._layout.others.items()):
            rows[f"cortado/states/{name}"] = _checked(name, others[name], first.dtype, first.shape).tobytes()
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
        """Write the diagnostics of one step (scalars) or of k steps (arrays (k,)), by name."""
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
        """Finish the file. A file with fewer than ``kept`` frames is removed."""
        self._file.close()
        if self.frames_written < self._kept:
            self._unfinished.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _row(self, name: str, values: ArrayLike, is_vector: bool = True) -> bytes:
        shape = self._layout.shape if is_vector else self._layout.shape[:1]
        array = _checked(name, values, self._layout.dtype, shape)
        return (np.pad(array, ((0, 0), (0, 3 - self._layout.dimension))) if is_vector else array).tobytes()

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
    """Read the complete frames and steps, also during a run and after a killed run. Raises `InputError` if the file is
    missing, damaged, or not a trajectory of Cortado.

    The result has times (frames,) [s], steps (frames,), positions (frames, n, d) [m], velocities (frames, n, d) [m/s],
    and every scalar field (frames, n). The keys others, constants and diagnostics contain tables of arrays by name:
    others for every frame, constants of the run, and diagnostics for every step (steps,). The key origin contains a
    text, and the key marks contains None or two numbers."""
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
    origin, marks = str(own.attrs.get("origin", "")), tuple(map(float, own.attrs.get("marks", ())))
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


def _checked(name: str, values: ArrayLike, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    array = np.asarray(values, dtype=dtype)
    if array.shape != shape:
        raise InputError(f"Expected {name} of shape {shape}, found {array.shape}.")
    return array


def _records(columns: Mapping[str, ArrayLike], record: np.dtype[Any]) -> NDArray[Any]:
    arrays = {name: np.atleast_1d(column) for name, column in columns.items()}
    records = np.zeros(max((len(array) for array in arrays.values()), default=0), record)
    for name, array in arrays.items():
        records[name] = array
    return records
