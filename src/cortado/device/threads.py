"""Threads and processes: who may use Warp when, the threads that help with a launch, and what a fork leaves of both.

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
from cortado.errors import ComputationError

MOST_CORES = 16
"""Cores at most that a launch on a CPU uses."""


@cache
def helpers() -> ThreadPoolExecutor:
    """The threads that help the one that launches."""
    return ThreadPoolExecutor(MOST_CORES - 1, thread_name_prefix="cortado")


def in_parallel(work: Callable[[Any], object], items: Iterable[Any], cores: int) -> None:
    """Do work for each item, on so many cores: this thread, and those that help it, take one item after the other.

    Returns once all of them have ended, also after an interruption: nothing may go on behind the back of what comes
    next. After that, and after a failure, which is raised, nobody takes another item.
    """
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


class _Entries(threading.local):
    count = 0


class WarpTurn(ContextDecorator):
    """What a thread holds while it uses Warp; a context or a decorator of functions. It may be entered repeatedly."""

    def __init__(self) -> None:
        self._lock, self._entries = threading.RLock(), _Entries()

    def __enter__(self) -> None:
        if not self._entries.count:
            self._lock.acquire()
        self._entries.count += 1

    def __exit__(self, *error: object) -> None:
        self._entries.count -= 1
        if self._entries.count <= 0:
            self._let_go()

    @contextmanager
    def lent(self) -> Iterator[None]:
        """Let other threads in meanwhile: around what uses none of Warp's state, or waits for another thread."""
        count = self._entries.count
        if count:
            self._let_go()
        try:
            yield
        finally:
            if count:
                self._lock.acquire()
                self._entries.count = count

    def _let_go(self) -> None:
        self._entries.count = 0
        with suppress(RuntimeError):  # until it is not held: an interruption may have come right after it was taken
            while True:
                self._lock.release()


WARP = WarpTurn()
"""The one of this process."""


class Turn:
    """What a thread holds while it uses a simulation: others wait for its end, but those with other simulations get in
    where a captured graph is replayed.

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
        """In the child of a fork: only the thread that forked is still there."""
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
    """A method that holds the ``turn`` of its object from beginning to end, once its call fits it."""

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
