"""Launch kernels with arguments by name, on a whole device or in ranges of particles on the cores of a CPU.

A bundle is a Warp struct of arrays, which is one argument of a kernel. Each field of a bundle is the array of the same
name. In a bundle called ``dot`` or ``bar``, the field ``x`` is the array ``x_dot`` or ``x_bar``.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
import warp as wp

from cortado.device.modules import announce
from cortado.device.precision import check_sum, lanes_of
from cortado.device.threads import MOST_CORES, WARP, in_parallel, usable_cores

MOST_BUNDLES = 4_096
_FIELDS: dict[Any, tuple[str, ...]] = {}


@cache
def bundle(**entries: Any) -> Any:
    words = (f"{name}_{wp.types.type_size_in_bytes(kind)}" for name, kind in entries.items())
    arrays = {name: wp.array(dtype=kind) for name, kind in entries.items()}
    made = wp.struct(type("_".join(("Bundle", *words)), (), {"__annotations__": arrays, "__module__": __name__}))
    _FIELDS[made] = tuple(arrays)
    return made


def unbundled(arguments: Iterable[Any]) -> Iterator[Any]:
    for argument in arguments:
        struct = getattr(argument, "_cls", None)
        if struct in _FIELDS:
            yield from (getattr(argument, name) for name in _FIELDS[struct])
        else:
            yield argument


Named = Mapping[str, Any]


def bound(kernel: wp.Kernel, groups: Sequence[Named], given: Named, filled: dict[Any, Any] | None = None) -> list[Any]:
    """Take each argument from ``given``, or else from the first group that has the argument's name. Bundles are cached
    in ``filled``."""
    names, arguments = _signature(kernel)
    for name in given:
        if name not in names:
            raise TypeError(f"kernel {kernel.key} has no argument {name!r}; it has {', '.join(names)}.")
    sources, found, filled = (given, *groups), [], {} if filled is None else filled
    for name, struct, fields in arguments:
        if struct is None:
            found.append(_found(name, sources, kernel))
            continue
        arrays = [_found(field, sources, kernel) for field in fields]
        key = (struct, *map(id, arrays))  # a bundle holds its arrays, so that their ids stay theirs
        if key not in filled:
            made = struct()
            for field, array in zip(_FIELDS[struct], arrays, strict=True):
                setattr(made, field, array)
            if len(filled) >= MOST_BUNDLES:
                filled.clear()
            filled[key] = made
        found.append(filled[key])
    return found


def _found(name: str, sources: Sequence[Named], kernel: wp.Kernel) -> Any:
    for source in sources:
        if name in source:
            return source[name]
    own, known = ", ".join(_signature(kernel)[0]), ", ".join(dict.fromkeys(name for one in sources for name in one))
    raise TypeError(f"argument {name!r} of kernel {kernel.key} is missing; it has {own}; known are {known}.")


@cache
def _signature(kernel: wp.Kernel) -> tuple[dict[str, None], list[tuple[str, Any, list[str]]]]:
    arguments = []
    for a in kernel.adj.args:
        struct = a.type if a.type.__hash__ and a.type in _FIELDS else None
        ending = f"_{a.label}" if a.label in ("dot", "bar") else ""
        arguments.append((a.label, struct, [name + ending for name in _FIELDS[struct]] if struct else []))
    return dict.fromkeys(name for label, _, arrays in arguments for name in (arrays or (label,))), arguments


MOST_PARTS = 32
LEAST_PART = 2000
PARTS_A_CORE = 4
"""Greatest number of ranges per core."""
LEAST_SHARED_PART = 10_000

Watcher = Callable[[str, Any, Sequence[Any], Callable[[], None]], None]
"""A watcher gets a kernel's name, threads and arguments, and the function that launches the kernel."""
_watchers: list[Watcher] = []


@contextmanager
def watched(watcher: Watcher) -> Iterator[None]:
    """Pass every launch of this process to ``watcher``, except launches in a replayed graph."""
    _watchers.append(watcher)
    try:
        yield
    finally:
        _watchers.remove(watcher)


