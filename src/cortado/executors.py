"""Executors compute independent items, such as the members of an ensemble.

`InProcess` is the default and computes one item after the other. `Distributed` uses the workers of a scheduler of
Dask's distributed, on any number of machines. `local_workers` starts workers on this machine, such as one for each GPU.
"""

import asyncio
import logging
import sys
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self, TypeVar
from uuid import uuid4

from cortado.arrays import require_arguments, require_function, require_whole
from cortado.calls import counted, face
from cortado.device.modules import VISIBLE, visible_gpus
from cortado.device.threads import CORES, Answer, Lacking, Payload, call, in_words, pickled, usable_cores
from cortado.errors import ComputationError, InputError, shown, warn
from cortado.files.terminal import Hold

if TYPE_CHECKING:
    import distributed

__all__ = ["Distributed", "Executor", "InProcess", "local_workers"]

Item = TypeVar("Item")
Result = TypeVar("Result")
OnResult = Callable[[int, Any], None]
"""A function of an item's number, from 0, and the item's result. Executors call the function in the caller's thread."""


class Executor(ABC):
    """The base class of executors, which compute a function of many independent items.

    On the same kind of processor, the results of all executors are bitwise equal.
    """

    def threads(self) -> int:
        """Return the number of items computed at the same time."""
        return 1

    @abstractmethod
    def map(
        self, function: Callable[[Item], Result], items: Iterable[Item], on_result: OnResult | None = None
    ) -> list[Result]:
        """Return results of ``function`` in the order of the ``items``. ``on_result`` is called for each result.

        Large data, such as a problem, should be part of the function. The error of the first failed item is raised.
        """


@dataclass(frozen=True)
class InProcess(Executor):
    """An executor that computes one item after the other in this process.

    Example: ``results = cortado.evaluate(problem, points, executor=cortado.executors.InProcess())``
    """

    def map(
        self, function: Callable[[Item], Result], items: Iterable[Item], on_result: OnResult | None = None
    ) -> list[Result]:
        _check_call(function, items, on_result)
        results = []
        for number, item in enumerate(items):
            results.append(function(item))
            if on_result is not None:
                on_result(number, results[-1])
        return results


def _check_call(function: Any, items: Any, on_result: Any) -> None:
    require_arguments("function", function, ("an item",))
    if not isinstance(items, Iterable):
        raise InputError(f"items is {shown(items)}, but must be a list of items.")
    require_function("on_result", on_result, "the number of an item", "its result")


def checked_executor(executor: Any) -> Executor:
    if not isinstance(executor, Executor):
        is_class, wanted = isinstance(executor, type), "cortado.executors.InProcess() or Distributed(scheduler)"
        found = f"the class {executor.__name__}" if is_class else f"of the type {type(executor).__name__}"
        raise InputError(f"executor is {found}, but must be an object such as {wanted}.")
    return executor


# ---- workers of a scheduler --------------------------------------------------------------------------------------

REACHED = 10.0
LOOK = 1.0
WAIT = 0.1
AHEAD = 2
"""Number of items sent to each thread of a worker in advance."""


class Distributed(Executor):
    """An executor on the workers of a scheduler of Dask's distributed.

    If a worker is lost, the remaining workers compute the lost items again. Results and errors are bitwise the same as
    in one process. A worker computes one item at a time, and caches the last few functions.

    Example: ``workers = cortado.executors.Distributed("tcp://10.0.0.1:8786")``
    """

    def __init__(self, scheduler: "str | distributed.Client", patience: float = 60.0):
        """Connect to ``scheduler``, an address such as "tcp://10.0.0.1:8786" or a client. After the loss of all
        workers, the executor waits at most ``patience`` [s] for new workers. Raises `InputError` if distributed is not
        installed or the scheduler does not answer."""
        module = _distributed()
        self.patience, self._owned = patience, isinstance(scheduler, str)
        self.client = _connected(module, scheduler) if isinstance(scheduler, str) else scheduler
        if not isinstance(self.client, module.Client) or self.client.asynchronous:
            wanted = 'an address such as "tcp://10.0.0.1:8786", or a distributed.Client that is not asynchronous'
            raise InputError(f"scheduler is {shown(scheduler)}, but must be {wanted}.")
        self.address: str = self.client.scheduler.address

    def __repr__(self) -> str:
        return f"Distributed({self.address!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        raise InputError("An executor cannot be used within a computation of another executor: use one executor.")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect from the scheduler. If the user gave a client, the client remains connected."""
        if self._owned:
            self.client.close()

    def map(
        self, function: Callable[[Item], Result], items: Iterable[Item], on_result: OnResult | None = None
    ) -> list[Result]:
        """Return the results of ``function`` for all ``items``; see `Executor.map`. `map` starts with the first worker.

        Raises `InputError` if the function or an item cannot be pickled, and `ComputationError` without workers.
        """
        _check_call(function, items, on_result)
        return _Map(self, Payload.of(function), on_result).results(items)

    def threads(self) -> int:
        """Return the number of items computed at the same time. Raises `ComputationError` if the scheduler is lost."""
        if self.client.status != "running":
            raise self.lost()
        try:
            return sum(self.client.nthreads().values())
        except OSError as error:
            raise self.lost() from error

    def replace_workers(self) -> None:
        """Replace ended workers of this machine."""

    def lost(self) -> ComputationError:
        return ComputationError(f"The scheduler {self.address} was lost, and its workers too; restart both.")

    def deserted(self, seconds: float) -> ComputationError:
        said = f"The scheduler {self.address} has had no worker for {seconds:.0f} s"
        return ComputationError(f"{said}; start workers, as with `dask worker {self.address} --nthreads 1`.")


