"""Start Warp without messages, and compile Warp modules in parallel before their first launch.

The environment variable CORTADO_VERBOSE=1 shows Warp's messages. A ``warp.config.log_level`` that the user has changed
is respected.

On a CPU, LLVM needs a greater search depth than Warp's default to vectorise the loops over `UNROLL` neighbours.
`wp.force_load` with its own workers is not used, because it is slow and cannot be interrupted by Ctrl-C.
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
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import warp as wp

from cortado.device.threads import MOST_CORES, helpers, in_parallel, usable_cores
from cortado.errors import ComputationError, InputError, shown
from cortado.files.terminal import note, say, timed_note

SHALLOW, DEEP = "-slp-recursion-max-depth=4", "-slp-recursion-max-depth=7"
"""LLVM options for the search depth of vectorisation: Warp's default option, and Cortado's option."""
UNUSED = "-DWP_NO_BFLOAT16="


def kernel_module(name: str, backward: bool = False) -> Any:
    module = wp.get_module(f"cortado_{name}")
    module.options["enable_backward"] = backward
    flags = wp.config.cpu_compiler_flags
    module.options["cpu_compiler_flags"] = flags and flags.replace(SHALLOW, f"{DEEP} {UNUSED}")
    return module


class Kernels(NamedTuple):
    forward: Any
    tangent: Any
    """Kernel of forward mode, which computes the tangents ``x_dot`` of its outputs."""
    adjoint: Any
    """Kernel of reverse mode, which adds to the adjoints ``x_bar`` of its inputs."""


def by_name(*made: Any) -> SimpleNamespace:
    """Return Warp functions or kernels as attributes with the names of their Python functions."""
    return SimpleNamespace(**{one.func.__name__.rpartition("__")[2]: one for one in made})


def kind_of(forward: bool, taped: bool) -> str:
    """Kernels for Warp's tape have separate modules, because the adjoints of the kernels take long to compile."""
    if not forward:
        return "derivative"
    return "taped" if taped else "forward"


def is_derivative(module: Any) -> bool:
    return "_derivative_" in module.name or "_tangent_" in module.name


_ahead: WeakValueDictionary[int, Any] = WeakValueDictionary()
_begun: dict[Any, Future[None]] = {}
_looked_at: set[Any] = set()


class _Said:
    anything = False


def compile_ahead(owner: Any, device: Any, adjoints: bool = False) -> None:
    """Compile all kernels of an object and its parts in parallel, once per object, except kernels of forward mode. If
    only one module is missing, Warp compiles the module at its first launch."""
    if _ahead.get(id(owner)) is owner:
        return
    _ahead[id(owner)] = owner
    kernels = [one for one in kernels_of(owner) if "_tangent_" not in one.module.name]
    modules = _by_size([one for one in kernels if adjoints or not is_derivative(one.module)])
    wait([_begun.pop(module) for module in modules if module in _begun])
    missing = [module for module in modules if not _is_compiled(module, device)]
    if len(missing) < 2:
        return
    # For a GPU one after the other: NVRTC gains less from threads than it loses without its precompiled headers.
    cores = min(usable_cores(), MOST_CORES, len(missing)) if device.is_cpu else 1
    _Said.anything = True
    with timed_note(f"Compiling {len(missing)} kernel modules for {device.alias}, each once on this machine"):
        _compile_all(missing, device, cores)


def compile_meanwhile(owner: Any, device: Any) -> None:
    """Start to compile an object's kernels in another thread. `compile_ahead` waits for the result."""
    if not device.is_cpu or usable_cores() < 2:
        return
    modules = _by_size([kernel for kernel in kernels_of(owner) if not is_derivative(kernel.module)])
    if missing := [module for module in modules if module not in _begun and not _is_compiled(module, device)]:
        _Said.anything = True  # or else a line would come of what nobody waits for
        _begun.update(dict.fromkeys(missing, helpers().submit(_compile_all, missing, device, 1)))


def announce(kernel: wp.Kernel, device: Any) -> None:
    """Print a line on stderr before a kernel is compiled, once per process."""
    module = kernel.module
    if module not in _looked_at:
        _looked_at.add(module)
        if not _Said.anything and module.name.startswith("cortado_") and not _is_compiled(module, device):
            _Said.anything = True
            note("Compiling kernels, each once on this machine.")


def kernels_of(owner: Any) -> list[wp.Kernel]:
    seen: dict[int, Any] = {}
    waiting = [owner]
    while waiting:
        one = waiting.pop()
        if id(one) in seen:
            continue
        seen[id(one)] = one
        if isinstance(one, (list, tuple, set, frozenset)):
            waiting += one
        elif isinstance(one, Mapping):
            waiting += one.values()
        elif isinstance(one, SimpleNamespace) or any(b.__module__.startswith("cortado.") for b in type(one).__mro__):
            waiting += getattr(one, "__dict__", {}).values()
    return [one for one in seen.values() if isinstance(one, wp.Kernel)]


