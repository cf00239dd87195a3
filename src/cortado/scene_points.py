"""Points from files: NumPy arrays and what VTK reads."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cortado.errors import InputError
from cortado.shapes import Points

_VTK_READERS = {".vtk": "vtkDataSetReader", ".vtp": "vtkXMLPolyDataReader", ".vtkhdf": "vtkHDFReader"}
SUFFIXES = (".npy", *_VTK_READERS)


def read_points(path: str, dimension: int) -> Points:
    """(n, d) [m], not to be written to. Raises `InputError`, a sentence that names the file."""
    if Path(path).suffix not in SUFFIXES:
        raise InputError(f"{path!r} does not end in one of {', '.join(SUFFIXES)}.")
    try:
        stat = Path(path).stat()
    except (OSError, ValueError) as problem:
        raise InputError(f"{path!r} cannot be opened ({_reason(problem)}).") from None
    return _read(path, dimension, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=4)
def _read(path: str, dimension: int, changed: int, size: int) -> Points:
    """Read once for each version of the file: the time of its last change and its size stand for the version."""
    array = _read_npy(path) if Path(path).suffix == ".npy" else _read_vtk(path)
    if array.ndim == 2 and array.shape[1] == 3 and dimension == 2 and Path(path).suffix in _VTK_READERS:
        array = array[:, :2]  # VTK knows no plane
    if array.dtype.kind not in "fiu" or array.ndim != 2 or array.shape[1] != dimension or not len(array):
        raise InputError(
            f"{path!r} holds {array.dtype} of shape {array.shape}, but must hold numbers of shape (n, {dimension})."
        )
    points = np.array(array, dtype=np.float64)
    if not np.isfinite(points).all():
        raise InputError(f"{path!r} holds positions that are not finite, but must hold metres.")
    points.flags.writeable = False
    return points


def _read_npy(path: str) -> Any:
    """The array, mapped: a header that promises more than the file holds must not allocate it."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, SyntaxError, TypeError, OverflowError, MemoryError) as problem:
        raise InputError(f"{path!r} is no array that NumPy can read ({_reason(problem)}).") from None
    if not isinstance(array, np.ndarray):
        raise InputError(f"{path!r} is an archive of arrays, but must be one array.")
    return array


def _read_vtk(path: str) -> Any:
    try:
        import vtk
        from vtk.util.numpy_support import vtk_to_numpy
    except ImportError:
        raise InputError(f"{path!r} needs the package vtk to be read; install it with: pip install vtk.") from None
    terminal, messages = vtk.vtkOutputWindow.GetInstance(), vtk.vtkStringOutputWindow()
    verbosity = vtk.vtkLogger.GetCurrentVerbosityCutoff()
    vtk.vtkOutputWindow.SetInstance(messages)  # VTK has no exceptions: it prints, here and to its log
    vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_OFF)
    try:
        reader = getattr(vtk, _VTK_READERS[Path(path).suffix])()
        reader.SetFileName(path)
        reader.Update()
        output = reader.GetOutput()
    finally:
        vtk.vtkLogger.SetStderrVerbosity(verbosity)
        vtk.vtkOutputWindow.SetInstance(terminal)
    points = output.GetPoints() if hasattr(output, "GetPoints") else None
    if "ERROR" in messages.GetOutput() or points is None or not points.GetNumberOfPoints():
        raise InputError(f"{path!r} holds no points that VTK can read.")
    return vtk_to_numpy(points.GetData())


def _reason(problem: Exception) -> str:
    """The first line of what an exception says."""
    text = getattr(problem, "strerror", None) or str(problem) or type(problem).__name__
    return text.splitlines()[0].rstrip(".")
