"""The layout of a trajectory file, with room for every frame from the start.

Every dataset is contiguous, sparse on disk and at a fixed offset; `PointOffsets` maps a frame to its rows. Datasets
that count points and cells have two parts, one with all particles and an empty one. A missing frame refers to the empty
part; one number in `PartOffsets` makes the frame appear, so that readers such as ParaView never see sizes change.

HDF5 only creates the file in memory, and plain writes copy it to disk, because HDF5 crashes on a full disk (HDF5 2.0).
Its mode for one writer and many readers is not used: after a kill, VTK cannot open the file.

Format: https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/vtkhdf_specifications.html
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError
from cortado.files.disk import write_fully

FORMAT = 3
"""Version of the group "cortado"; version 1 had no checksums, version 2 no states to continue from."""
WRITTEN, MISSING = 0, 1
"""Numbers of the part for a written frame and of the part for a missing frame."""
_TOPOLOGIES = ("Vertices", "Lines", "Polygons", "Strips")
_PAGE = 4096


@dataclass(frozen=True)
class FileLayout:
    times: NDArray[np.float64]
    """(frames,) expected times [s]"""
    particles: int
    dimension: int
    """2 or 3; in 2-D the stored z is 0"""
    precision: str = "float32"
    """"float32" or "float64": type of positions, velocities and scalars"""
    steps: int = 0
    scalars: Sequence[str] = ()
    vectors: Sequence[str] = ()
    others: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """further arrays of every frame by name, with the types and shapes of the first frame"""
    constants: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    diagnostics: Mapping[str, Any] = field(default_factory=dict)
    origin: str = ""
    marks: tuple[float, ...] = ()
    """time of the first frame [s] and frames per second [1/s]; empty if frames are chosen by steps"""

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
        """Shapes of a row of each dataset with n rows a frame, by name, in the order of their checksum."""
        fields: dict[str, tuple[int, ...]] = {
            **dict.fromkeys(("velocity", *self.vectors), (3,)),
            **dict.fromkeys(self.scalars, ()),
        }
        return {"VTKHDF/Points": (3,)} | {f"VTKHDF/PointData/{name}": fields[name] for name in sorted(fields)}

    @property
    def records(self) -> np.dtype[Any]:
        return np.dtype(sorted(self.diagnostics.items()))

    @property
    def seed(self) -> int:
        particles = self.shape[0]
        kinds = {name: (self.dtype, (particles, *row)) for name, row in self.rows.items()}
        kinds |= {name: (array.dtype, array.shape) for name, array in sorted(self.others.items())}
        return frames_seed(self.shape, kinds, self.constants, self.origin, self.marks)

    @property
    def size(self) -> int:
        numbers = sum(int(np.prod(row, dtype=int)) for row in self.rows.values())
        others, constants = (sum(a.nbytes for a in arrays.values()) for arrays in (self.others, self.constants))
        frame = (
            self.shape[0] * numbers * self.dtype.itemsize + others + 8 * (17 + len(self.scalars) + len(self.vectors))
        )
        return len(self.times) * frame + self.steps * self.records.itemsize + 8 * 2 * self.shape[0] + constants

    def create(self) -> tuple[Pages, dict[str, int]]:
        """Return the empty file, and the byte offset of each dataset."""
        import h5py

        pages = Pages()
        # Numbers that are aligned lie in one page and change in one go.
        with h5py.File(pages, "w", libver=("earliest", "v108"), alignment_threshold=1, alignment_interval=8) as file:
            places = self._create_own(file.create_group("cortado"))
            places |= self._create_vtk(file.create_group("VTKHDF"))
        return pages, places

    def _create_own(self, own: Any) -> dict[str, int]:
        own.attrs["format"], own.attrs["dimension"] = FORMAT, self.shape[1]
        if self.origin:
            own.attrs["origin"] = self.origin
        if self.marks:
            own.attrs["marks"] = np.array(self.marks)
        group = own.create_group("constants")
        for name, array in self.constants.items():
            group[name] = array
        own["progress"] = np.array([[0, self.seed], [0, steps_seed(self.records)]], np.uint32)
        places = {"cortado/progress": own["progress"].id.get_offset()}
        places["cortado/frame_steps"] = _reserve(own, "frame_steps", (len(self.times),), np.int64)
        states, steps = own.create_group("states"), own.create_group("diagnostics")
        for name, array in self.others.items():
            shape = (len(self.times), *array.shape)
            places[f"cortado/states/{name}"] = _reserve(states, name, shape, array.dtype)
        for name, dtype in self.diagnostics.items():
            places[f"cortado/diagnostics/{name}"] = _reserve(steps, name, (max(self.steps, 1),), dtype)
        return places

    def _create_vtk(self, vtk: Any) -> dict[str, int]:
        import h5py

        frames, particles = len(self.times), self.shape[0]
        vtk.attrs["Version"] = np.array([2, 2], np.int64)
        vtk.attrs.create("Type", b"PolyData", dtype=h5py.string_dtype("ascii", 8))
        vtk["NumberOfPoints"] = np.array([particles, 0])
        for topology in _TOPOLOGIES:
            _write_cells(vtk.create_group(topology), particles if topology == "Vertices" else 0)
        series = vtk.create_group("Steps")
        series.attrs["NSteps"] = np.int64(frames)
        series["Values"] = self.times
        series["PartOffsets"] = np.full(frames, MISSING)
        series["NumberOfParts"] = np.ones(frames, np.int64)
        series["PointOffsets"] = np.arange(frames) * particles
        for name in ("CellOffsets", "ConnectivityIdOffsets"):
            series[name] = np.zeros((frames, len(_TOPOLOGIES)), np.int64)
        for name in ("velocity", *self.scalars, *self.vectors):
            series[f"PointDataOffsets/{name}"] = np.arange(frames) * particles
        vtk.create_group("PointData")
        places = {
            name: _reserve(vtk.file, name, (frames * particles, *row), self.dtype) for name, row in self.rows.items()
        }
        return places | {f"VTKHDF/Steps/{name}": series[name].id.get_offset() for name in ("Values", "PartOffsets")}


def frames_seed(
    shape: tuple[int, int],
    kinds: Mapping[str, tuple[np.dtype[Any], tuple[int, ...]]],
    constants: Mapping[str, NDArray[Any]],
    origin: str,
    marks: tuple[float, ...],
) -> int:
    """Return the checksum of no frames, which depends on ``kinds``, type and shape of each field, and on constants."""
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


def _write_cells(group: Any, cells: int) -> None:
    """Write one cell per point, shared by all frames, and no cells for the empty part."""
    group["NumberOfConnectivityIds"] = np.array([cells, 0])
    group["NumberOfCells"] = np.array([cells, 0])
    group["Connectivity"] = np.arange(cells)
    group["Offsets"] = np.append(np.arange(cells + 1), 0)


class Pages(io.RawIOBase):
    """A file in memory that stores only written pages."""

    def __init__(self) -> None:
        self._pages: dict[int, bytearray] = {}
        self._place = self._end = 0

    def save(self, file: Any) -> None:
        """Write the pages to an open file on disk, which stays sparse."""
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
        """Yield each page with an offset in it and the part of the content that belongs there; advance the position."""
        rest = memoryview(content)
        while rest:
            number, place = divmod(self._place, _PAGE)
            part, rest = rest[: _PAGE - place], rest[_PAGE - place :]
            yield self._pages.setdefault(number, bytearray(_PAGE)), place, part
            self._place += len(part)
