"""Workers of Dask's distributed, on this machine or on others.

Its own executor, `Client.get_executor`, takes all items at once, and waits for ever where no worker is left.
"""

import asyncio
import queue
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Self
from uuid import uuid4

from cortado.device.executors.calls import Answer, Lacking, Payload, call, in_words, pickled
from cortado.device.executors.executor import Executor, Item, OnResult, Result, check_call
from cortado.errors import ComputationError, InputError, shown, warn

if TYPE_CHECKING:
    import distributed

REACHED = 10.0
"""[s] within which a scheduler answers."""
LOOK = 1.0
"""[s] without a result after which the scheduler is looked at."""
WAIT = 0.1
"""[s] after which the first worker is looked for again."""
AHEAD = 2
"""Items at a time for each thread of a worker: one that is computed and others that wait, so that none is idle."""


class Distributed(Executor):
    """Computes on the workers of a scheduler of Dask's distributed.

    What a lost worker was computing is computed again by another one. Results arrive in the order of the items, with
    the bits that they have in one process, and errors are raised here as they were there. A worker computes one item
    at a time, and keeps the last functions that it was sent, with their problems.
    """

    def __init__(self, scheduler: "str | distributed.Client", patience: float = 60.0):
        """``scheduler``: its address, such as "tcp://10.0.0.1:8786", or a client of it; ``patience`` [s]: how long to
        wait where there is no worker left.

        Raises `InputError` where distributed is not installed, or where there is no scheduler.
        """
        module = distributed_module()
        self.patience = patience
        self._owned = isinstance(scheduler, str)
        self.client = _connected(module, scheduler) if isinstance(scheduler, str) else scheduler
        if not isinstance(self.client, module.Client) or self.client.asynchronous:
            wanted = 'an address such as "tcp://10.0.0.1:8786", or a distributed.Client that is not asynchronous'
            raise InputError(f"scheduler is {shown(scheduler)}, but must be {wanted}.")
        self.address: str = self.client.scheduler.address

    def __repr__(self) -> str:
        return f"Distributed({self.address!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        raise InputError("An executor cannot be used within what an executor computes: leave one of the two out.")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the scheduler, unless with a client that was given."""
        if self._owned:
            self.client.close()

    def map(
        self, function: Callable[[Item], Result], items: Iterable[Item], on_result: OnResult | None = None
    ) -> list[Result]:
        """See `Executor.map`. ``function``, items and results are pickled.

        Waits for the first worker. Raises `InputError` for what cannot be pickled, `ComputationError` where the
        scheduler or all workers are lost for good, or an item ends its process.
        """
        check_call(function, items, on_result)
        return _Map(self, Payload.of(function), on_result).results(items)

    def threads(self) -> int:
        """How many items workers compute at a time; raises `ComputationError` where the scheduler is lost."""
        if self.client.status != "running":
            raise self.lost()
        try:
            return sum(self.client.nthreads().values())
        except OSError as error:
            raise self.lost() from error

    def mend(self) -> None:
        """Called now and then while there is something to compute: start workers that are lost, where that is ours."""

    def lost(self) -> ComputationError:
        """What to say where the scheduler is not there any more."""
        return ComputationError(f"The scheduler {self.address} was lost, and what is computed there with it.")

    def deserted(self, seconds: float) -> ComputationError:
        """What to say where there was no worker for so long [s]."""
        return ComputationError(
            f"The scheduler {self.address} has had no worker for {seconds:.0f} s; start some, such as by "
            f"`dask worker {self.address} --nthreads 1`."
        )