def _perform(name: str, threads: Any, arguments: Sequence[Any], work: Callable[[], None]) -> None:
    if _watchers:
        _watchers[-1](name, threads, arguments, work)
    else:
        work()


def launch(
    kernel: wp.Kernel, threads: Any, device: Any, *groups: Named, block: int | None = None, **arguments: Any
) -> None:
    """``threads`` is a number or a shape. ``block`` is the number of GPU threads that share memory."""
    announce(kernel, device)
    inputs, sizes = bound(kernel, groups, arguments), {} if block is None else {"block_dim": block}
    work = partial(wp.launch, kernel, threads, inputs=inputs, device=device, record_tape=False, **sizes)
    _perform(kernel.key, threads, inputs, work)


def recorded(kernel: wp.Kernel, threads: int, device: Any, **arguments: Any) -> Callable[[], None]:
    announce(kernel, device)
    inputs = bound(kernel, (), arguments)
    command = wp.launch(kernel, threads, inputs=inputs, device=device, record_tape=False, record_cmd=True)
    return partial(_perform, kernel.key, threads, inputs, command.launch)


def launch_together(name: str, threads: int, arguments: Sequence[Any], work: Callable[[], None]) -> None:
    """Run ``work``, which launches several kernels that must be repeated together. Watchers get a single launch."""

    def unwatched() -> None:
        watchers = _watchers.copy()
        _watchers.clear()
        try:
            work()
        finally:
            _watchers.extend(watchers)

    _perform(name, threads, arguments, unwatched)


