"""Cores, threads, processes and memory: how many cores launches use, who may use Warp when, what a fork leaves of both,
and how much memory a computation takes and how much is free.

Warp keeps one state for a whole process: the graph that is being captured, the tape that is being recorded, the modules
that are loaded. Two threads in there at a time spoil each other's results, so that Cortado lets them in one by one.

Memory is estimated before it is allocated, for a sentence. Estimates count particles with their neighbour lists, wall
particles, tables and records of every step, the frames that a report reads back, and in a renderer nodes, pixels and
samples. The bytes of each were measured, and hold to a factor of about 1.5. Checkpoints are not counted, as a rollout
keeps no more of them than there is room for.
"""

import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ContextDecorator, contextmanager, suppress
from functools import cache, wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar
from weakref import WeakSet

import psutil

from cortado.calls import told
from cortado.errors import ComputationError, InputError, shown

CORES = "CORTADO_CORES"
"""Name of the environment variable that limits the number of cores, for processes that share a machine."""


def usable_cores() -> int:
    """Return the number of cores of this process, or of the machine where the system does not tell, at most
    CORTADO_CORES (an environment variable). Raises `InputError` where that is no number of cores."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get(CORES, "").strip()
    if not limit:
        return there
    if not limit.isdecimal() or int(limit) < 1:
        raise InputError(f"The environment variable {CORES} is {shown(limit)}, but must be a number of cores.")
    return min(int(limit), there)


MOST_CORES = 16
"""Greatest number of cores that a launch on a CPU uses."""


@cache
def helpers() -> ThreadPoolExecutor:
    """Return the pool of threads that share the work of the launching one."""
    return ThreadPoolExecutor(MOST_CORES - 1, thread_name_prefix="cortado")


def in_parallel(work: Callable[[Any], object], items: Iterable[Any], cores: int) -> None:
    """Call ``work`` for each item on several cores: this thread and its helpers take one item after the other. After a
    failure, which is raised, and after an interruption no further item is begun. Returns once all have ended, as
    nothing may go on behind the back of what comes next."""
    waiting = iter(items)

    def take() -> None:
        for item in waiting:
            work(item)

    called = [helpers().submit(take) for _ in range(cores - 1)]
    try:
        take()
    finally:
        for _ in waiting:
            pass
        begun = [helper for helper in called if not helper.cancel()]
        wait(begun)
    for helper in begun:
        helper.result()


class WarpLock(ContextDecorator, threading.local):
    """The lock that a thread holds while it uses Warp; a context or a decorator of functions. A thread may enter it
    repeatedly."""

    _lock = threading.RLock()
    _entries = 0
    """Number of times that this thread has entered the lock."""

    def __enter__(self) -> None:
        if not self._entries:
            self._lock.acquire()
        self._entries += 1

    def __exit__(self, *error: object) -> None:
        self._entries -= 1
        if self._entries <= 0:
            self._let_go()

    @contextmanager
    def lent(self) -> Iterator[None]:
        """Release the lock in the block, around work that uses none of Warp's state, or waits for another thread."""
        entries = self._entries
        if entries:
            self._let_go()
        try:
            yield
        finally:
            if entries:
                self._lock.acquire()
                self._entries = entries

    def _let_go(self) -> None:
        self._entries = 0
        with suppress(RuntimeError):  # until it is not held: an interruption may have come right after it was taken
            while True:
                self._lock.release()


WARP = WarpLock()
"""Lock of this process on Warp."""


class Turn:
    """The lock that a thread holds while it uses a simulation. Other threads wait for it; those with other simulations
    may use Warp where a captured graph is replayed.

    ``with simulation.turn:`` makes one piece of several calls.
    """

    def __init__(self, device: Any):
        self._lock, self._device = threading.RLock(), device
        self._lost = False
        _TURNS.add(self)

    def __enter__(self) -> None:
        if self._lost:
            raise ComputationError(
                f"a simulation on {self._device} cannot go on in a process that was forked from the one that made it: "
                'start processes by "spawn" or "forkserver", as in multiprocessing.get_context("spawn").'
            )
        if not self._lock.acquire(blocking=False):
            with WARP.lent():  # whoever has the simulation may wait for Warp
                self._lock.acquire()
        try:
            WARP.__enter__()
        except BaseException:
            self._lock.release()
            raise

    def __exit__(self, *error: object) -> None:
        WARP.__exit__()
        self._lock.release()

    def forked(self) -> None:
        """Replace the lock in the child of a fork, where only the forking thread still exists."""
        if self._lock.acquire(blocking=False):
            self._lock.release()
        else:
            self._lock = threading.RLock()
        self._lost = self._lost or not self._device.is_cpu


_TURNS: WeakSet[Turn] = WeakSet()


class _HasTurn(Protocol):
    @property
    def turn(self) -> Turn: ...


P = ParamSpec("P")
R = TypeVar("R")
Self = TypeVar("Self", bound=_HasTurn)


def in_turn(method: Callable[Concatenate[Self, P], R]) -> Callable[Concatenate[Self, P], R]:
    """Make a method hold the lock ``turn`` of its object while it runs; the arguments of a call are checked before."""

    @wraps(method)
    def held(self: Self, *args: P.args, **options: P.kwargs) -> R:
        with self.turn:
            return method(self, *args, **options)

    return told(held)


def _begin_in_child() -> None:
    helpers.cache_clear()  # its threads are not there
    for turn in list(_TURNS):
        turn.forked()
    WARP.__exit__()