class _Map:
    """One function, mapped over items by the workers."""

    def __init__(self, executor: Distributed, payload: Payload, on_result: OnResult | None):
        self._executor, self._client, self._on_result = executor, executor.client, on_result
        self._arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._sent: dict[Any, tuple[int, bytes]] = {}
        """Numbers and items that workers have, by their futures."""
        self._results: dict[int, Any] = {}
        self._failed: tuple[int, BaseException] | None = None
        """The first item, in their order, whose error is known, and its error."""
        self._name, self._payload = f"cortado-{uuid4().hex}", payload
        self._room = 0
        """How many items workers are given at a time."""
        self._looked, self._manned = -LOOK, time.monotonic()
        """When the workers were counted last, and when there were any [s]."""

    def results(self, items: Iterable[Item]) -> list[Any]:
        """The results in the order of the items."""
        import dask

        with self._watched(), dask.config.set({"distributed.admin.large-graph-warning-threshold": 2**40}):
            left = enumerate(items)
            try:
                while self._fill(left):
                    self._take()
            finally:
                with suppress(OSError):  # the scheduler may be lost
                    self._client.cancel(list(self._sent))
        if self._failed is not None:
            raise self._failed[1]
        return [self._results[number] for number in range(len(self._results))]

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """Workers that are lost are heard of within it."""

        def hear(event: tuple[float, dict[str, Any]]) -> None:
            _, told = event
            if told.get("action") == "remove-worker" and any(
                str(key).startswith(self._name) for key in told.get("processing-tasks", ())
            ):
                self._arrived.put(told.get("worker"))

        self._client.subscribe_topic("all", hear)
        try:
            yield
        finally:
            with suppress(ValueError, OSError):
                self._client.unsubscribe_topic("all")

    def _fill(self, left: Iterator[tuple[int, Any]]) -> bool:
        """Send as many items as workers need, none after an error; whether there is anything to wait for."""
        self._look(LOOK)
        while not self._room and not self._sent:  # how much an item asks for may depend on how many workers there are
            time.sleep(WAIT)
            self._look(WAIT)
        while len(self._sent) < self._room and self._failed is None and (pair := next(left, None)):
            number, item = pair
            self._send(self._payload.mention, number, pickled(item, f"Item {number}"))
        return bool(self._sent)

    def _send(self, payload: Payload, number: int, item: bytes) -> None:
        # The function is no task of its own: items would queue up for the worker that has it while others are idle.
        key = f"{self._name}-{number}{'-again' * (payload.content is not None)}"
        future = self._client.submit(call, payload, item, key=key, pure=False)
        self._sent[future] = number, item
        future.add_done_callback(self._arrived.put)

    def _look(self, interval: float) -> None:
        """See how many workers there are, if that was not seen within the interval [s]."""
        now = time.monotonic()
        if now - self._looked < interval:
            return
        self._looked = now
        self._executor.mend()
        threads = self._executor.threads()
        self._room = AHEAD * threads
        self._manned = now if threads else self._manned
        if now - self._manned > self._executor.patience:
            raise self._executor.deserted(now - self._manned)

    def _take(self) -> None:
        """Wait for one result, or for the news that a worker was lost."""
        found = self._next()
        if isinstance(found, str):
            sentence = f"The worker {found} was lost; what it was computing is computed again by another one."
            warn(sentence)
        elif found in self._sent:
            number, item = self._sent.pop(found)
            try:
                answer = self._answer(found, number)
                if isinstance(answer, Lacking):
                    return self._send(self._payload, number, item)
                self._results[number] = _result(answer)
            except Exception as error:
                return self._fail(number, error)
            if self._on_result is not None:
                self._on_result(number, self._results[number])

    def _next(self) -> Any:
        """What arrives next: a future, or the address of a worker that was lost."""
        while True:
            with suppress(queue.Empty):
                return self._arrived.get(timeout=LOOK)
            self._look(0.0)

    def _answer(self, future: Any, number: int) -> Answer | Lacking:
        """Of a call that has ended; raises `ComputationError` where there is none."""
        try:
            answer = self._fetched(future)
        except CancelledError:
            raise self._executor.lost() from None
        except ComputationError:  # as there is no worker left
            raise
        except distributed_module().KilledWorker as error:
            raise ComputationError(
                f"Item {number} was given up, as {error.allowed_failures + 1} workers were lost one after the other "
                "while they had it: they may have too little memory for it."
            ) from None
        except Exception as error:  # of distributed itself, such as a worker without Cortado
            raise ComputationError(f"Item {number} could not be computed by a worker: {in_words(error)}.") from error
        assert isinstance(answer, (Answer, Lacking))
        return answer

    def _fetched(self, future: Any) -> Any:
        """What a worker has. It may be lost with the worker before it is here, and is computed again once there is
        another one: waits are longer and longer, as a large result takes long too."""
        wait = LOOK
        while True:
            with suppress(TimeoutError):
                return future.result(timeout=wait)
            self._look(0.0)
            wait *= 2.0

    def _fail(self, number: int, error: BaseException) -> None:
        """Note an error; only items before it are still of interest."""
        if self._failed is None or number < self._failed[0]:
            self._failed = number, error
        idle = [future for future, (other, _) in self._sent.items() if other > self._failed[0]]
        for future in idle:
            del self._sent[future]
        with suppress(OSError):
            self._client.cancel(idle)


def _result(answer: Answer) -> Any:
    """What the function returned; raises what it raised."""
    for text, category in answer.warnings:
        warn(text, category)
    if answer.error is None:
        return answer.result
    if answer.traceback:
        answer.error.add_note(f"In a worker process:\n{answer.traceback}")
    raise answer.error


def distributed_module() -> Any:
    """Dask's distributed; raises `InputError` where it is not installed."""
    try:
        import distributed
    except ModuleNotFoundError:
        raise InputError(
            "Several processes need Dask's distributed, which is not installed: pip install distributed."
        ) from None
    return distributed


def _connected(module: Any, address: str) -> Any:
    """A client of the scheduler at an address; raises `InputError` where there is none."""
    # In a thread, as notebooks have an event loop in theirs.
    with ThreadPoolExecutor(1) as thread:
        try:
            thread.submit(asyncio.run, _met(address)).result()
        except (OSError, ValueError, TypeError) as error:
            reason = f"nothing there answers as one within {REACHED:g} s" if isinstance(error, OSError) else error
            raise InputError(
                f"There is no scheduler at {address!r}, but an address such as tcp://10.0.0.1:8786 is needed: {reason}."
            ) from None
    return module.Client(address, timeout=REACHED, set_as_default=False)


async def _met(address: str) -> None:
    """Raises `OSError` unless something of Dask's answers. A client that fails would go on trying for a while."""
    from distributed.comm import connect

    comm = await connect(address, timeout=REACHED)
    await comm.close()