class _Map:
    def __init__(self, executor: Distributed, payload: Payload, on_result: OnResult | None):
        self._executor, self._payload, self._on_result = executor, payload, on_result
        self._calls = executor.client.get_executor(pure=False)
        self._sent: dict[Future[Any], tuple[int, bytes]] = {}
        self._results: dict[int, Any] = {}
        self._failed: tuple[int, BaseException] | None = None
        self._name = f"cortado-{uuid4().hex}"
        self._most = 0
        self._counted, self._manned = -LOOK, time.monotonic()
        """Time [s] of the last count of workers, and time [s] of the last count that found a worker."""

    def results(self, items: Iterable[Item]) -> list[Any]:
        import dask

        client, lost, left = self._executor.client, deque[str](), enumerate(items)

        def hear(event: tuple[float, dict[str, Any]]) -> None:
            _, said = event
            tasks = said.get("processing-tasks", ()) if said.get("action") == "remove-worker" else ()
            if any(str(key).startswith(self._name) for key in tasks):
                lost.append(str(said.get("worker")))

        def tell() -> None:
            while lost:
                warn(f"The worker {lost.popleft()} was lost; another worker computes the lost items again.")

        client.subscribe_topic("all", hear)
        try:
            with dask.config.set({"distributed.admin.large-graph-warning-threshold": 2**40}):
                while self._fill(left):
                    done, _ = wait(self._sent, LOOK, FIRST_COMPLETED)
                    self._count_workers(LOOK)
                    tell()
                    for future in done:
                        if future in self._sent:  # or else given up, as an item before it failed
                            self._take(future)
        finally:
            with suppress(OSError):  # the scheduler may be lost
                self._calls.shutdown(wait=False)
            with suppress(ValueError, OSError):
                client.unsubscribe_topic("all")
        tell()
        if self._failed is not None:
            raise self._failed[1]
        return [self._results[number] for number in range(len(self._results))]

    def _fill(self, left: Iterator[tuple[int, Any]]) -> bool:
        """Send items to workers. Return True if a result is still missing."""
        self._count_workers(LOOK)
        while not self._most and not self._sent:  # how much an item asks for may depend on how many workers there are
            time.sleep(WAIT)
            self._count_workers(WAIT)
        while len(self._sent) < self._most and self._failed is None and (pair := next(left, None)):
            number, item = pair[0], pickled(pair[1], f"Item {pair[0]}")
            # The function is no task of its own: items would queue up for the worker that has it while others are idle.
            sent = self._calls.submit(call, self._payload.mention, item, key=f"{self._name}-{number}")
            self._sent[sent] = number, item
        return bool(self._sent)

    def _count_workers(self, interval: float) -> None:
        now = time.monotonic()
        if now - self._counted < interval:
            return
        self._counted = now
        self._executor.replace_workers()
        threads = self._executor.threads()
        self._most = AHEAD * threads
        self._manned = now if threads else self._manned
        if now - self._manned > self._executor.patience:
            raise self._executor.deserted(now - self._manned)

    def _take(self, future: Future[Any]) -> None:
        number, item = self._sent.pop(future)
        try:
            try:
                answer: Answer | Lacking = future.result()
            except CancelledError:
                raise self._executor.lost() from None
            except _distributed().KilledWorker as error:
                said = f"Item {number} was given up, as {error.allowed_failures + 1} workers were lost"
                raise ComputationError(f"{said} while computing it; the workers may have too little memory.") from None
            except Exception as error:  # of distributed itself, such as a worker without Cortado
                said = f"Item {number} could not be computed by a worker: {in_words(error)}."
                raise ComputationError(said) from error
            if isinstance(answer, Lacking):
                again = self._calls.submit(call, self._payload, item, key=f"{self._name}-{number}-again")
                self._sent[again] = number, item
                return
            self._results[number] = answer.result()
        except Exception as error:
            if self._failed is None or number < self._failed[0]:
                self._failed = number, error
            for later in [one for one, (other, _) in self._sent.items() if other > self._failed[0]]:
                del self._sent[later]
                later.cancel()
            return
        if self._on_result is not None:
            self._on_result(number, self._results[number])


