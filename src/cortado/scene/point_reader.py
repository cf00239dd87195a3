"""A program that reads the points of a file of VTK: ``python -m cortado.scene.point_reader FILE``.

VTK and HDF5 trust what a file says of itself: a damaged one may make them print pages, wait, take all memory or end
the process. Here this happens to a process that has limits, and whose messages nobody sees. It writes the points (n, 3)
or (n, 2) in NumPy's own format to its standard output, or, with exit code `REFUSED`, why there are none.
"""

import io
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

MOST_POINTS = 10_000_000
"""Of a file."""
REFUSED = 3
ROOM = 2**30
"""Memory that any file may take [byte]; a large file may take more."""


class Refused(Exception):
    """Why a file cannot be used, a clause."""


def _poly_data(path: str) -> Any:
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    return _read_by_vtk(vtkXMLPolyDataReader(), path)


def _legacy(path: str) -> Any:
    from vtkmodules.vtkIOLegacy import vtkDataSetReader

    return _read_by_vtk(vtkDataSetReader(), path)


def _read_by_vtk(reader: Any, path: str) -> Any:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow

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
    """The points of the first step, of all its parts; those of a trajectory of Cortado's only if its checksums hold."""
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
    from cortado.errors import InputError
    from cortado.files import vtkhdf

    try:
        positions = vtkhdf.read(path)["positions"]
    except InputError:
        raise Refused("is a damaged trajectory, or one of another version of Cortado") from None
    if not len(positions):
        raise Refused("holds no step")
    _check_count(positions.shape[1])
    return positions[0]


READERS: dict[str, Callable[[str], Any]] = {".vtk": _legacy, ".vtp": _poly_data, ".vtkhdf": _hdf5}
"""By the end of a file's name."""


def _check_count(count: int) -> None:
    if not 0 < count <= MOST_POINTS:
        raise Refused(f"holds {count} points, but must hold from 1 to {MOST_POINTS}")


def _limit_memory(size: int) -> None:
    """For a file of a size [byte]: what VTK makes of it is several times as large, and an array of it on the way."""
    try:
        import resource
    except ImportError:  # on Windows
        return
    most = ROOM + 20 * size
    for what, limit in ((resource.RLIMIT_DATA, most), (resource.RLIMIT_CORE, 0)):
        hardest = resource.getrlimit(what)[1]
        resource.setrlimit(what, (limit if hardest == resource.RLIM_INFINITY else min(limit, hardest), hardest))


def main(path: str) -> int:
    """Reads and writes; returns the exit code."""
    output, nothing = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    for terminal in (1, 2):
        os.dup2(nothing, terminal)
    code, content = 0, io.BytesIO()
    try:
        _limit_memory(os.stat(path).st_size)
        np.save(content, READERS[Path(path).suffix](path), allow_pickle=False)
    except Refused as problem:
        code, content = REFUSED, io.BytesIO(str(problem).encode())
    except ModuleNotFoundError:
        code, content = REFUSED, io.BytesIO(b"needs the package vtk to be read; install it with: pip install vtk")
    with open(output, "wb") as file:
        file.write(content.getbuffer())
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
