"""Cores, threads and processes: how many cores launches use, who may use Warp when, and what a fork leaves of both.

Warp keeps one state for a whole process: the graph that is being captured, the tape that is being recorded, the modules
that are loaded. Two threads in there at a time spoil each other's results, so that Cortado lets them in one by one.
"""

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ContextDecorator, contextmanager, suppress
from functools import cache, wraps
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar
from weakref import WeakSet

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
