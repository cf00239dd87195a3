"""Launches of kernels with arguments by name: each on a whole device, or cut into parts for the cores of a CPU.

Several arrays that a kernel takes as one argument are a bundle, so that its arguments can be read. A launch finds the
arrays of a bundle by their names, as it finds arguments. In a bundle called ``dot`` or ``bar``, x is the array
``x_dot`` or ``x_bar``. Kernels with few arrays take them as separate arguments: with a bundle, the density kernel is 6
% slower on an H200. So do kernels that a tape differentiates.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import cache, partial
from typing import Any

import numpy as np
import warp as wp

from cortado.device.modules import announce
from cortado.device.precision import check_lanes, lanes_of
from cortado.device.threads import MOST_CORES, WARP, in_parallel, usable_cores

MOST_BUNDLES = 4_096
"""Greatest number of filled bundles kept; at the limit, all are dropped."""
_FIELDS: dict[Any, tuple[str, ...]] = {}
"""Names of the arrays of each bundle type."""


@cache
def bundle(**entries: Any) -> Any:
    """Return the Warp struct of arrays with these names, and with entries of these types."""
    words = (f"{name}_{wp.types.type_size_in_bytes(kind)}" for name, kind in entries.items())
    arrays = {name: wp.array(dtype=kind) for name, kind in entries.items()}
    made = wp.struct(type("_".join(("Bundle", *words)), (), {"__annotations__": arrays, "__module__": __name__}))
    _FIELDS[made] = tuple(arrays)
    return made


@cache
def bundles_of(kernel: wp.Kernel) -> dict[str, dict[str, str]]:
    """Return a kernel's bundle arguments, each with the names of its fields and of the arrays for them."""
    found = {a.label: _FIELDS[a.type] for a in kernel.adj.args if a.type.__hash__ and a.type in _FIELDS}
    endings = {label: f"_{label}" if label in ("dot", "bar") else "" for label in found}
    return {label: {name: name + endings[label] for name in fields} for label, fields in found.items()}


def unbundled(arguments: Iterable[Any]) -> Iterator[Any]:
    """Yield the arguments of a launch, with each bundle replaced by its arrays."""
    for argument in arguments:
        struct = getattr(argument, "_cls", None)
        if struct in _FIELDS:
            yield from (getattr(argument, name) for name in _FIELDS[struct])
        else:
            yield argument


class Bundles:
    """A cache of bundles filled with arrays, as filling one takes longer than a launch."""

    def __init__(self) -> None:
        self._filled: dict[tuple[Any, ...], Any] = {}

    def clear(self) -> None:
        """Release all bundles and their arrays."""
        self._filled.clear()

    def filled(self, struct: Any, arrays: Sequence[wp.array]) -> Any:
        """Return the bundle of a type with these arrays, in the order of its fields."""
        key = (struct, *map(id, arrays))  # a bundle holds its arrays, so that their ids stay theirs
        found = self._filled.get(key)
        if found is None:
            if len(self._filled) >= MOST_BUNDLES:
                self.clear()
            found = self._filled[key] = struct()
            for name, array in zip(_FIELDS[struct], arrays, strict=True):
                setattr(found, name, array)
        return found


Named = Mapping[str, Any]
"""Arguments of kernels by name, of which a launch takes those that its kernel has."""


def bound(kernel: wp.Kernel, groups: Sequence[Named], given: Named, bundles: Bundles) -> list[Any]:
    """Return a kernel's arguments in its order: from ``given``, all of which it must have, and from the first of the
    ``groups`` that has each. A bundle is filled with the arrays that it names.

    Kernels take many arrays of one type, and nothing else would notice a mistake: raises `TypeError` for an argument
    that is missing or that the kernel does not have.
    """
    names, arguments = _signature(kernel)
    for name in given:
        if name not in names:
            raise TypeError(f"kernel {kernel.key} has no argument {name!r}; it has {', '.join(names)}.")
    sources, found = (given, *groups), []
    for name, struct, arrays in arguments:
        if struct is None:
            found.append(_found(name, sources, kernel))
        else:
            found.append(bundles.filled(struct, [_found(array, sources, kernel) for array in arrays]))
    return found


