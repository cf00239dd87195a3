"""Usable cores, locks on Warp and on simulations, calls in worker processes, and estimates of memory.

Only one thread at a time may use Warp, because Warp has one state per process.

Memory is estimated before it is allocated, so that a lack of memory gives a clear error. An estimate may be wrong by a
factor of about 1.5. Checkpoints are left out, because a rollout adapts their number to the free memory.
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
from typing import Any, TypeVar, cast
from weakref import WeakSet

import psutil

from cortado.calls import told
from cortado.errors import ComputationError, CortadoError, InputError, shown, warn
from cortado.version import __version__

CORES = "CORTADO_CORES"


def usable_cores() -> int:
    """The environment variable CORTADO_CORES limits the number of cores."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get(CORES, "").strip()
    if not limit:
        return there
    if not limit.isdecimal() or int(limit) < 1:
        raise InputError(f"The environment variable {CORES} is {shown(limit)}, but must be a number of cores.")
    return min(int(limit), there)


MOST_CORES = 16


@cache
def helpers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(MOST_CORES - 1, thread_name_prefix="cortado")


def in_parallel(work: Callable[[Any], object], items: Iterable[Any], cores: int) -> None:
    """After an error or an interruption the remaining items are skipped."""
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
    """A thread holds this reentrant lock while it uses Warp."""

    _lock = threading.RLock()
    _entries = 0

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
        """Release the lock in the block. Code in the block must not use Warp."""
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


