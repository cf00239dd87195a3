"""Frames of particles in one temporal VTKHDF file, which ParaView opens and a killed run leaves readable.

The complete layout is created at the start, sparse on disk: every dataset is contiguous and has its place.
A frame is then written with plain writes at the places of its datasets, without HDF5, so that no cache holds
anything back. Only when it is there is it counted. The count stands in the file four times (the attribute
`NSteps`, both extents and the byte size of `Steps/Values`), because VTK reads the whole of `Values` into room
for `NSteps` numbers. These words lie in the object headers of `Steps` and `Values`, one after the other, and
one write into one page changes them together: a SIGKILL comes before or after it, never between.

Format: https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/vtkhdf_specifications.html
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cortado.errors import CortadoError, InputError

_TOPOLOGIES = ("Vertices", "Lines", "Polygons", "Strips")
_SENTINEL = 0x5EED_C027_AD05_EED5
"""Stands for the number of frames until its place in the file is known."""
_PAGE = 4096
"""Bytes that the kernel copies without looking for signals."""
_STEP_COLUMNS: dict[str, Any] = {"iterations": np.int32, "density_errors": np.float64, "converged": np.bool_}


class TrajectoryWriter:
    """Writes frames as they are computed; a context manager.

    The file appears at `path` with its first frame (until then it is `path`.partial) and can be opened, by
    ParaView too, while it grows. A writer closed early leaves a file with the frames so far.

    Args:
        path: the file, replaced when it exists.
        frames: the most frames that will come.
        particles: n.
        dimension: 2 or 3; in 2-D the stored points have z = 0.
        precision: of the stored positions, velocities and scalars.
        steps: the most steps of which `append_steps` will be told.
        scalars: names of further scalar fields of every frame, such as "density" and "pressure".

    Raises:
        InputError: a size that makes no sense, or a path that cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        frames: int,
        particles: int,
        dimension: int,
        precision: Literal["float32", "float64"] = "float32",
        steps: int = 0,
        scalars: Sequence[str] = (),
    ) -> None:
        if frames < 1 or particles < 1 or dimension not in (2, 3) or steps < 0:
            raise InputError(
                f"A trajectory needs at least 1 frame, 1 particle and dimension 2 or 3, but was given "
                f"{frames} frames, {particles} particles, dimension {dimension} and {steps} steps."
            )
        self.path = Path(path)
        self.frames_written = 0
        self.steps_written = 0
        self._frames, self._steps = frames, steps
        self._shape = (particles, dimension)
        self._dtype = np.dtype(precision)
        self._scalars = tuple(scalars)
        self._partial = self.path.with_name(self.path.name + ".partial")
        try:
            places = _create_layout(self._partial, frames, self._shape, self._dtype, steps, self._scalars)
            self._count = _FrameCount(self._partial, frames, places["VTKHDF/Steps/Values"])
            self._file = open(self._partial, "r+b", buffering=0)  # noqa: SIM115
        except OSError as problem:
            raise InputError(f"The trajectory file {self.path} cannot be written: {problem}.") from problem
        self._places = places

    def append(
        self,
        time: float,
        positions: ArrayLike,
        velocities: ArrayLike,
        *,
        step: int | None = None,
        **scalars: ArrayLike,
    ) -> None:
        """Writes one frame.

        Args:
            time: [s]
            positions: (n, d) [m]
            velocities: (n, d) [m/s]
            step: number of steps taken so far; the number of this frame when left out.
            scalars: (n,) each, exactly those named at construction.

        Raises:
            InputError: shapes or names other than announced, or more frames than announced.
            CortadoError: the disk refused; the frames before this one stay readable.
        """
        frame = self.frames_written
        if frame >= self._frames:
            raise InputError(f"{self.path} was laid out for {self._frames} frames, and one more came.")
        if set(scalars) != set(self._scalars):
            raise InputError(f"Expected the scalar fields {sorted(self._scalars)}, found {sorted(scalars)}.")
        rows = {"VTKHDF/Points": self._vectors("positions", positions)}
        rows["VTKHDF/PointData/velocity"] = self._vectors("velocities", velocities)
        for name, values in scalars.items():
            rows[f"VTKHDF/PointData/{name}"] = self._checked(name, values, self._shape[:1])
        rows["VTKHDF/Steps/Values"] = np.float64(time).reshape(1)
        rows["cortado/frame_steps"] = np.int64(frame if step is None else step).reshape(1)
        for name, values in rows.items():
            self._write(self._places[name] + frame * values.nbytes, values.tobytes())
        self._write(self._count.place, self._count.words(frame + 1))
        if frame == 0:
            os.replace(self._partial, self.path)
        self.frames_written = frame + 1

    def append_steps(self, iterations: ArrayLike, density_errors: ArrayLike, converged: ArrayLike = True) -> None:
        """Writes what the pressure solver reported of one step (scalars) or of several ((k,) each).

        Raises:
            InputError: more steps than announced.
            CortadoError: the disk refused.
        """
        columns = np.broadcast_arrays(np.atleast_1d(iterations), density_errors, converged)
        first, last = self.steps_written, self.steps_written + columns[0].size
        if last > self._steps:
            raise InputError(f"{self.path} was laid out for {self._steps} steps, and {last} came.")
        for (name, dtype), values in zip(_STEP_COLUMNS.items(), columns, strict=True):
            row = values.astype(dtype)
            self._write(self._places[f"cortado/{name}"] + first * row.itemsize, row.tobytes())
        self._write(self._places["cortado/steps_written"], np.int64(last).tobytes())
        self.steps_written = last

    def close(self) -> None:
        """Ends the file; without any frame, none is left behind."""
        self._file.close()
        if self.frames_written == 0:
            self._partial.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _checked(self, name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[Any]:
        array = np.asarray(values, dtype=self._dtype)
        if array.shape != shape:
            raise InputError(f"Expected {name} of shape {shape}, found {array.shape}.")
        return array

    def _vectors(self, name: str, values: ArrayLike) -> NDArray[Any]:
        """The values as (n, 3), with z = 0 in 2-D."""
        array = self._checked(name, values, self._shape)
        return np.pad(array, ((0, 0), (0, 3 - array.shape[1])))

    def _write(self, place: int, content: bytes) -> None:
        rest = memoryview(content)
        try:
            self._file.seek(place)
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as problem:
            raise CortadoError(
                f"A frame could not be written to {self.path} ({problem}); the {self.frames_written} frames "
                f"before it are kept, free some space or choose another --out."
            ) from problem


def read(path: str | Path) -> dict[str, NDArray[Any]]:
    """Reads the frames and steps that were completed, while the writer is at work or after its death.

    Returns:
        times (frames,) [s], steps (frames,), positions (frames, n, d) [m], velocities (frames, n, d) [m/s],
        iterations (steps,), density_errors (steps,) and converged (steps,) bool as in `Trajectory`, and
        under its own name every scalar field (frames, n).

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
            return _read_arrays(file)
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as problem:
        raise InputError(f"{path} cannot be read as a VTKHDF trajectory: {problem}.") from problem


def _read_arrays(file: Any) -> dict[str, NDArray[Any]]:
    vtk, own = file["VTKHDF"], file["cortado"]
    dimension, particles = int(own.attrs["dimension"]), int(vtk["NumberOfPoints"][0])
    times = vtk["Steps/Values"][:]
    frames, steps = len(times), int(own["steps_written"][0])

    def rows(dataset: Any) -> NDArray[Any]:
        return dataset[: frames * particles].reshape(frames, particles, *dataset.shape[1:])

    arrays = {name: rows(dataset) for name, dataset in vtk["PointData"].items()}
    arrays["velocities"] = np.ascontiguousarray(arrays.pop("velocity")[..., :dimension])
    arrays["positions"] = np.ascontiguousarray(rows(vtk["Points"])[..., :dimension])
    arrays |= {name: own[name][:steps] for name in _STEP_COLUMNS}
    return arrays | {"times": times, "steps": own["frame_steps"][:frames]}


def _create_layout(
    path: Path, frames: int, shape: tuple[int, int], dtype: np.dtype[Any], steps: int, scalars: Sequence[str]
) -> dict[str, int]:
    """Creates the whole file with room for every frame, and returns the byte at which each dataset begins."""
    import h5py

    particles, dimension = shape
    # The oldest encoding of object headers has no checksums, which would forbid changing the count in place.
    with h5py.File(path, "w", libver=("earliest", "v108")) as file:
        vtk = file.create_group("VTKHDF")
        series = vtk.create_group("Steps")
        series.attrs["NSteps"] = np.int64(_SENTINEL)
        places = {"VTKHDF/Steps/Values": _reserve(series, "Values", (frames,), np.float64)}
        own = file.create_group("cortado")
        own.attrs["dimension"] = dimension
        places["cortado/steps_written"] = _reserve(own, "steps_written", (1,), np.int64)
        places["cortado/frame_steps"] = _reserve(own, "frame_steps", (frames,), np.int64)
        for name, column in _STEP_COLUMNS.items():
            places[f"cortado/{name}"] = _reserve(own, name, (max(steps, 1),), column)
        vtk.attrs["Version"] = np.array([2, 2], np.int64)
        vtk.attrs.create("Type", b"PolyData", dtype=h5py.string_dtype("ascii", 8))
        vtk["NumberOfPoints"] = np.array([particles], np.int64)
        places["VTKHDF/Points"] = _reserve(vtk, "Points", (frames * particles, 3), dtype)
        data, data_offsets = vtk.create_group("PointData"), series.create_group("PointDataOffsets")
        for name in ("velocity", *scalars):
            row = (3,) if name == "velocity" else ()
            places[f"VTKHDF/PointData/{name}"] = _reserve(data, name, (frames * particles, *row), dtype)
            data_offsets[name] = np.arange(frames) * particles
        for topology in _TOPOLOGIES:
            _write_cells(vtk.create_group(topology), particles if topology == "Vertices" else 0)
        series["PartOffsets"] = np.zeros(frames, np.int64)
        series["NumberOfParts"] = np.ones(frames, np.int64)
        series["PointOffsets"] = np.arange(frames) * particles
        for name in ("CellOffsets", "ConnectivityIdOffsets"):
            series[name] = np.zeros((frames, len(_TOPOLOGIES)), np.int64)
    return places


def _reserve(group: Any, name: str, shape: tuple[int, ...], dtype: Any) -> int:
    """Creates a contiguous dataset with its place in the file, unwritten; returns where it begins [byte]."""
    from h5py import h5d, h5p, h5s, h5t

    options = h5p.create(h5p.DATASET_CREATE)
    options.set_alloc_time(h5d.ALLOC_TIME_EARLY)
    options.set_fill_time(h5d.FILL_TIME_NEVER)
    kind = h5t.py_create(np.dtype(dtype), logical=True)
    return h5d.create(group.id, name.encode(), kind, h5s.create_simple(shape), options).get_offset()


def _write_cells(group: Any, cells: int) -> None:
    """One cell per point, shared by all frames (their offsets into it are zero)."""
    group["NumberOfConnectivityIds"] = np.array([cells], np.int64)
    group["NumberOfCells"] = np.array([cells], np.int64)
    group["Connectivity"] = np.arange(cells)
    group["Offsets"] = np.arange(cells + 1)


class _FrameCount:
    """The four words that say how many frames there are: where they stand, and their bytes for a count."""

    def __init__(self, path: Path, frames: int, values_place: int) -> None:
        with open(path, "rb") as file:
            head = file.read(_PAGE)
        self.place = head.index(struct.pack("<q", _SENTINEL))
        layout = b"\3\1" + struct.pack("<qq", values_place, 8 * frames)  # version, contiguous, address, size
        layout_place = head.index(layout, self.place)
        extents = b"\1\1\1" + bytes(5) + struct.pack("<qq", frames, frames)  # version, rank, has a maximum
        self._extents = head.index(extents, self.place, layout_place) + 8 - self.place
        self._size = layout_place + 10 - self.place
        self._template = head[self.place : layout_place + len(layout)]

    def words(self, count: int) -> bytes:
        """The bytes to write at `place`."""
        content = bytearray(self._template)
        struct.pack_into("<q", content, 0, count)
        struct.pack_into("<qq", content, self._extents, count, count)
        struct.pack_into("<q", content, self._size, 8 * count)
        return bytes(content)
