"""Where a command computes what does not depend on one another: ``--scheduler`` and ``--workers``."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from cortado.errors import InputError
from cortado.executors import Distributed, Executor, InProcess, local_workers, require_processes
from cortado.files.interruption import keeping


@dataclass(frozen=True)
class Where:
    """The options of a command; raises `InputError` for both of them, and for more processes than make sense."""

    scheduler: str | None = None
    """The address of a scheduler of Dask's."""
    workers: int | None = None
    """Number of worker processes on this machine."""

    def __post_init__(self) -> None:
        if self.scheduler is not None and self.workers is not None:
            raise InputError("--scheduler and --workers are both given, but only one of them can be meant.")
        if self.workers is not None:
            require_processes("--workers", self.workers)

    @property
    def option(self) -> str | None:
        """The option that was given."""
        return "--scheduler" if self.scheduler is not None else None if self.workers is None else "--workers"

    @contextmanager
    def executor(self, device: str, items: int) -> Iterator[Executor]:
        """This process unless workers are asked for, which end with the block; on a GPU each has one of its own. There
        are no more processes than ``items`` that are computed at a time."""
        if self.scheduler is not None:
            with Distributed(self.scheduler) as there:
                yield there
        elif self.workers is not None:
            processes = min(self.workers, max(items, 1))
            with keeping(lambda: ""), local_workers(processes, device.partition(":")[0]) as here:
                yield here
        else:
            yield InProcess()


HERE = Where()
"""In this process."""