if hasattr(os, "register_at_fork"):
    # A fork waits until no thread is within Warp: the child would find its state half changed for ever.
    os.register_at_fork(before=WARP.__enter__, after_in_parent=WARP.__exit__, after_in_child=_begin_in_child)


_PARTICLE, _WALL, _STEP, _FRAME, _PIXEL = 56.0, 110.0, 50.0, 150.0, 110.0
"""[bytes]"""
_WEIGHING = 1600.0
"""Bytes of a wall particle while its weight is computed."""
_REALS_OF_PARTICLE, _REALS_OF_WALL, _REALS_OF_STEP, _REALS_OF_PIXEL = 90.0, 12.0, 8.0, 12.0
_REALS_BACKWARD, _REALS_OF_ITERATION = 40.0, 8.0
"""[numbers]"""
_CGROUP = Path("/sys/fs/cgroup")
_LIMITS = (("memory.max", "memory.current"), ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"))


def sampling_parts(particles: float, walls: float) -> dict[str, float]:
    """Return the memory [bytes] for cutting a scene into particles, by a phrase for each part."""
    of_walls = (_WALL + _WEIGHING) * walls
    return {f"{particles:.3g} particles of fluid": 100.0 * particles, f"{walls:.3g} wall particles": of_walls}


def simulation_parts(particles: int, walls: int, neighbours: int, real: int) -> dict[str, float]:
    """Return the memory [bytes] of a simulation, given the length of neighbour lists and the bytes of a number."""
    return {
        f"{particles:.3g} particles of fluid": particles * (_PARTICLE + 4.0 * neighbours + _REALS_OF_PARTICLE * real),
        f"{walls:.3g} wall particles": walls * (_WALL + _REALS_OF_WALL * real),
    }


def step_parts(steps: int, real: int) -> dict[str, float]:
    """Return the memory [bytes] of the tables and records of a run's steps."""
    return {f"what is kept of {steps:.3g} steps": steps * (_STEP + _REALS_OF_STEP * real)}


def frame_parts(frames: int, numbers: int, real: int) -> dict[str, float]:
    """Return the memory [bytes] of ``frames`` frames with ``numbers`` numbers each."""
    return {f"{frames:.3g} frames": frames * (_FRAME + float(numbers) * real)}


def gradient_parts(particles: int, iterations: int, real: int) -> dict[str, float]:
    """Return the memory [bytes] of a gradient, given the pressure iterations of a step."""
    return {
        f"the gradient of {particles:.3g} particles": particles
        * real
        * (_REALS_BACKWARD + _REALS_OF_ITERATION * iterations)
    }


def field_parts(nodes: float, real: int) -> dict[str, float]:
    """Return the memory [bytes] of a colour field, or of its adjoint."""
    return {f"{nodes:.3g} nodes of the field of colours": 4.0 * nodes * real}


def picture_parts(pixels: int, real: int) -> dict[str, float]:
    """Return the memory [bytes] of a picture, and of showing it in a report."""
    return {f"{pixels:.3g} pixels": pixels * (_PIXEL + _REALS_OF_PIXEL * real)}


def sample_parts(samples: int, pixels: int, real: int) -> dict[str, float]:
    """Return the memory [bytes] of the adjoints of all samples along the rays of all pixels."""
    return {f"{samples} samples behind each of {pixels:.3g} pixels": 4.0 * samples * pixels * real}


def require(parts: Mapping[str, float], advice: str, device: Any = None) -> None:
    """Raise `InputError` if memory [bytes], by its purpose, exceeds the free memory; ``device`` is Warp's."""
    lack = shortage(parts, device)
    if lack:
        raise InputError(f"This needs {lack}; {advice}.")


def shortage(parts: Mapping[str, float], device: Any = None) -> str:
    """Return the needed and the free memory in words; empty if it suffices."""
    needed, free = sum(parts.values()), available(device)
    if needed <= free:
        return ""
    most = max(parts, key=lambda name: parts[name])
    where = "" if device is None or device.is_cpu else f" on {device}"
    return f"about {_gb(needed)} of memory, most of it for {most}, but only {_gb(free)} are free{where}"


def within(budget: float, device: Any = None) -> int:
    """Return a memory budget [bytes] for data that can be recomputed: at most half of the free memory."""
    return int(min(budget, 0.5 * available(device)))


def available(device: Any = None) -> float:
    """Return the free memory [bytes] of a Warp device, or of this process on a CPU; infinite where unknown."""
    if device is not None and not device.is_cpu:
        return float(device.free_memory)
    return max(min(float(psutil.virtual_memory().available), _of_container(), _of_process()), 0.0)


def _of_container() -> float:
    """Return the control group's memory limit less its use [bytes], with cached files as free; infinite without one."""
    for limit, used in _LIMITS:
        with suppress(OSError, ValueError):
            stat = (_CGROUP / used).with_name("memory.stat").read_text().split()
            cached = int(stat[stat.index("inactive_file") + 1])
            return float((_CGROUP / limit).read_text()) - float((_CGROUP / used).read_text()) + cached
    return float("inf")


def _of_process() -> float:
    """Return the limit of the address space (``ulimit -v``) less its use [bytes]; infinite without one."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            return float(limit - psutil.Process().memory_info().vms)
    return float("inf")


def _gb(size: float) -> str:
    return f"{size / 1e9:.3g} GB"
