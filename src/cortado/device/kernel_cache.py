"""The folder in which Warp keeps compiled kernels: another one where it cannot be written, a sentence where it fails.

Containers and clusters often have a home that is read-only or full.
"""

import atexit
import re
import shutil
import struct
import sys
import tempfile
import traceback
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

from cortado.device.silence import silenced
from cortado.errors import ComputationError
from cortado.files.terminal import say

VARIABLE = "WARP_CACHE_PATH"
_COMPILING = re.compile(r"_p\d+_t\d+$")
"""How Warp ends the name of a folder in which a thread of a process compiles."""
ROOM = 16 * 2**20
"""[bytes] that must be free for kernels; those of one run take a few MiB."""


@cache
def start_warp() -> None:
    """Start Warp, once a process, without its greeting (`cortado.device.silence`). Where its cache cannot be written, a
    warning says so, and kernels that are not in it are compiled in a temporary folder; raises `ComputationError` where
    there is none either."""
    import warp as wp

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
            f"set the environment variable {VARIABLE} to a folder that can be written."
        )
    _start()
    say(
        f"Warning: Compiled kernels cannot be kept in {folder} ({reason}), so new ones are compiled in every "
        f"run; mend that, or set the environment variable {VARIABLE} to a folder that can be written."
    )


def complaint(error: Exception) -> str | None:
    """What to say of an error that came out of loading or compiling a kernel; None for any other error."""
    import warp as wp

    frames = traceback.extract_tb(error.__traceback__)
    loading = any(frame.name == "load" and Path(frame.filename).parts[-3:-1] == ("warp", "_src") for frame in frames)
    missing = isinstance(error, RuntimeError) and str(error).startswith("Failed to find ")
    if not (loading or missing) or type(error).__module__.startswith("warp"):  # which are mistakes in a kernel
        return None
    reason = getattr(error, "strerror", None) or str(error).partition(" (")[0]
    return (
        f"A compiled kernel in {wp.config.kernel_cache_dir} cannot be used ({reason}): the disk may be full or the "
        f"file damaged; delete that folder, or set the environment variable {VARIABLE} to another one."
    )


def _start() -> str | None:
    """Start Warp, unless it has started; why its cache cannot be made, None if it can."""
    import warp as wp

    try:
        with silenced():
            wp.init()
    except OSError as problem:
        return problem.strerror or str(problem)
    return None


def _trouble(folder: str) -> str | None:
    """Why a folder has no room for kernels, or that one in it is damaged; None if all is well."""
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
    """Folders of kernels, without those that a process is compiling at the moment, which Warp renames in the end."""
    return (kernel for kernel in Path(folder).glob("wp_*") if not _COMPILING.search(kernel.name))


def _is_whole(kernel: Path) -> bool:
    """Whether the object files of a kernel have their table of sections, which stands at the end of a file; what prints
    more than a sentence where one has not is the loader. Elsewhere than on Linux nothing is looked at."""
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
    """A temporary folder for kernels, with those of the cache that are whole, until the process ends."""
    temporary = tempfile.mkdtemp(prefix="cortado-kernels-")
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    with suppress(OSError):
        for kernel in filter(_is_whole, _kernels(folder)):
            (Path(temporary) / kernel.name).symlink_to(kernel)
    return temporary
