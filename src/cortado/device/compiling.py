"""Kernels are compiled before they are launched: all that a step needs, side by side, and one line says so.

Warp compiles a module when the first of its kernels is launched, one module after the other. For a CPU it precompiles
the headers that every module includes, with all that is in them, for each thread anew; here one thread does so for all,
and leaves out what no kernel of Cortado's uses. They take 1.0 s of a core of 2.5 GHz then, and not 1.7 s.
`wp.force_load` of all modules with workers of its own is as fast, but after Ctrl-C it waits for all of them, and of a
few at a time it takes 1.7 times as long.
"""

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from threading import Event, Lock
from types import SimpleNamespace
from typing import Any
from weakref import WeakValueDictionary

import warp as wp

from cortado.device.cores import usable_cores
from cortado.device.kernels import is_derivative
from cortado.device.threads import MOST_CORES, helpers
from cortado.files.terminal import note, timed_note

BUILDERS = ("build_cpu", "build_cuda")
"""Functions of Warp that compile the file of a module, one of their first two arguments."""
OURS = "wp_cortado_"
"""How the names of folders and files of our modules begin."""
UNUSED = "-DWP_NO_BFLOAT16="
"""Leaves the functions of bfloat16 numbers out of Warp's headers, as Warp itself does where it does not precompile."""
_ahead: WeakValueDictionary[int, Any] = WeakValueDictionary()
"""What was compiled ahead for, by its identity."""
_begun: dict[Any, Future[None]] = {}
"""Modules that another thread compiles, or has compiled, which nobody has asked for yet."""


def compile_ahead(owner: Any, device: Any) -> None:
    """Compile the modules of all kernels that an object of Cortado's holds, itself or by what it is made of, but those
    of derivatives: what a step of a solver is about to launch. Once for each object; those in the cache are left to be
    loaded when they are launched."""
    if _ahead.get(id(owner)) is not owner:
        _ahead[id(owner)] = owner
        _compile([kernel for kernel in kernels_of(owner) if not is_derivative(kernel.module)], device)


def compile_ahead_adjoint(owner: Any, device: Any) -> None:
    """The same for what a step back is about to launch: those of adjoints too."""
    if _ahead.get(id(owner)) is not owner:
        _ahead[id(owner)] = owner
        _compile([kernel for kernel in kernels_of(owner) if "_tangent_" not in kernel.module.name], device)


def compile_meanwhile(owner: Any, device: Any) -> None:
    """Begin to compile the same in another thread, on a CPU with a core to spare, while this one goes on with something
    else; `compile_ahead` waits for what was begun."""
    if not device.is_cpu or usable_cores() < 2:
        return
    sizes = _sizes([kernel for kernel in kernels_of(owner) if not is_derivative(kernel.module)])
    missing = _missing({module: size for module, size in sizes.items() if module not in _begun}, device)
    if missing:
        _Said.anything = True  # or else a line would come of what nobody waits for
        _begun.update(dict.fromkeys(missing, helpers().submit(_side_by_side, missing, device, 1)))


def begin_headers(kernel: wp.Kernel, device: Any) -> None:
    """Precompile Warp's headers in another thread, with a small kernel that is needed in any case, where the cache has
    no kernels of Cortado's yet; returns once nothing but the compiler goes on there."""
    if device.is_cpu and not any(Path(wp.config.kernel_cache_dir).glob(f"{OURS}*")):
        _HEADERS.begin(kernel.module, device)


def kernels_of(owner: Any) -> list[wp.Kernel]:
    """The kernels that an object of Cortado's holds, itself or by what it is made of."""
    found: dict[int, Any] = {}
    seen: dict[int, Any] = {}
    waiting = [owner]
    while waiting:
        one = waiting.pop()
        if id(one) in seen:
            continue
        seen[id(one)] = one
        if isinstance(one, wp.Kernel):
            found[id(one)] = one
        elif isinstance(one, (list, tuple, set, frozenset)):
            waiting += one
        elif isinstance(one, Mapping):
            waiting += one.values()
        elif isinstance(one, SimpleNamespace) or _is_ours(type(one)):
            waiting += getattr(one, "__dict__", {}).values()
    return list(found.values())


def _is_ours(kind: type) -> bool:
    return any(base.__module__.partition(".")[0] == "cortado" for base in kind.__mro__)


def _compile(kernels: Sequence[wp.Kernel], device: Any) -> None:
    """Compile and load the modules of kernels that are not in the cache, if there are several; one alone can as well be
    compiled when it is launched."""
    _HEADERS.wait()
    sizes = _sizes(kernels)
    wait([_begun.pop(module) for module in sizes if module in _begun])
    missing = _missing(sizes, device)
    if len(missing) < 2:
        return
    # For a GPU one after the other: NVRTC gains less from threads than it loses without its precompiled headers.
    cores = min(usable_cores(), MOST_CORES, len(missing)) if device.is_cpu else 1
    with _announced(len(missing), device):
        # The smallest comes first, with which the headers are precompiled; then those that take longest.
        _side_by_side([missing[-1], *missing[:-1]], device, cores)


