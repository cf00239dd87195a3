"""Launches of kernels with arguments by name, and sums over particles in a fixed order."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import cache, partial
from typing import Any

import warp as wp

from cortado.device.binding import Named, bound
from cortado.device.bundles import Bundles
from cortado.device.compiling import announce
from cortado.device.cores import usable_cores
from cortado.device.lanes import check_lanes, lanes_of
from cortado.device.precision import Precision
from cortado.device.reduction import ReductionKernel, add_kernel, sum_and_maximum_kernel, sum_kernel
from cortado.device.threads import MOST_CORES, WARP, in_parallel

MOST_PARTS = 32
"""Ranges of particles at most that a launch on a CPU is cut into."""
LEAST_PART = 2000
"""Particles at least in a range: below, starting it costs more than it saves."""
PARTS_A_CORE = 4
"""Ranges for each core at most: one that is busy elsewhere leaves some of its own to the others."""
LEAST_SHARED_PART = 10_000
"""Particles at least in a range where there is more than one for each core."""

Watcher = Callable[[str, Any, Sequence[Any], Callable[[], None]], None]
"""Is given every launch: the name of what is launched, its threads, its arguments, and what launches it, which it must
call at least once."""
_watchers: list[Watcher] = []


@contextmanager
def watched(watcher: Watcher) -> Iterator[None]:
    """Hand every launch of this process to a watcher, which times it or counts it. Captured graphs are not taken apart,
    and launches within them are seen only while they are captured."""
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
    """Whether a kernel whose first argument is the neighbourhood reads of it where its range of particles begins."""
    return f"{kernel.adj.args[0].label}.first" in kernel.adj.source


def launch(
    kernel: wp.Kernel, threads: Any, device: Any, *groups: Named, block: int | None = None, **arguments: Any
) -> None:
    """Launch a kernel, off any tape, with arguments by name; ``threads``: their number, or a shape; ``block``: how many
    threads of a GPU share memory, if it matters."""
    announce(kernel, device)
    inputs, sizes = bound(kernel, groups, arguments, Bundles()), {} if block is None else {"block_dim": block}
    work = partial(wp.launch, kernel, threads, inputs=inputs, device=device, record_tape=False, **sizes)
    _perform(kernel.key, threads, inputs, work)


def recorded(kernel: wp.Kernel, threads: int, device: Any, **arguments: Any) -> Callable[[], None]:
    """What launches a kernel as `launch` does, again and again with the same arguments, which are packed once."""
    announce(kernel, device)
    inputs = bound(kernel, (), arguments, Bundles())
    command = wp.launch(kernel, threads, inputs=inputs, device=device, record_tape=False, record_cmd=True)
    return partial(_perform, kernel.key, threads, inputs, command.launch)


def launch_together(name: str, threads: int, arguments: Sequence[Any], work: Callable[[], None]) -> None:
    """Do work that launches several kernels, none of which may be repeated without the others: watchers see one
    launch."""

    def unwatched() -> None:
        watchers = _watchers.copy()
        _watchers.clear()
        try:
            work()
        finally:
            _watchers.extend(watchers)

    _perform(name, threads, arguments, unwatched)


class KernelLauncher:
    """Launches kernels with one thread a particle on one device, with arguments by name (see `bound`).

    On a CPU Warp launches in one thread. A kernel whose first argument is the neighbourhood ``s`` is cut into ranges of
    particles there, several for each core where there are many, and a core that has done one takes the next: such a
    kernel works on particle ``s.first + wp.tid()``, and not on a number of threads of its own.
    The sums are gathers, so that the bits do not depend on the cut, or on who took what.
    """

    def __init__(self, particles: int, device: Any, record_tape: bool):
        """``record_tape`` False keeps launches off a tape that a user may have open."""
        self.particles, self.device, self._record_tape = particles, device, record_tape
        self._cores = min(usable_cores(), MOST_CORES) if device.is_cpu and not record_tape else 1
        each = min(PARTS_A_CORE, MOST_PARTS // self._cores, particles // (self._cores * LEAST_SHARED_PART))
        most = self._cores * max(each, 1) if self._cores > 1 else 1
        self.parts = max(min(most, particles // LEAST_PART), 1)
        """Ranges of particles that a sum over neighbours is cut into."""
        self._bounds = [particles * part // self.parts for part in range(self.parts + 1)]
        self._side = wp.Stream(device) if device.is_cuda and not record_tape else None
        self._went_aside = False
        self._compiled: set[Any] = set()
        self._bundles = Bundles()
        self._whole: Any = None
        self._parts: list[Any] = []

    @property
    def capturable(self) -> bool:
        """Whether launches may be captured as a graph: those of one thread."""
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
        """Let go of the arrays of earlier launches, which bundles hold."""
        self._bundles.clear()

    @contextmanager
    def aside(self) -> Iterator[None]:
        """On a GPU, what is launched within waits for what was launched before, but not for what comes after it, nor
        that for this until `join`: small kernels that do not need one another run at the same time."""
        if self._side is None:
            yield
            return
        self._went_aside = True
        with wp.ScopedStream(self._side):
            yield

    def join(self) -> None:
        """Let what comes wait for all that went `aside`."""
        if self._went_aside:  # a stream that a capture has not seen must not be waited for within it
            wp.wait_stream(self._side)
            self._went_aside = False

    def _launch_parts(self, kernel: wp.Kernel, inputs: Sequence[Any]) -> None:
        if self._whole is not inputs[0]:
            self._whole, self._parts = inputs[0], [self._part(inputs[0], n) for n in range(self.parts)]

        def launch_part(part: int) -> None:
            threads, inputs_of_part = self._bounds[part + 1] - self._bounds[part], [self._parts[part], *inputs[1:]]
            wp.launch(kernel, threads, inputs=inputs_of_part, device=self.device, record_tape=False)

        in_parallel(launch_part, range(self.parts), min(self._cores, self.parts))

    def _part(self, neighbourhood: Any, number: int) -> Any:
        """The neighbourhood as one range sees them."""
        part = neighbourhood._cls()
        for name in neighbourhood._cls.vars:
            setattr(part, name, getattr(neighbourhood, name))
        part.first, part.part = self._bounds[number], number
        return part


class CapturedGraph:
    """Work that is done over and over with the same arrays: a captured graph from the second time on.

    The first time loads modules and allocates what a capture must not. On a CPU a graph saves the packing of arguments:
    half of the time with a hundred particles.
    """

    def __init__(self, work: Callable[[], None], launch: KernelLauncher):
        self._work, self._launch = work, launch
        self._warm, self._graph = False, None

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


class TreeReduction:
    """Adds one value of each particle on the device, scene by scene, in the same order every time."""

    def __init__(self, level: ReductionKernel, dtype: Any, particles: int, device: Any, members: int = 1):
        """``particles`` of each of ``members`` scenes."""
        self._level, self._device, self._particles = level, device, particles
        self._partials: list[tuple[int, wp.array]] = []
        size = particles
        while size > 1 or not self._partials:
            size = -(-size // level.most)
            self._partials.append((size, wp.zeros(members * size, dtype=dtype, device=device)))

    def __call__(self, values: wp.array) -> wp.array:
        """The sums as an array (members,), which the next call overwrites."""
        count, level, device = self._particles, self._level, self._device
        for size, sums in self._partials:
            arguments = {"count": count, "stride": size, "values": values, "partial": sums}
            launch(level.kernel, len(sums) * level.threads, device, block=level.threads, **arguments)
            count, values = size, sums
        return values


def sum_of(dtype: Any, particles: int, device: Any, members: int = 1) -> TreeReduction:
    """Sums of (members n,) numbers, vectors or matrices of a Warp type."""
    return TreeReduction(sum_kernel(dtype, device.is_cpu), dtype, particles, device, members)


def sum_and_maximum(particles: int, precision: Precision, device: Any, members: int = 1) -> TreeReduction:
    """Sums of first and maxima of second components of pairs (members n,)."""
    level = sum_and_maximum_kernel(precision, device.is_cpu)
    return TreeReduction(level, precision.pair, particles, device, members)


def add(values: wp.array, total: wp.array) -> None:
    """total += values, element by element."""
    launch(add_kernel(values.dtype), len(values), values.device, value=values, total=total)
