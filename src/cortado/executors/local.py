"""Worker processes on this machine: several on a CPU, or one for each GPU."""

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from cortado.device.cores import VARIABLE as CORES
from cortado.device.cores import usable_cores
from cortado.errors import InputError, shown
from cortado.executors.distributed import Distributed, distributed_module
from cortado.io.interruption import Hold

VISIBLE = "CUDA_VISIBLE_DEVICES"
"""The environment variable that says which GPUs a process has."""
LOOPBACK = "127.0.0.1"


@contextmanager
def local_workers(number: int | None = None, device: str = "cpu") -> Iterator[Distributed]:
    """Worker processes on this machine, which a scheduler in this process starts, starts again when they are lost, and
    ends with the block.

    ``number``: of processes; by default one for each core, or for each GPU with a ``device`` of "cuda". The cores are
    shared out among them. On GPUs each process sees one, as "cuda:0". A script that uses them must begin under
    ``if __name__ == "__main__":``, as every process imports it. Raises `InputError` for more processes than there are
    GPUs.
    """
    module = distributed_module()
    environments = _environments(number, device)
    options: dict[str, Any] = {
        "nthreads": 1,
        "memory_limit": None,
        "silence_logs": logging.CRITICAL,
        "preload": ["cortado.executors.worker_process"],
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
        yield Distributed(client)


def _start_tracker() -> None:
    """The process that removes semaphores which workers leave behind: a thread that starts it hears Ctrl-C again."""
    if sys.platform != "win32":
        from multiprocessing import resource_tracker

        resource_tracker.ensure_running()


def _environments(number: int | None, device: str) -> list[dict[str, str]]:
    """Environment variables of each process."""
    if number is not None and (type(number) is not int or number < 1):
        raise InputError(f"number is {shown(number)}, but must be a whole number of at least 1.")
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


def visible_gpus() -> list[str]:
    """The GPUs that this process may use, as CUDA names them."""
    import warp as wp

    from cortado.device.kernel_cache import start_warp

    start_warp()
    given = [name.strip() for name in os.environ.get(VISIBLE, "").split(",") if name.strip()]
    present = wp.get_cuda_device_count()
    return given[:present] if given else [str(k) for k in range(present)]
