"""Reads points from NumPy files and from the formats of VTK.

The libraries VTK and HDF5 trust the contents of a file. A damaged file may make VTK or HDF5 hang, use all memory or
crash. A separate process with limited time and memory, ``python -m cortado.scene.point_files FILE``, therefore reads
VTK and HDF5 files. The process writes the points (n, 3) or (n, 2) in NumPy's format to standard output, or a reason
with the exit code `REFUSED`.
"""

import io
import math
import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from cortado.discretise.shapes import Points
from cortado.errors import InputError, Words, shown
from cortado.files.disk import cached_by_file, reason

MOST_POINTS = 10_000_000
REFUSED = 3
ROOM = 2**30
"""Constant part of the reading process's memory limit [byte]. The limit also includes 20 times the file's size."""


class Refused(Exception):
    """The reason why a file of points cannot be used."""


def _by_vtk(path: str) -> Any:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkIOLegacy import vtkDataSetReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    reader = vtkXMLPolyDataReader() if path.endswith(".vtp") else vtkDataSetReader()
    messages = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(messages)  # VTK has no exceptions
    reader.SetFileName(path)
    reader.Update()
    output = reader.GetOutput()
    points = output.GetPoints() if hasattr(output, "GetPoints") else None
    # A message that quotes what is no text comes as bytes.
    if "ERROR" in str(messages.GetOutput()) or points is None:
        raise Refused("holds no points that VTK can read")
    _check_count(points.GetNumberOfPoints())
    return vtk_to_numpy(points.GetData())


def _hdf5(path: str) -> Any:
    import h5py

    with h5py.File(path, "r") as file:
        if "cortado" in file:
            return _trajectory(path)
        root = file["VTKHDF"]
        points, parts, begin = root["Points"], slice(None), 0
        if "Steps" in root:
            steps = root["Steps"]
            if steps.attrs["NSteps"] < 1:
                raise Refused("holds no step")
            first = int(steps["PartOffsets"][0])
            parts = slice(first, first + (int(steps["NumberOfParts"][0]) if "NumberOfParts" in steps else 1))
            begin = int(steps["PointOffsets"][0])
        count = int(root["NumberOfPoints"][parts].sum())
        _check_count(count)
        if begin < 0 or begin + count > len(points) or points.shape[1:] != (3,):
            raise Refused(f"holds points of shape {points.shape}, but says that its first {count} begin at {begin}")
        return points[begin : begin + count]


def _trajectory(path: str) -> Any:
    from cortado.files import vtkhdf

    try:
        positions = vtkhdf.read(path)["positions"]
    except InputError:
        raise Refused("is a damaged trajectory, or one of another version of Cortado") from None
    if not len(positions):
        raise Refused("holds no step")
    _check_count(positions.shape[1])
    return positions[0]


READERS: dict[str, Callable[[str], Any]] = {".vtk": _by_vtk, ".vtp": _by_vtk, ".vtkhdf": _hdf5}


def _check_count(count: int) -> None:
    if not 0 < count <= MOST_POINTS:
        raise Refused(f"holds {count} points, but must hold from 1 to {MOST_POINTS}")


def main(path: str) -> int:
    output, nothing = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    for terminal in (1, 2):
        os.dup2(nothing, terminal)
    code, content = 0, io.BytesIO()
    try:
        if sys.platform != "win32":
            import resource

            most = ROOM + 20 * os.stat(path).st_size
            for what, limit in ((resource.RLIMIT_DATA, most), (resource.RLIMIT_CORE, 0)):
                hardest = resource.getrlimit(what)[1]
                limit = limit if hardest == resource.RLIM_INFINITY else min(limit, hardest)
                resource.setrlimit(what, (limit, hardest))
        np.save(content, READERS[Path(path).suffix](path), allow_pickle=False)
    except Refused as problem:
        code, content = REFUSED, io.BytesIO(str(problem).encode())
    except ModuleNotFoundError:
        code, content = REFUSED, io.BytesIO(b"needs the package vtk to be read; install it with: pip install vtk")
    with open(output, "wb") as file:
        file.write(content.getbuffer())
    return code


