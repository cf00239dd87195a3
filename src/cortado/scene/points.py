"""Points from files: NumPy arrays and what VTK reads."""

import io
import math
import os
import subprocess
import sys
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from cortado.discretise.shapes import Points
from cortado.errors import InputError, Words, shown
from cortado.files.input_files import reason, regular_file
from cortado.scene.point_reader import MOST_POINTS, READERS, REFUSED

SUFFIXES = (".npy", *READERS)
MOST_BYTES = 2**30
"""Of a file of points."""
SECONDS, BYTES_PER_SECOND = 15.0, 5e6
"""How long a file may take to be read at most: this long, and its size over this pace."""


def read_points(path: str, dimension: int) -> Points:
    """(n, d) [m], not to be written to. Raises `InputError`, a sentence that names the file."""
    if Path(path).suffix not in SUFFIXES:
        raise InputError(f"{path!r} does not end in one of {', '.join(SUFFIXES)}.")
    try:
        stat = regular_file(path, MOST_BYTES)
    except OSError as problem:
        raise InputError(f"{path!r} cannot be opened ({reason(problem)}).") from None
    return _read(path, dimension, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=4)
def _read(path: str, dimension: int, changed: int, size: int) -> Points:
    """Read once for each version of the file: the time of its last change and its size stand for the version."""
    array = _read_npy(path, size, dimension) if Path(path).suffix == ".npy" else _read_apart(path, size)
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


def _read_npy(path: str, size: int, dimension: int) -> Any:
    """The array, whose header is held against the size of the file before anything else is read."""
    headers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    try:
        with open(path, "rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the header is Python, which may warn of what it finds
            shape, by_columns, dtype = headers[npy.read_magic(file)](file)
            _check_form(path, shape, dtype, dimension)
            wanted = file.tell() + math.prod(shape) * dtype.itemsize
            if wanted != size:
                found = f"says that it holds {dtype} of shape {shape}, which takes {wanted} bytes"
                raise InputError(f"{path!r} {found}, but it has {size}.")
            return np.fromfile(file, dtype, math.prod(shape)).reshape(shape, order="F" if by_columns else "C")
    except InputError:
        raise
    except Exception as problem:  # of many types, where a header is damaged
        raise InputError(f"{path!r} is no array that NumPy can read ({shown(Words(reason(problem)))}).") from None


def _read_apart(path: str, size: int) -> Any:
    """What another process reads: see `cortado.scene.point_reader`."""
    limit = SECONDS + size / BYTES_PER_SECOND
    command = [sys.executable, "-P", "-m", "cortado.scene.point_reader", path]
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