def _found(name: str, sources: Sequence[Named], kernel: wp.Kernel) -> Any:
    for source in sources:
        if name in source:
            return source[name]
    names, known = _signature(kernel)[0], ", ".join(dict.fromkeys(known for source in sources for known in source))
    raise TypeError(
        f"argument {name!r} of kernel {kernel.key} is missing; it has {', '.join(names)}; known are {known}."
    )


@cache
def _signature(kernel: wp.Kernel) -> tuple[dict[str, None], tuple[tuple[str, Any, tuple[str, ...]], ...]]:
    """Return a kernel's argument names, with bundles as their arrays; and each argument with its bundle."""
    bundled = bundles_of(kernel)
    arguments = tuple(
        (a.label, a.type if a.label in bundled else None, tuple(bundled.get(a.label, {}).values()))
        for a in kernel.adj.args
    )
    return dict.fromkeys(name for label, _, arrays in arguments for name in (arrays or (label,))), arguments


MOST_PARTS = 32
"""Greatest number of ranges of particles into which a launch on a CPU is cut."""
LEAST_PART = 2000
"""Least number of particles in a range: below, starting it costs more than it saves."""
PARTS_A_CORE = 4
"""Greatest number of ranges for each core: a core busy elsewhere leaves some to others."""
LEAST_SHARED_PART = 10_000
"""Least number of particles in a range where each core has several."""

Watcher = Callable[[str, Any, Sequence[Any], Callable[[], None]], None]
"""A function called for every launch with its name, threads, arguments and the function that launches, which it must
call at least once."""
_watchers: list[Watcher] = []


@contextmanager
def watched(watcher: Watcher) -> Iterator[None]:
    """Pass every launch of this process in the block to a watcher, which times or counts it. Captured graphs are not
    taken apart: launches within are seen only during capture."""
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


@cache
def starts_at_first(kernel: wp.Kernel) -> bool:
    """Test if a kernel reads ``first``, the start of its range of particles, from its first argument."""
    return f"{kernel.adj.args[0].label}.first" in kernel.adj.source


def launch(
    kernel: wp.Kernel, threads: Any, device: Any, *groups: Named, block: int | None = None, **arguments: Any
) -> None:
    """Launch a kernel, off any tape, with arguments by name; ``threads``: their number, or a shape; ``block``: threads
    of a GPU that share memory, if it matters."""
    announce(kernel, device)
    inputs, sizes = bound(kernel, groups, arguments, Bundles()), {} if block is None else {"block_dim": block}
    work = partial(wp.launch, kernel, threads, inputs=inputs, device=device, record_tape=False, **sizes)
    _perform(kernel.key, threads, inputs, work)


def recorded(kernel: wp.Kernel, threads: int, device: Any, **arguments: Any) -> Callable[[], None]:
    """Return a function that launches a kernel as `launch` does, with fixed arguments, packed once."""
    announce(kernel, device)
    inputs = bound(kernel, (), arguments, Bundles())
    command = wp.launch(kernel, threads, inputs=inputs, device=device, record_tape=False, record_cmd=True)
    return partial(_perform, kernel.key, threads, inputs, command.launch)


def launch_together(name: str, threads: int, arguments: Sequence[Any], work: Callable[[], None]) -> None:
    """Run work that launches several kernels, repeatable only as a whole: watchers see one launch."""

    def unwatched() -> None:
        watchers = _watchers.copy()
        _watchers.clear()
        try:
            work()
        finally:
            _watchers.extend(watchers)

    _perform(name, threads, arguments, unwatched)