def _compile_all(modules: Sequence[Any], device: Any, cores: int) -> None:
    in_parallel(lambda module: wp.force_load(device, [module], max_workers=0), modules, cores)


def _by_size(kernels: Sequence[wp.Kernel]) -> list[Any]:
    sizes: dict[Any, int] = {}
    for kernel in kernels:
        source = kernel.adj.source
        sizes[kernel.module] = sizes.get(kernel.module, 0) + len(source) * (10 if "s.first" in source else 1)
    return sorted(sizes, key=lambda module: -sizes[module])


def _is_compiled(module: Any, device: Any) -> bool:
    block_dim = 1 if device.is_cpu else module.options["block_dim"]
    if (device.context, block_dim) in module.execs:
        return True
    folder = Path(wp.config.kernel_cache_dir, module.get_module_identifier(block_dim))
    return (folder / module._get_compile_output_name(device, block_dim=block_dim)).exists()


if hasattr(os, "register_at_fork"):
    # A child would wait for ever for what no thread of its own ends.
    os.register_at_fork(before=lambda: wait(list(_begun.values())))


VERBOSE = "CORTADO_VERBOSE"


@contextmanager
def c_stderr_to(file: int) -> Iterator[None]:
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
ROOM = 16 * 2**20


@cache
def start_warp() -> None:
    """If Warp's cache is unusable, kernels are compiled in a temporary folder, with a warning."""
    reason, folder, temporary = init_warp(), wp.config.kernel_cache_dir, None
    reason = reason or _trouble(folder)
    if reason is None:
        return
    with suppress(OSError):  # with links to the intact kernels in Warp's cache
        temporary = tempfile.mkdtemp(prefix="cortado-kernels-")
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        for kernel in filter(_is_whole, _kernels(folder)):
            (Path(temporary) / kernel.name).symlink_to(kernel)
    wp.config.kernel_cache_dir = temporary
    if temporary is None or _trouble(temporary):
        raise ComputationError(
            f"Compiled kernels can be kept neither in {folder} ({reason}) nor in a temporary folder; "
            f"set the environment variable {CACHE_PATH} to a folder that can be written."
        )
    init_warp()
    say(
        f"Warning: Compiled kernels cannot be kept in {folder} ({reason}), so new ones are compiled in every "
        f"run; mend that, or set the environment variable {CACHE_PATH} to a folder that can be written."
    )


def complaint(error: Exception) -> str | None:
    """Return a sentence for an error in loading or compiling a kernel, or None for any other error."""
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


def init_warp() -> str | None:
    """Return the reason why Warp cannot store kernels, or None."""
    chosen = wp.config.log_level
    quiet = os.environ.get(VERBOSE, "0") in ("", "0") and chosen >= wp.LOG_INFO
    try:
        with open(os.devnull, "w") as nothing, c_stderr_to(nothing.fileno()) if quiet else nullcontext():
            wp.config.log_level = wp.LOG_ERROR if quiet else chosen
            wp.init()
    except OSError as problem:
        return problem.strerror or str(problem)
    finally:
        wp.config.log_level = max(chosen, wp.LOG_WARNING) if quiet else chosen
    return None


def _trouble(folder: str) -> str | None:
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
    return (kernel for kernel in Path(folder).glob("wp_*") if not _COMPILING.search(kernel.name))


def _is_whole(kernel: Path) -> bool:
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


Version = tuple[int, int]
VISIBLE = "CUDA_VISIBLE_DEVICES"
PLACE = "https://nvidia.github.io/warp/stable/user_guide/installation.html"


def why_no_gpu() -> str:
    needed, found = _needed(), installed_driver()
    if needed is None or found is None or found >= needed:
        return "no GPU with a CUDA driver is found"
    return (
        "the CUDA driver is too old, as it supports CUDA {}.{} and Warp needs {}.{}: install a newer driver of "
        "NVIDIA's, or see {}".format(*found, *needed, PLACE)
    )


def installed_driver() -> Version | None:
    with suppress(OSError, AttributeError):
        library = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
        version = ctypes.c_int()
        if library.cuDriverGetVersion(ctypes.byref(version)) == 0 and version.value > 0:
            return version.value // 1000, version.value % 1000 // 10
    return None


def _needed() -> Version | None:
    with suppress(ImportError, AttributeError):  # Warp keeps it for itself, and may move it
        from warp._src.context import runtime

        return runtime.min_driver_version
    return None


def device_named(name: str) -> Any:
    found = ", ".join(str(device) for device in wp.get_devices())
    none = "" if wp.get_cuda_device_count() else f"; {why_no_gpu()}"
    with suppress(RuntimeError, ValueError):
        if isinstance(name, str) and not (name == "cuda" and none):  # of which Warp itself would write on stderr
            return wp.get_device(name)
    raise InputError(f"device is {shown(name)}, but must be one of: {found}{none}.")


def visible_gpus() -> list[str]:
    start_warp()
    given = [name.strip() for name in os.environ.get(VISIBLE, "").split(",") if name.strip()]
    present = wp.get_cuda_device_count()
    return given[:present] if given else [str(k) for k in range(present)]
