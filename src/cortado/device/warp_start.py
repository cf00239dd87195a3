"""Warp is started without a word, with a folder for compiled kernels that can be written, and its devices are named.

What Warp says of itself is kept back, unless it is asked for; `cortado.device.modules` says what is compiled. Who
sets the environment variable CORTADO_VERBOSE to 1 hears all of it: the greeting, a line for every module that is
loaded, warnings about drivers. Who sets ``warp.config.log_level`` before the first simulation is made keeps that level,
if it is another one than Warp's own. Containers and clusters often have a home that is read-only or full.
"""

import atexit
import ctypes
import os
import re
import shutil
import struct
import sys
import tempfile
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import warp as wp

from cortado.errors import ComputationError, InputError, shown
from cortado.files.terminal import say

VERBOSE = "CORTADO_VERBOSE"


@contextmanager
def silenced() -> Iterator[None]:
    """Keep Warp silent in the block, as it starts; afterwards it prints warnings and errors alone. A log level chosen
    by the user is kept, and one below Warp's own keeps the start audible."""
    chosen = wp.config.log_level
    if os.environ.get(VERBOSE, "0") not in ("", "0") or chosen < wp.LOG_INFO:
        yield
        return
    wp.config.log_level = wp.LOG_ERROR
    try:
        with open(os.devnull, "w") as nothing, c_stderr_to(nothing.fileno()):
            yield
    finally:
        wp.config.log_level = max(chosen, wp.LOG_WARNING)


@contextmanager
def c_stderr_to(file: int) -> Iterator[None]:
    """Redirect stderr of C code in the block to an open file: Warp's warnings of a missing CUDA driver, and its
    compiler's errors."""
    try:
        stderr = os.dup(2)
    except OSError:  # there is none
        yield
        return
    try:
        os.dup2(file, 2)
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)


CACHE_PATH = "WARP_CACHE_PATH"
_COMPILING = re.compile(r"_p\d+_t\d+$")
"""Pattern of the end of a folder name in which a thread of a process compiles."""
ROOM = 16 * 2**20
"""Free disk space [bytes] needed for kernels; those of one run take a few MiB."""


@cache
def start_warp() -> None:
    """Start Warp, once a process, without its greeting. Where its cache cannot be written, a warning says so, and
    kernels that are not in it are compiled in a temporary folder; raises `ComputationError` where there is none either.
    """
    reason = _start()
    folder = wp.config.kernel_cache_dir
    reason = reason or _trouble(folder)
    if reason is None:
        return
    try:
        wp.config.kernel_cache_dir = _replacement(folder)
    except OSError:
        wp.config.kernel_cache_dir = None
    if wp.config.kernel_cache_dir is None or _trouble(wp.config.kernel_cache_dir):
        raise ComputationError(
            f"Compiled kernels can be kept neither in {folder} ({reason}) nor in a temporary folder; "
            f"set the environment variable {CACHE_PATH} to a folder that can be written."
        )
    _start()
    say(
        f"Warning: Compiled kernels cannot be kept in {folder} ({reason}), so new ones are compiled in every "
        f"run; mend that, or set the environment variable {CACHE_PATH} to a folder that can be written."
    )


def complaint(error: Exception) -> str | None:
    """Return a sentence for an error from loading or compiling a kernel; None for any other error."""
    frames = traceback.extract_tb(error.__traceback__)
    loading = any(frame.name == "load" and Path(frame.filename).parts[-3:-1] == ("warp", "_src") for frame in frames)
    missing = isinstance(error, RuntimeError) and str(error).startswith("Failed to find ")
    if not (loading or missing) or type(error).__module__.startswith("warp"):  # which are mistakes in a kernel
        return None
    reason = getattr(error, "strerror", None) or str(error).partition(" (")[0]
    return (
        f"A compiled kernel in {wp.config.kernel_cache_dir} cannot be used ({reason}): the disk may be full or the "
        f"file damaged; delete that folder, or set the environment variable {CACHE_PATH} to another one."
    )


def _start() -> str | None:
    """Start Warp, unless it has started; return why its cache cannot be made, None if it can."""
    try:
        with silenced():
            wp.init()
    except OSError as problem:
        return problem.strerror or str(problem)
    return None


