"""Cores, threads, processes and memory: the number of cores of launches, the locks on Warp and on simulations (also
after a fork), calls in worker processes, and the memory that is needed and free.

Warp keeps one state for a whole process: the graph that is being captured, the tape that is being recorded, the modules
that are loaded. Two threads in Warp at a time would spoil each other's results, so Cortado lets in only one at a time.

A worker process caches the last functions that it received, so that a problem is built once in each process and not for
each evaluation.

Memory is estimated before it is allocated, for a sentence. Estimates count particles with their neighbour lists, wall
particles, tables and records of every step, the frames that a report reads back, and in a renderer nodes, pixels and
samples. The bytes of each were measured, and hold to a factor of about 1.5. Checkpoints are not counted, as a rollout
keeps no more of them than there is room for.
"""

import os
import pickle
import threading
import traceback
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ContextDecorator, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache, wraps
from hashlib import sha256
from importlib import metadata
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar
from weakref import WeakSet

import psutil

from cortado.calls import told
from cortado.errors import ComputationError, CortadoError, InputError, shown, warn
from cortado.version import __version__

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
    """Call ``work`` for each item on several cores: this thread and its helpers take item after item. After a failure,
    which is raised, and after an interruption no further item is started. Returns once all calls have ended, so that no
    work continues in the background."""
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


KEPT = 2
"""Number of functions that a worker process keeps, the last ones used. Each may hold a problem with all its memory."""
_functions: OrderedDict[str, Callable[[Any], Any]] = OrderedDict()
_one_at_a_time = threading.RLock()


@dataclass(frozen=True)
class Payload:
    """A function on its way to a worker process."""

    digest: str
    """A checksum of the pickled function."""
    versions: str
    """The `versions` of the process that pickled the function."""
    content: bytes | None
    """The pickled function; None where a worker should have it."""

    @classmethod
    def of(cls, function: Callable[[Any], Any]) -> "Payload":
        """Pickle a function into a payload; raises `InputError` where that is impossible."""
        content = pickled(function, "The function")
        return cls(sha256(content).hexdigest(), versions(), content)

    @property
    def mention(self) -> "Payload":
        """Payload without its content."""
        return replace(self, content=None)


@dataclass(frozen=True)
class Lacking:
    """The answer of a worker that does not have the called function yet and was not sent it."""


@dataclass(frozen=True)
class Answer:
    """The result of a call in a worker process, or its error."""

    content: bytes = b""
    """The result, pickled in the worker, so that a result that cannot be pickled is an error of the call."""
    error: BaseException | None = None
    traceback: str = ""
    """The traceback of an error that is none of Cortado's own."""
    warnings: tuple[tuple[str, type[Warning]], ...] = ()
    """(text, category) of each warning."""

    def result(self) -> Any:
        """Return the function's result, with its warnings given here; raises its error."""
        for text, category in self.warnings:
            warn(text, category)
        if self.error is None:
            return pickle.loads(self.content)
        if self.traceback:
            self.error.add_note(f"In a worker process:\n{self.traceback}")
        raise self.error


def pickled(value: Any, what: str) -> bytes:
    """Pickle a value with the code of classes and functions of the main module; raises `InputError` where that is
    impossible, in a sentence that begins with ``what``."""
    import cloudpickle

    try:
        return cloudpickle.dumps(value)
    except Exception as error:  # pickling may raise anything
        raise InputError(f"{what} cannot be sent to another process: {in_words(error)}.") from error


@cache
def versions() -> str:
    """Return the versions that determine the bits of a result, in words."""
    return f"Cortado {__version__}, Warp {metadata.version('warp-lang')} and NumPy {metadata.version('numpy')}"


def call(payload: Payload, item: bytes) -> Answer | Lacking:
    """Call the payload's function for an item, in a worker process, one call at a time. Its exceptions become part of
    the answer, to be raised again by the caller, also one that would end the process."""
    with _one_at_a_time, warnings.catch_warnings(record=True) as caught:
        if payload.content is None and payload.digest not in _functions:
            return Lacking()
        warnings.simplefilter("always")
        try:
            answer = Answer(pickled(_function(payload)(_unpickled(item)), "The result"))
        except Exception as error:
            place = "" if isinstance(error, CortadoError) else traceback.format_exc()
            answer = Answer(error=_sendable(error), traceback=place)
        except BaseException as error:  # sys.exit, or KeyboardInterrupt
            how = f"An item ended its process, by {in_words(error)}; what is computed may not do so."
            answer = Answer(error=ComputationError(how))
    said = tuple((str(warning.message), warning.category) for warning in caught)
    return replace(answer, warnings=said)


def _function(payload: Payload) -> Callable[[Any], Any]:
    """Return the function of a payload, unpickled unless it is kept."""
    if payload.versions != versions():
        raise InputError(
            f"A worker has {versions()}, but must have {payload.versions}, as the process that asks it has: else bits "
            "would differ."
        )
    if payload.digest not in _functions:
        assert payload.content is not None
        while len(_functions) >= KEPT:
            _functions.popitem(last=False)
        _functions[payload.digest] = _unpickled(payload.content)
    _functions.move_to_end(payload.digest)
    return _functions[payload.digest]


def _unpickled(content: bytes) -> Any:
    try:
        return pickle.loads(content)
    except CortadoError:
        raise
    except Exception as error:  # unpickling may raise anything
        raise InputError(
            f"A worker cannot make what it was sent: {in_words(error)}; classes and functions that are sent must be in "
            "a module that every worker can import."
        ) from error


def _sendable(error: Exception) -> BaseException:
    """Return an error, or one with equal words if it cannot be pickled."""
    try:
        again = pickle.loads(pickle.dumps(error))
        if type(again) is type(error) and str(again) == str(error):
            return error
    except Exception:  # pickling may raise anything
        pass
    return RuntimeError(in_words(error))


def in_words(error: BaseException) -> str:
    """Return an error in words, on one line, without the full stop."""
    text = " ".join(str(error).split()).rstrip(".")
    return text if isinstance(error, CortadoError) else ": ".join(filter(None, [type(error).__name__, text]))


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
    of_particle = real * (_REALS_BACKWARD + _REALS_OF_ITERATION * iterations)
    return {f"the gradient of {particles:.3g} particles": particles * of_particle}


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