class KernelLauncher:
    """A launcher of kernels with one thread a particle on one device, with arguments by name (see `bound`).

    On a CPU Warp launches in one thread. So a launch of a kernel whose first argument is the neighbourhood ``s`` is cut
    into ranges of particles, several for each core if there are many. A core that has finished a range takes the next
    one. Such a kernel works on particle ``s.first + wp.tid()``. Sums are gathers, so the bits do not depend on the
    ranges or the cores.
    """

    def __init__(self, particles: int, device: Any, record_tape: bool):
        """Prepare launches; ``record_tape`` False keeps them off a tape that a user may have open."""
        self.particles, self.device, self._record_tape = particles, device, record_tape
        self._cores = min(usable_cores(), MOST_CORES) if device.is_cpu and not record_tape else 1
        each = min(PARTS_A_CORE, MOST_PARTS // self._cores, particles // (self._cores * LEAST_SHARED_PART))
        most = self._cores * max(each, 1) if self._cores > 1 else 1
        self.parts = max(min(most, particles // LEAST_PART), 1)
        """Number of ranges of particles into which a sum over neighbours is cut."""
        self._bounds = [particles * part // self.parts for part in range(self.parts + 1)]
        self._side = wp.Stream(device) if device.is_cuda and not record_tape else None
        self._side_is_busy = False
        self._compiled: set[Any] = set()
        self._bundles = Bundles()
        self._whole: Any = None
        self._parts: list[Any] = []

    @property
    def capturable(self) -> bool:
        """True if launches may be captured as a graph, which needs a single range."""
        return self.parts == 1

    def __call__(self, kernel: wp.Kernel, *groups: Named, threads: int | None = None, **arguments: Any) -> None:
        inputs = bound(kernel, groups, arguments, self._bundles)
        sums = hasattr(inputs[0], "neighbours")
        if sums and threads is not None:
            raise TypeError(f"kernel {kernel.key} sums over neighbours, and has one thread for each particle.")
        entries = threads or self.particles
        if sums and not starts_at_first(kernel):
            raise TypeError(
                f"kernel {kernel.key} takes the neighbourhood s, but does not look where its range of particles "
                "begins, and every range would write to the first: let it begin with i = s.first + wp.tid()."
            )
        if sums:
            check_lanes(kernel)
        if sums and not self.capturable and kernel in self._compiled:
            _perform(kernel.key, entries, inputs, partial(self._launch_parts, kernel, inputs))
            return
        announce(kernel, self.device)
        options = {"inputs": inputs, "device": self.device, "record_tape": self._record_tape}
        _perform(kernel.key, entries, inputs, partial(wp.launch, kernel, entries * lanes_of(kernel), **options))
        self._compiled.add(kernel)  # only now: an interrupted launch has compiled nothing

    def forget(self) -> None:
        """Release the arrays of earlier launches, which bundles hold."""
        self._bundles.clear()

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Launch the block in a second stream of a GPU: after earlier launches, and beside later ones until `join`. On
        a CPU nothing changes."""
        self._side_is_busy = self._side is not None
        with wp.ScopedStream(self._side):
            yield

    def join(self) -> None:
        """Make later launches wait for those of `aside`."""
        if self._side_is_busy:  # a stream that a capture has not seen must not be waited for within it
            wp.wait_stream(self._side)
            self._side_is_busy = False

    def _launch_parts(self, kernel: wp.Kernel, inputs: Sequence[Any]) -> None:
        if self._whole is not inputs[0]:
            self._whole, self._parts = inputs[0], [self._part(inputs[0], n) for n in range(self.parts)]

        def launch_part(part: int) -> None:
            threads, inputs_of_part = self._bounds[part + 1] - self._bounds[part], [self._parts[part], *inputs[1:]]
            wp.launch(kernel, threads, inputs=inputs_of_part, device=self.device, record_tape=False)

        in_parallel(launch_part, range(self.parts), min(self._cores, self.parts))

    def _part(self, neighbourhood: Any, number: int) -> Any:
        """Return a copy of the neighbourhood struct for one range of particles."""
        part = neighbourhood._cls()
        for name in neighbourhood._cls.vars:
            setattr(part, name, getattr(neighbourhood, name))
        part.first, part.part = self._bounds[number], number
        return part


class CapturedGraph:
    """Work repeated with fixed arrays, as a captured graph from the second call on, or from the first if it is warm.

    The first call loads modules and allocates memory, which is forbidden in a capture; work is warm if this is done. On
    a CPU a graph saves the packing of arguments: half of the time with a hundred particles.
    """

    def __init__(self, work: Callable[[], None], launch: KernelLauncher, is_warm: bool = False):
        self._work, self._launch = work, launch
        self._warm, self._graph = is_warm, None

    def __call__(self) -> None:
        if not self._warm or not self._launch.capturable:
            self._work()
            self._warm = True
            return
        if self._graph is None:
            with wp.ScopedCapture(device=self._launch.device) as capture:
                self._work()
            self._graph = capture.graph
        with WARP.lent() if self._launch.device.is_cpu else nullcontext():  # a GPU has one queue for all threads
            wp.capture_launch(self._graph)


BANDS = 8
"""Number of bands for each core, as one may take longer than another."""
LEAST, LEAST_SHARED_OFTEN = 1_000, 50_000
"""Least number of threads in a band, and in a launch that is cut if it is one of many short launches."""


class BandLauncher:
    """A launcher of kernels with a number of threads on one device, with arguments by name (see `launch`); on a CPU in
    bands. A kernel works on thread ``first + wp.tid()``."""

    def __init__(self, device: Any):
        self.device, self._compiled = device, set[Any]()

    def __call__(self, kernel: wp.Kernel, count: int, **arguments: Any) -> None:
        cores = min(usable_cores(), MOST_CORES) if self.device.is_cpu else 1
        bands = max(min(BANDS * cores, count // LEAST), 1) if cores > 1 else 1
        bounds = [count * band // bands for band in range(bands + 1)]

        def work(band: int) -> None:
            launch(kernel, bounds[band + 1] - bounds[band], self.device, first=bounds[band], **arguments)

        begin = 0
        if kernel not in self._compiled:
            work(0)
            self._compiled.add(kernel)
            begin = 1
        in_parallel(work, range(begin, bands), cores)

    def to_and_fro(
        self, kernel: wp.Kernel, rounds: int, values: wp.array, other: wp.array, **arguments: Any
    ) -> wp.array:
        """Launch a kernel ``rounds`` times, with a thread for each of the ``values``. It computes ``found`` from
        ``values``, and the next launch starts from ``found``. Launches write alternately to ``values`` and ``other``;
        the array of the last launch is returned."""
        count, both = len(values), ({"values": values, "found": other}, {"values": other, "found": values})
        if self.device.is_cpu and count > LEAST_SHARED_OFTEN:
            ways: list[Callable[[], None]] = [partial(self, kernel, count, **arguments, **one) for one in both]
        else:
            ways = [recorded(kernel, count, self.device, first=0, **arguments, **one) for one in both]
        for k in range(rounds):
            ways[k % 2]()
        return other if rounds % 2 else values


class HostCopy:
    """A reader of a small device array into pinned host memory, which is allocated once."""

    def __init__(self, array: wp.array):
        self._array = array
        self._copy: Any = array if array.device.is_cpu else None

    def read(self, rows: int | None = None) -> np.ndarray:
        """Return the array, or its first ``rows``, after the device's work is done; the next call overwrites it."""
        if rows == 0:
            return wp.empty((0, *self._array.shape[1:]), dtype=self._array.dtype, device="cpu").numpy()
        if self._copy is None:
            self._copy = wp.empty_like(self._array, device="cpu", pinned=True)
        if self._copy is not self._array:
            wp.copy(self._copy, self._array)
            wp.synchronize_stream(self._array.device)
        return self._copy.numpy()[:rows]
