"""What options of several commands name: runs, numbers of the user's own, and where work is computed."""

import runpy
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cortado.errors import CortadoError, InputError, shown
from cortado.executors import Distributed, Executor, InProcess, local_workers, require_processes
from cortado.files.disk import LOCK
from cortado.files.terminal import keeping
from cortado.optimisation.sweep import folders_in
from cortado.runs.run_folder import RunFolder
from cortado.runs.trajectory import Trajectory


@dataclass(frozen=True)
class Where:
    """The options --scheduler and --workers of a command; raises `InputError` for both of them, and for more processes
    than make sense."""

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
        """Return the option that was given."""
        return "--scheduler" if self.scheduler is not None else None if self.workers is None else "--workers"

    @contextmanager
    def executor(self, device: str, items: int) -> Iterator[Executor]:
        """Yield the executor: a Dask scheduler if one is given, workers if they are asked for, or else this process.
        Workers end with the block, and on a GPU each has one of its own. There are no more of them than ``items``,
        the computations that run at a time."""
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
"""Computation in this process."""


def require_shared(out: Path, what: str) -> None:
    """Raise `InputError` where a worker process does not see a folder in which its command is at work."""
    if not (out / LOCK).exists():
        raise InputError(f"A worker does not see {out}, but {what} must be in a file system that all machines share.")


def named_runs(folders: Sequence[Path]) -> list[RunFolder]:
    """Return the runs that are named, in each folder of a sweep all of them, in the order of its table. Raise
    `InputError` for a folder without a run."""
    if not folders:
        raise InputError("RUN is missing, but must be the folder of a run, or of a sweep.")
    found: list[RunFolder] = []
    for folder in folders:
        inner, order = sorted(one.parent for one in folder.glob("*/environment.json")), folders_in(folder)
        inner.sort(key=lambda one: order.index(one.name) if one.name in order else len(order))
        found += [RunFolder.open(one) for one in inner or [folder]]
    return found


class OwnQuantity:
    """A user's function of a trajectory that returns a number."""

    def __init__(self, where: str):
        """Run the file of ``FILE.py:FUNCTION``; raise `InputError` for one that cannot be run, or has no such
        function."""
        file, _, name = where.rpartition(":")
        if not file.endswith(".py") or not name.isidentifier():
            raise InputError(f"--quantity is {shown(where)}, but must be FILE.py:FUNCTION.")
        try:
            function = runpy.run_path(str(Path(file))).get(name)
        except Exception as problem:
            raise InputError(f"--quantity {where} cannot be read: {_told(problem)}.") from problem
        if not callable(function):
            raise InputError(f"{file} has no function {name}, but must, as --quantity names it.")
        self.where, self.name, self._function = where, name, function

    def __call__(self, trajectory: Trajectory) -> float:
        """Return the number of a trajectory; raise `InputError` where the function fails, or returns something else."""
        try:
            found = self._function(trajectory)
            value = np.asarray(found, dtype=np.float64)
        except CortadoError:
            raise
        except Exception as problem:
            raise InputError(f"--quantity {self.where} failed: {_told(problem)}.") from problem
        if value.ndim:
            raise InputError(f"--quantity {self.where} returned {shown(found)}, but must return a number.")
        return float(value)


def _told(problem: Exception) -> str:
    """Return the kind and the words of an error, on one line."""
    return " ".join(f"{type(problem).__name__}: {problem}".split()).rstrip(".")