class KernelLauncher:
    """On a CPU, the cores share the launch of a kernel with the neighbourhood argument ``s``. Each launch covers a
    range of particles, and the kernel computes particle ``s.first + wp.tid()``. The number of cores does not change
    results."""

    def __init__(self, particles: int, device: Any, record_tape: bool):
        self.particles, self.device, self._record_tape = particles, device, record_tape
        self._cores = min(usable_cores(), MOST_CORES) if device.is_cpu and not record_tape else 1
        each = min(PARTS_A_CORE, MOST_PARTS // self._cores, particles // (self._cores * LEAST_SHARED_PART))
        most = self._cores * max(each, 1) if self._cores > 1 else 1
        self.parts = max(min(most, particles // LEAST_PART), 1)
        """Number of ranges of particles in a launch."""
        self.capturable = self.parts == 1
        self._bounds = [particles * part // self.parts for part in range(self.parts + 1)]
        self._side = wp.Stream(device) if device.is_cuda and not record_tape else None
        self._side_is_busy = False
        self._compiled: set[Any] = set()
        self._bundles: dict[tuple[Any, ...], Any] = {}
        self._whole: Any = None
        self._parts: list[Any] = []

    def __call__(self, kernel: wp.Kernel, *groups: Named, threads: int | None = None, **arguments: Any) -> None:
        inputs = bound(kernel, groups, arguments, self._bundles)
        entries = threads or self.particles
        if hasattr(inputs[0], "neighbours"):
            if threads is not None:
                raise TypeError(f"kernel {kernel.key} sums over neighbours, and has one thread for each particle.")
            check_sum(kernel)
            if not self.capturable and kernel in self._compiled:
                _perform(kernel.key, entries, inputs, partial(self._launch_parts, kernel, inputs))
                return
        announce(kernel, self.device)
        options = {"inputs": inputs, "device": self.device, "record_tape": self._record_tape}
        _perform(kernel.key, entries, inputs, partial(wp.launch, kernel, entries * lanes_of(kernel), **options))
        self._compiled.add(kernel)  # only now: an interrupted launch has compiled nothing

    def forget(self) -> None:
        self._bundles.clear()

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Launch kernels in a second GPU stream, concurrently with later launches until `join`."""
        self._side_is_busy = self._side is not None
        with wp.ScopedStream(self._side):
            yield

    def join(self) -> None:
        """Make later launches wait for the second GPU stream."""
        if self._side_is_busy:  # a stream that a capture has not seen must not be waited for within it
            wp.wait_stream(self._side)
            self._side_is_busy = False

    def _launch_parts(self, kernel: wp.Kernel, inputs: Sequence[Any]) -> None:
        whole = inputs[0]
        if self._whole is not whole:
            parts = [whole._cls() for _ in range(self.parts)]
            for number, part in enumerate(parts):
                for name in whole._cls.vars:
                    setattr(part, name, getattr(whole, name))
                part.first, part.part = self._bounds[number], number
            self._whole, self._parts = whole, parts

        def launch_part(part: int) -> None:
            threads, inputs_of_part = self._bounds[part + 1] - self._bounds[part], [self._parts[part], *inputs[1:]]
            wp.launch(kernel, threads, inputs=inputs_of_part, device=self.device, record_tape=False)

        in_parallel(launch_part, range(self.parts), min(self._cores, self.parts))


class CapturedGraph:
    """Unless ``is_warm``, the first call runs without a graph, as capture forbids loading modules and allocation."""

    def __init__(self, work: Callable[[], None], launch: KernelLauncher, is_warm: bool = False, lends: bool = True):
        """With ``lends``, other threads may use Warp while a CPU replays the graph."""
        self._work, self._launch = work, launch
        self._warm, self._graph = is_warm, None
        self._lends = lends and bool(launch.device.is_cpu)  # a GPU has one queue for all threads

    def __call__(self) -> None:
        if not self._warm or not self._launch.capturable:
            self._work()
            self._warm = True
            return
        if self._graph is None:
            with wp.ScopedCapture(device=self._launch.device) as capture:
                self._work()
            self._graph = capture.graph
        with WARP.lent() if self._lends else nullcontext():
            wp.capture_launch(self._graph)


BANDS = 8
LEAST, LEAST_SHARED_OFTEN = 1_000, 50_000
"""Least number of threads in a range, and least number for which a frequent launch is divided into ranges."""


class BandLauncher:
    """On a CPU the threads are divided into ranges. Kernels compute the value with index ``first + wp.tid()``."""

    def __init__(self, device: Any):
        self.device, self._compiled = device, set[Any]()

    def __call__(self, kernel: wp.Kernel, count: int, **arguments: Any) -> None:
        cores = min(usable_cores(), MOST_CORES) if self.device.is_cpu else 1
        bands = max(min(BANDS * cores, count // LEAST), 1) if cores > 1 else 1
        bounds = [count * band // bands for band in range(bands + 1)]

        def work(band: int) -> None:
            launch(kernel, bounds[band + 1] - bounds[band], self.device, first=bounds[band], **arguments)

        left = iter(range(bands))
        if kernel not in self._compiled:
            work(next(left))
            self._compiled.add(kernel)
        in_parallel(work, left, cores)

    def to_and_fro(self, kernel: wp.Kernel, rounds: int, values: wp.array, other: wp.array, **given: Any) -> wp.array:
        """Launch a kernel ``rounds`` times, swapping its input and output each time. Return the final output."""
        count, both = len(values), ({"values": values, "found": other}, {"values": other, "found": values})
        if self.device.is_cpu and count > LEAST_SHARED_OFTEN:
            ways: list[Callable[[], None]] = [partial(self, kernel, count, **given, **one) for one in both]
        else:
            ways = [recorded(kernel, count, self.device, first=0, **given, **one) for one in both]
        for k in range(rounds):
            ways[k % 2]()
        return other if rounds % 2 else values


class HostCopy:
    def __init__(self, array: wp.array):
        self._array, self._is_cpu = array, array.device.is_cpu
        self.is_fetched = False
        """True while the copy made by the last `fetch` is complete and current, so that `read` need not copy again."""

    @cached_property
    def _copy(self) -> wp.array:
        return self._array if self._is_cpu else wp.empty_like(self._array, device="cpu", pinned=True)

    @cached_property
    def _view(self) -> np.ndarray:
        return self._copy.numpy()

    def fetch(self) -> None:
        """Begin to copy from the device. The copy can be part of a captured graph."""
        if not self._is_cpu:
            wp.copy(self._copy, self._array)

    def read(self, rows: int | None = None) -> np.ndarray:
        """Wait until the device has finished the copy. The next call overwrites the result."""
        if not (self._is_cpu or self.is_fetched or rows == 0):
            self.fetch()
            wp.synchronize_stream(self._array.device)
        return self._view[:rows]