SUFFIXES = (".npy", *READERS)
MOST_POINT_BYTES = 2**30
SECONDS, BYTES_PER_SECOND = 15.0, 5e6
"""The time limit for reading a file is ``SECONDS`` [s] plus the file size divided by ``BYTES_PER_SECOND`` [byte/s]."""


def read_points(path: str, dimension: int) -> Points:
    """Read points (n, d) [m] from a file, as a read-only array. Raise `InputError` with the name of the file."""
    if Path(path).suffix not in SUFFIXES:
        raise InputError(f"{path!r} does not end in one of {', '.join(SUFFIXES)}.")
    return _read(path, dimension)


@cached_by_file(4, MOST_POINT_BYTES)
def _read(path: str, dimension: int) -> Points:
    array = _read_npy(path, dimension) if Path(path).suffix == ".npy" else _read_apart(path)
    if array.ndim == 2 and array.shape[1] == 3 and dimension == 2 and Path(path).suffix in READERS:
        array = array[:, :2]  # VTK knows no plane
    _check_form(path, array.shape, array.dtype, dimension)
    points = np.array(array, dtype=np.float64)
    if not np.isfinite(points).all():
        raise InputError(f"{path!r} holds positions that are not finite, but must hold metres.")
    points.flags.writeable = False
    return points


def _check_form(path: str, shape: tuple[int, ...], dtype: np.dtype[Any], dimension: int) -> None:
    if dtype.kind not in "fiu" or len(shape) != 2 or shape[1] != dimension or shape[0] < 1:
        raise InputError(f"{path!r} holds {dtype} of shape {shape}, but must hold numbers of shape (n, {dimension}).")
    if shape[0] > MOST_POINTS:
        raise InputError(f"{path!r} holds {shape[0]} points, but must hold at most {MOST_POINTS}.")


def _read_npy(path: str, dimension: int) -> Any:
    headers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    try:
        with open(path, "rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the header is Python, which may warn of what it finds
            shape, by_columns, dtype = headers[npy.read_magic(file)](file)
            _check_form(path, shape, dtype, dimension)
            wanted, size = file.tell() + math.prod(shape) * dtype.itemsize, os.fstat(file.fileno()).st_size
            if wanted != size:
                found = f"says that it holds {dtype} of shape {shape}, which takes {wanted} bytes"
                raise InputError(f"{path!r} {found}, but it has {size}.")
            return np.fromfile(file, dtype, math.prod(shape)).reshape(shape, order="F" if by_columns else "C")
    except InputError:
        raise
    except Exception as problem:  # of many types, where a header is damaged
        raise InputError(f"{path!r} is no array that NumPy can read ({shown(Words(reason(problem)))}).") from None


def _read_apart(path: str) -> Any:
    limit = SECONDS + os.path.getsize(path) / BYTES_PER_SECOND
    command = [sys.executable, "-P", "-m", "cortado.scene.point_files", path]
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")  # each would reserve memory
    environment = {**os.environ, **threads, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    nothing = subprocess.DEVNULL
    try:
        done = subprocess.run(
            command, env=environment, timeout=limit, check=False, stdin=nothing, stdout=subprocess.PIPE, stderr=nothing
        )
    except subprocess.TimeoutExpired:
        raise InputError(f"{path!r} was not read within {limit:.0f} s; it may be damaged.") from None
    except OSError as problem:
        raise InputError(f"{path!r} cannot be read, as no process can be started ({reason(problem)}).") from None
    if done.returncode == 0:
        return np.load(io.BytesIO(done.stdout), allow_pickle=False)
    said = done.stdout.decode() if done.returncode == REFUSED else "holds no points that can be read; it may be damaged"
    raise InputError(f"{path!r} {said}.")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