def _sizes(kernels: Sequence[wp.Kernel]) -> dict[Any, int]:
    """The modules of kernels, and a number for each that grows with the time that it takes to compile."""
    found: dict[Any, int] = {}
    for kernel in kernels:
        found[kernel.module] = found.get(kernel.module, 0) + len(kernel.adj.source) * (1 + 9 * _sums(kernel))
    return found


def _missing(sizes: Mapping[Any, int], device: Any) -> list[Any]:
    """Which modules have to be compiled, those that take longest first."""
    return sorted((module for module in sizes if not _is_compiled(module, device)), key=lambda one: -sizes[one])


def _sums(kernel: wp.Kernel) -> bool:
    """Whether a kernel sums over neighbours, so that it takes long to compile."""
    return "s.first" in kernel.adj.source


def _is_compiled(module: Any, device: Any) -> bool:
    """Whether a module is loaded, or in the cache."""
    block_dim = 1 if device.is_cpu else module.options["block_dim"]
    if (device.context, block_dim) in module.execs:
        return True
    folder = Path(wp.config.kernel_cache_dir, module.get_module_identifier(block_dim))
    return (folder / module._get_compile_output_name(device, block_dim=block_dim)).exists()


def _side_by_side(modules: Sequence[Any], device: Any, cores: int) -> None:
    waiting = iter(modules)

    def take() -> None:
        for module in waiting:
            wp.force_load(device, [module], max_workers=0)

    called = [helpers().submit(take) for _ in range(cores - 1)]
    try:
        take()
    finally:
        for _ in waiting:  # after an interruption or a failure, nobody takes another
            pass
        begun = [helper for helper in called if not helper.cancel()]
        wait(begun)
    for helper in begun:
        helper.result()


class _Headers:
    """Warp's headers, precompiled once for all threads of this process."""

    def __init__(self) -> None:
        self._lock, self._made = Lock(), set[str]()
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._compiler = Event()
        self._begun: Future[None] | None = None

    def begin(self, module: Any, device: Any) -> None:
        """Compile a module in another thread."""
        if self._begun is None:
            _Said.anything = True  # or else a line would come of a second that nobody waits for
            self._begun = helpers().submit(wp.force_load, device, [module], max_workers=0)
            self._begun.add_done_callback(lambda _: self._compiler.set())
            self._compiler.wait()

    def wait(self) -> None:
        """Until what was begun has ended. If it failed, so will the launch that needs it, which says why."""
        if self._begun is not None:
            wait([self._begun])

    def build_cpu(self, build: Callable[..., Any], arguments: Sequence[Any], options: Mapping[str, Any]) -> Any:
        """Compile a file for a CPU. The first to come precompiles the headers, while others wait."""
        if not options.get("pch_dir"):
            return build(*arguments, **options)
        with self._lock:
            own = {"pch_dir": self._path(), "extra_flags": f"{options.get('extra_flags', '')} {UNUSED}"}
            key = repr(sorted((name, value) for name, value in options.items() if name != "pch_dir"))
            if key not in self._made:
                self._compiler.set()
                result = build(*arguments, **{**options, **own})
                self._made.add(key)
                return result
        return build(*arguments, **{**options, **own})

    def build_cuda(self, build: Callable[..., Any], arguments: Sequence[Any], options: Mapping[str, Any]) -> Any:
        """Compile a file for a GPU, as Warp does."""
        return build(*arguments, **options)

    def _path(self) -> str:
        """Of the folder of the headers; they are made again where it is gone, as after a child of a fork has ended."""
        if self._folder is None or not Path(self._folder.name).is_dir():
            if self._folder is not None:
                self._folder.cleanup()  # or else Python warns of it when it is collected
            self._folder = tempfile.TemporaryDirectory(prefix="cortado-headers-", ignore_cleanup_errors=True)
            self._made.clear()
        return self._folder.name


_HEADERS = _Headers()


def _wait_for_all() -> None:
    _HEADERS.wait()
    wait(list(_begun.values()))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_wait_for_all)  # a child would wait for ever for what no thread of its own ends


# ---- messages --------------------------------------------------------------------------------------------------------


class _Said:
    """Whether this process has announced that it compiles."""

    anything = False


@contextmanager
def _announced(count: int, device: Any) -> Iterator[None]:
    """One line on stderr: what is compiled, and at the end how long it took."""
    _Said.anything = True
    with timed_note(f"Compiling {count} kernel modules for {device.alias}, once on this machine"):
        yield


def watch_compilation() -> None:
    """From now on one line on stderr says so when a kernel of Cortado's has to be compiled, which takes long enough to
    wonder, and threads share precompiled headers; there is no message where all kernels come from the cache."""
    with suppress(ImportError):  # Warp keeps it for itself, and may move it
        from warp._src import build

        for name in BUILDERS:
            function = getattr(build, name, None)
            if function is not None and not hasattr(function, "__wrapped__"):
                setattr(build, name, _watched(function, getattr(_HEADERS, name)))


def _watched(function: Callable[..., Any], built: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(function)
    def watched(*arguments: Any, **options: Any) -> Any:
        ours = any(Path(str(argument)).name.startswith(OURS) for argument in arguments[:2])
        if ours and not _Said.anything:
            _Said.anything = True
            note("Compiling kernels, once on this machine.")
        return built(function, arguments, options) if ours else function(*arguments, **options)

    return watched