def _trouble(folder: str) -> str | None:
    """Return why a folder has no room for kernels, or that one in it is damaged; None if all is well."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            free = shutil.disk_usage(folder).free
    except OSError as problem:
        return problem.strerror or str(problem)
    if free < ROOM:
        return f"only {free / 2**20:.1f} MiB are free there"
    damaged = next((kernel.name for kernel in _kernels(folder) if not _is_whole(kernel)), None)
    return None if damaged is None else f"{damaged} in it is damaged and should be deleted"


def _kernels(folder: str) -> Iterator[Path]:
    """Yield folders of kernels, except those being compiled by a process, which Warp renames in the end."""
    return (kernel for kernel in Path(folder).glob("wp_*") if not _COMPILING.search(kernel.name))


def _is_whole(kernel: Path) -> bool:
    """Test if a kernel's object files end with their table of sections, without which the loader prints at length; True
    except on Linux."""
    if sys.platform != "linux":
        return True
    for file in kernel.glob("*.o"):
        try:
            with file.open("rb") as stream:
                head, size = stream.read(64), file.stat().st_size
        except OSError:
            return False
        if len(head) < 64 or head[:4] != b"\x7fELF":
            return False
        (table,), (length, entries) = struct.unpack_from("<Q", head, 0x28), struct.unpack_from("<HH", head, 0x3A)
        if table + length * entries > size:
            return False
    return True


def _replacement(folder: str) -> str:
    """Return a temporary folder for kernels until the process ends, with links to intact ones of the cache."""
    temporary = tempfile.mkdtemp(prefix="cortado-kernels-")
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    with suppress(OSError):
        for kernel in filter(_is_whole, _kernels(folder)):
            (Path(temporary) / kernel.name).symlink_to(kernel)
    return temporary


Version = tuple[int, int]
VISIBLE = "CUDA_VISIBLE_DEVICES"
"""Name of the environment variable that says which GPUs a process has."""
PLACE = "https://nvidia.github.io/warp/stable/user_guide/installation.html"


def why_no_gpu() -> str:
    """Return in words why Warp, which has started, finds no GPU."""
    needed, found = _needed(), installed_driver()
    if needed is None or found is None or found >= needed:
        return "no GPU with a CUDA driver is found"
    return (
        f"the CUDA driver is too old, as it supports CUDA {_shown(found)} and Warp needs {_shown(needed)}: install a "
        f"newer driver of NVIDIA's, or see {PLACE}"
    )


def installed_driver() -> Version | None:
    """Return the version of CUDA that this machine's driver supports; None without a driver."""
    with suppress(OSError, AttributeError):
        library = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
        version = ctypes.c_int()
        if library.cuDriverGetVersion(ctypes.byref(version)) == 0 and version.value > 0:
            return version.value // 1000, version.value % 1000 // 10
    return None


def _needed() -> Version | None:
    """Return the version of CUDA that Warp needs; None where unknown, or built without CUDA."""
    with suppress(ImportError, AttributeError):  # Warp keeps it for itself, and may move it
        from warp._src.context import runtime

        return runtime.min_driver_version
    return None


def _shown(version: Version) -> str:
    return f"{version[0]}.{version[1]}"


def device_named(name: str) -> Any:
    """Return Warp's device of a name; raises `InputError` where there is none."""
    found = ", ".join(str(device) for device in wp.get_devices())
    none = "" if wp.get_cuda_device_count() else f"; {why_no_gpu()}"
    if not isinstance(name, str):
        raise InputError(f"device is {shown(name)}, but must be one of: {found}{none}.")
    try:
        if name == "cuda" and none:
            raise ValueError  # Warp itself would write on stderr
        return wp.get_device(name)
    except (RuntimeError, ValueError) as error:
        raise InputError(f"device is {shown(name)}, but must be one of: {found}{none}.") from error


def visible_gpus() -> list[str]:
    """Return the GPUs that this process may use, as CUDA names them."""
    start_warp()
    given = [name.strip() for name in os.environ.get(VISIBLE, "").split(",") if name.strip()]
    present = wp.get_cuda_device_count()
    return given[:present] if given else [str(k) for k in range(present)]