def _distributed() -> Any:
    try:
        import distributed
    except ModuleNotFoundError:
        said = "Several processes need Dask's distributed, which is not installed"
        raise InputError(f"{said}: pip install distributed.") from None
    return distributed


def _connected(module: Any, address: str) -> Any:
    from distributed.comm import connect

    async def meet() -> None:
        await (await connect(address, timeout=REACHED)).close()

    # In a thread, as notebooks have an event loop in theirs.
    with ThreadPoolExecutor(1) as thread:
        try:
            thread.submit(asyncio.run, meet()).result()
        except (OSError, ValueError, TypeError) as error:
            reason = f"no scheduler answers there within {REACHED:g} s" if isinstance(error, OSError) else error
            said = f"There is no scheduler at {address!r}, but an address such as tcp://10.0.0.1:8786 is needed"
            raise InputError(f"{said}: {reason}.") from None
    return module.Client(address, timeout=REACHED, set_as_default=False)


# ---- worker processes on this machine ----------------------------------------------------------------------------

LOOPBACK = "127.0.0.1"
GONE = "3 s"
"""Waiting time before an ended process is replaced."""
PROCESSES_A_CORE = 4
LEAST_LIMIT = 64
IGNORE_INTERRUPTS = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"


class LocalWorkers(Distributed):
    """An executor on processes of this machine. A nanny process restarts each worker process."""

    def __init__(self, client: Any, cluster: Any):
        super().__init__(client)
        self._cluster = cluster

    def replace_workers(self) -> None:
        self._cluster.scale(len(self._cluster.worker_spec))

    def deserted(self, seconds: float) -> ComputationError:
        why = 'a process may have too little memory, or the script is not under `if __name__ == "__main__":`'
        return ComputationError(f"No worker process has started for {seconds:.0f} s; {why}.")


@contextmanager
def local_workers(number: int | None = None, device: str = "cpu") -> Iterator[Distributed]:
    """Start worker processes on this machine, replace lost ones, and end all of them after the ``with`` block.

    ``number`` is the number of processes, by default one for each core, or one for each GPU with the ``device`` "cuda".
    On GPUs each process sees one GPU as "cuda:0". Every process imports the script; put its code under
    ``if __name__ == "__main__":``.

    Raises `InputError` for more processes than GPUs. On a CPU, the limit is 64 processes, or four processes for each
    core on machines with more than 16 cores.

    Example: ``with cortado.executors.local_workers() as workers: ...``
    """
    import dask

    module = _distributed()
    options: dict[str, Any] = {"nthreads": 1, "memory_limit": None, "silence_logs": logging.CRITICAL, "host": LOOPBACK}
    options["preload"] = [IGNORE_INTERRUPTS]
    each = enumerate(_environments(number, device))
    workers = {name: {"cls": module.Nanny, "options": {**options, "env": own}} for name, own in each}
    somewhere = {"host": LOOPBACK, "port": 0, "dashboard_address": f"{LOOPBACK}:0", "dashboard": False}
    scheduler = {"cls": module.Scheduler, "options": somewhere}
    hold = Hold()
    with ExitStack() as stack:
        if sys.platform != "win32":  # a thread that starts it, to remove semaphores, would let Ctrl-C through again
            from multiprocessing import resource_tracker

            resource_tracker.ensure_running()
        hold.begin()
        stack.callback(hold.end)
        stack.enter_context(dask.config.set({"distributed.deploy.lost-worker-timeout": GONE}))
        cluster = stack.enter_context(module.SpecCluster(workers, scheduler, silence_logs=logging.CRITICAL))
        client = stack.enter_context(module.Client(cluster, set_as_default=False))
        stack.callback(hold.begin)  # first of all at the end, as a second Ctrl-C would leave workers behind
        hold.end()
        yield LocalWorkers(client, cluster)


def _environments(number: int | None, device: str) -> list[dict[str, str]]:
    if number is not None:
        require_processes("number", number)
    if device == "cpu":
        number = number or usable_cores()
        return [{CORES: str(max(usable_cores() // number, 1))}] * number
    if device != "cuda":
        raise InputError(f'device is {shown(device)}, but must be "cpu", or "cuda" for all GPUs.')
    gpus = visible_gpus()
    if (number or 1) > len(gpus):
        raise InputError(f"{number or 1} worker processes need a GPU each, but there are {len(gpus)} GPUs.")
    return [{VISIBLE: gpu} for gpu in gpus[:number]]


def require_processes(what: str, number: object) -> None:
    require_whole(what, number, 1)
    cores = usable_cores()
    most = max(PROCESSES_A_CORE * cores, LEAST_LIMIT)
    if number > most:  # type: ignore[operator]
        said = f"{what} is {shown(number)}, but must be at most {most}, as this machine has {counted(cores, 'core')}"
        raise InputError(f"{said}; more than one process per core does not save time.")


__dir__ = face(globals())
