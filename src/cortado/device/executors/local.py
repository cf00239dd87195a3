"""Worker processes on this machine: several on a CPU, or one for each GPU."""

import asyncio
import logging
import os
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from cortado.arrays import require_whole
from cortado.device.cores import VARIABLE as CORES
from cortado.device.cores import usable_cores
from cortado.device.executors.distributed import Distributed, distributed_module
from cortado.errors import ComputationError, InputError, shown
from cortado.files.interruption import Hold
from cortado.words import counted

VISIBLE = "CUDA_VISIBLE_DEVICES"
"""The environment variable that says which GPUs a process has."""
LOOPBACK = "127.0.0.1"
START, LONG_START = 3.0, 30.0
"""[s] within which a nanny starts a process, and within which a process is a worker, also on a busy machine."""
PROCESSES_A_CORE = 4
"""At most; each has some 200 MB of its own."""
LEAST_LIMIT = 64
"""The limit where there are few cores."""


class LocalWorkers(Distributed):
    """Worker processes on this machine, each with a nanny in this process that starts it again when it is killed.

    A nanny may end with a worker that ends by itself, or wait for ever. Another one then takes its place.
    """

    def __init__(self, client: Any, cluster: Any):
        super().__init__(client)
        self._cluster = cluster
        self._missing: dict[Any, float] = {}
        """Since when nannies have been seen to have no worker [s], by their names."""

    def mend(self) -> None:
        """Replace nannies that have ended by new ones, without waiting for them."""
        now = time.monotonic()
        there = {worker.name for worker in [*self._cluster.scheduler.workers.values()]}
        nannies = {name: nanny for name, nanny in [*self._cluster.workers.items()] if name not in there}
        self._missing = {name: self._missing.get(name, now) for name in nannies}
        ended = [name for name, nanny in nannies.items() if _has_ended(nanny, now - self._missing[name])]
        if ended or len(self._cluster.workers) < len(self._cluster.worker_spec):
            self._missing = {name: since for name, since in self._missing.items() if name not in ended}
            self._cluster.loop.add_callback(self._replace, ended)

    async def _replace(self, names: Iterable[Any]) -> None:
        """In the thread of the cluster."""
        nannies = [self._cluster.workers.pop(name, None) for name in names]
        for nanny in filter(None, nannies):
            with suppress(Exception):  # it goes on to be closed, and its process with it
                await asyncio.wait_for(nanny.close(), LONG_START)
        with suppress(Exception):  # a worker that does not start either, which is seen at the next look
            await self._cluster._correct_state()

    def deserted(self, seconds: float) -> ComputationError:
        """What to say where there was no worker for so long [s]."""
        return ComputationError(
            f"No worker process has started for {seconds:.0f} s; there may be too little memory for it, or the script "
            'does not begin under `if __name__ == "__main__":`.'
        )


def _has_ended(nanny: Any, missing: float) -> bool:
    """Whether a nanny that has had no worker for so long [s] will not have one any more."""
    status = distributed_module().Status
    patience = LONG_START if nanny.is_alive() else START
    return nanny.status in (status.closed, status.failed) or missing > patience


@contextmanager
def local_workers(number: int | None = None, device: str = "cpu") -> Iterator[Distributed]:
    """Worker processes on this machine, which a scheduler in this process starts, starts again when they are lost, and
    ends with the block.

    ``number``: of processes; by default one for each core, or for each GPU with a ``device`` of "cuda". The cores are
    shared out among them. On GPUs each process sees one, as "cuda:0". A script that uses them must begin under
    ``if __name__ == "__main__":``, as every process imports it. Raises `InputError` for more processes than there are
    GPUs, or than four for each core, and 64.
    """
    module = distributed_module()
    environments = _environments(number, device)
    options: dict[str, Any] = {
        "nthreads": 1,
        "memory_limit": None,
        "silence_logs": logging.CRITICAL,
        "preload": ["cortado.device.executors.worker_process"],
        "host": LOOPBACK,
    }
    workers = {
        name: {"cls": module.Nanny, "options": {**options, "env": variables}}
        for name, variables in enumerate(environments)
    }
    somewhere = {"host": LOOPBACK, "port": 0, "dashboard_address": f"{LOOPBACK}:0", "dashboard": False}
    scheduler = {"cls": module.Scheduler, "options": somewhere}
    hold = Hold()
    with ExitStack() as stack:
        _start_tracker()
        hold.begin()
        stack.callback(hold.end)
        cluster = stack.enter_context(module.SpecCluster(workers, scheduler, silence_logs=logging.CRITICAL))
        client = stack.enter_context(module.Client(cluster, set_as_default=False))
        stack.callback(hold.begin)  # first of all at the end, as a second Ctrl-C would leave workers behind
        hold.end()
        yield LocalWorkers(client, cluster)


def _start_tracker() -> None:
    """The process that removes semaphores which workers leave behind: a thread that starts it hears Ctrl-C again."""
    if sys.platform != "win32":
        from multiprocessing import resource_tracker

        resource_tracker.ensure_running()


def _environments(number: int | None, device: str) -> list[dict[str, str]]:
    """Environment variables of each process."""
    if number is not None:
        require_processes("number", number)
    if device == "cpu":
        number = usable_cores() if number is None else number
        return [{CORES: str(max(usable_cores() // number, 1))}] * number
    if device != "cuda":
        raise InputError(f'device is {shown(device)}, but must be "cpu", or "cuda" for all GPUs.')
    gpus = visible_gpus()
    number = len(gpus) if number is None else number
    if number > len(gpus) or not gpus:
        raise InputError(f"{number or 1} worker processes need a GPU each, but there are {len(gpus)}.")
    return [{VISIBLE: gpu} for gpu in gpus[:number]]


def require_processes(what: str, number: object) -> None:
    """Raises `InputError`, in a sentence that begins with ``what``, unless so many processes make sense here."""
    require_whole(what, number, 1)
    cores = usable_cores()
    most = max(PROCESSES_A_CORE * cores, LEAST_LIMIT)
    if number > most:  # type: ignore[operator]
        raise InputError(
            f"{what} is {shown(number)}, but must be at most {most}, as this machine has {counted(cores, 'core')}: "
            "more processes than cores compute nothing sooner."
        )


def visible_gpus() -> list[str]:
    """The GPUs that this process may use, as CUDA names them."""
    import warp as wp

    from cortado.device.kernel_cache import start_warp

    start_warp()
    given = [name.strip() for name in os.environ.get(VISIBLE, "").split(",") if name.strip()]
    present = wp.get_cuda_device_count()
    return given[:present] if given else [str(k) for k in range(present)]