class Turn:
    """While a captured graph is replayed, other threads may use Warp. Several calls inside ``with simulation.turn:``
    are not interrupted by other threads."""

    def __init__(self, device: Any):
        self._lock, self._device = threading.RLock(), device
        self._lost = False
        _TURNS.add(self)

    def __enter__(self) -> None:
        if self._lost:
            raise ComputationError(
                f"a simulation on {self._device} cannot continue in a process forked from the simulation's process: "
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
        if self._lock.acquire(blocking=False):
            self._lock.release()
        else:
            self._lock = threading.RLock()
        self._lost = self._lost or not self._device.is_cpu


_TURNS: WeakSet[Turn] = WeakSet()


Method = TypeVar("Method", bound=Callable[..., Any])


def in_turn(method: Method) -> Method:
    @wraps(method)
    def held(self: Any, *args: Any, **options: Any) -> Any:
        with self.turn:
            return method(self, *args, **options)

    return cast(Method, told(held))


def _begin_in_child() -> None:
    helpers.cache_clear()  # its threads are not there
    for turn in list(_TURNS):
        turn.forked()
    WARP.__exit__()


if hasattr(os, "register_at_fork"):
    # A fork waits until no thread is within Warp: the child would find its state half changed for ever.
    os.register_at_fork(before=WARP.__enter__, after_in_parent=WARP.__exit__, after_in_child=_begin_in_child)


KEPT = 2
_functions: OrderedDict[str, Callable[[Any], Any]] = OrderedDict()
_one_at_a_time = threading.RLock()


@dataclass(frozen=True)
class Payload:
    digest: str
    versions: str
    content: bytes | None
    """Pickled function, or None if the worker should have the function in its cache."""

    @classmethod
    def of(cls, function: Callable[[Any], Any]) -> "Payload":
        content = pickled(function, "The function")
        return cls(sha256(content).hexdigest(), versions(), content)

    @property
    def mention(self) -> "Payload":
        return replace(self, content=None)


@dataclass(frozen=True)
class Lacking:
    """The answer of a worker that does not have the requested function in the worker's cache."""


@dataclass(frozen=True)
class Answer:
    content: bytes = b""
    error: BaseException | None = None
    traceback: str = ""
    warnings: tuple[tuple[str, type[Warning]], ...] = ()

    def result(self) -> Any:
        for text, category in self.warnings:
            warn(text, category)
        if self.error is None:
            return pickle.loads(self.content)
        if self.traceback:
            self.error.add_note(f"In a worker process:\n{self.traceback}")
        raise self.error


def pickled(value: Any, what: str) -> bytes:
    """The pickled result contains code of the main module. The message of an `InputError` begins with ``what``."""
    import cloudpickle

    try:
        return cloudpickle.dumps(value)
    except Exception as error:  # pickling may raise anything
        raise InputError(f"{what} cannot be sent to another process: {in_words(error)}.") from error


@cache
def versions() -> str:
    return f"Cortado {__version__}, Warp {metadata.version('warp-lang')} and NumPy {metadata.version('numpy')}"


def call(payload: Payload, item: bytes) -> Answer | Lacking:
    """Run the payload's function in a worker process. The answer contains any exception of the payload's function."""
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
    if payload.versions != versions():
        raise InputError(
            f"A worker has {versions()}, but must have {payload.versions}, as the calling process has, for results "
            "with equal bits."
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
    try:
        again = pickle.loads(pickle.dumps(error))
        if type(again) is type(error) and str(again) == str(error):
            return error
    except Exception:  # pickling may raise anything
        pass
    return RuntimeError(in_words(error))


def in_words(error: BaseException) -> str:
    text = " ".join(str(error).split()).rstrip(".")
    return text if isinstance(error, CortadoError) else ": ".join(filter(None, [type(error).__name__, text]))


_PARTICLE, _WALL, _STEP, _FRAME, _PIXEL = 56.0, 110.0, 50.0, 150.0, 110.0
"""Memory per particle, wall particle, step, frame and pixel [bytes]."""
_WEIGHING = 1600.0
"""Memory per wall particle during the computation of weights [bytes]."""
_REALS_OF_PARTICLE, _REALS_OF_WALL, _REALS_OF_STEP, _REALS_OF_PIXEL = 90.0, 12.0, 8.0, 12.0
_REALS_BACKWARD, _REALS_OF_ITERATION = 40.0, 8.0
"""Stored numbers per particle: in the backward pass, and in each iteration of the solver."""
_CGROUP = Path("/sys/fs/cgroup")
_LIMITS = (("memory.max", "memory.current"), ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"))
"""Files with the memory limit and the used memory of a Linux control group [bytes], for versions 2 and 1."""


def sampling_parts(particles: float, walls: float) -> dict[str, float]:
    of_walls = (_WALL + _WEIGHING) * walls
    return {f"{particles:.3g} particles of fluid": 100.0 * particles, f"{walls:.3g} wall particles": of_walls}


def simulation_parts(particles: int, walls: int, neighbours: int, real: int) -> dict[str, float]:
    return {
        f"{particles:.3g} particles of fluid": particles * (_PARTICLE + 4.0 * neighbours + _REALS_OF_PARTICLE * real),
        f"{walls:.3g} wall particles": walls * (_WALL + _REALS_OF_WALL * real),
    }


def step_parts(steps: int, real: int) -> dict[str, float]:
    return {f"what is kept of {steps:.3g} steps": steps * (_STEP + _REALS_OF_STEP * real)}


def frame_parts(frames: int, numbers: int, real: int) -> dict[str, float]:
    return {f"{frames:.3g} frames": frames * (_FRAME + float(numbers) * real)}


def gradient_parts(particles: int, iterations: int, real: int) -> dict[str, float]:
    of_particle = real * (_REALS_BACKWARD + _REALS_OF_ITERATION * iterations)
    return {f"the gradient of {particles:.3g} particles": particles * of_particle}


def field_parts(nodes: float, real: int) -> dict[str, float]:
    return {f"{nodes:.3g} nodes of the field of colours": 4.0 * nodes * real}


def picture_parts(pixels: int, real: int) -> dict[str, float]:
    return {f"{pixels:.3g} pixels": pixels * (_PIXEL + _REALS_OF_PIXEL * real)}


def sample_parts(samples: int, pixels: int, real: int) -> dict[str, float]:
    return {f"{samples} samples behind each of {pixels:.3g} pixels": 4.0 * samples * pixels * real}


def require(parts: Mapping[str, float], advice: str, device: Any = None) -> None:
    """``parts`` is the required memory by purpose [bytes]."""
    lack = shortage(parts, device)
    if lack:
        raise InputError(f"This needs {lack}; {advice}.")


def shortage(parts: Mapping[str, float], device: Any = None) -> str:
    """Return a sentence on the required and the free memory, or an empty text if the free memory suffices."""
    needed, free = sum(parts.values()), available(device)
    if needed <= free:
        return ""
    most = max(parts, key=lambda name: parts[name])
    where = "" if device is None or device.is_cpu else f" on {device}"
    return f"about {_gb(needed)} of memory, most of it for {most}, but only {_gb(free)} are free{where}"


def within(budget: float, device: Any = None) -> int:
    return int(min(budget, 0.5 * available(device)))


def available(device: Any = None) -> float:
    """Return the free memory of a Warp device or of this process [bytes]. Unknown free memory counts as infinite."""
    if device is not None and not device.is_cpu:
        return float(device.free_memory)
    found = [float(psutil.virtual_memory().available)]
    for limit, used in _LIMITS:
        with suppress(OSError, ValueError):
            stat = (_CGROUP / used).with_name("memory.stat").read_text().split()
            cached = int(stat[stat.index("inactive_file") + 1])  # files, which count as free
            found.append(float((_CGROUP / limit).read_text()) - float((_CGROUP / used).read_text()) + cached)
            break
    with suppress(ImportError, OSError, ValueError):
        import resource

        most = resource.getrlimit(resource.RLIMIT_AS)[0]  # of addresses, under ulimit -v
        if most != resource.RLIM_INFINITY:
            found.append(float(most - psutil.Process().memory_info().vms))
    return max(min(found), 0.0)


def _gb(size: float) -> str:
    return f"{size / 1e9:.3g} GB"
