"""A scheduler of Dask's and its workers, as processes of their own on the loopback address."""

import json
import os
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

PATIENCE = 60.0
"""Seconds after which something hangs."""
ONE_THREAD = ("--nthreads", "1", "--no-nanny", "--preload", "work_for_workers")
LOOPBACK = ("--host", "127.0.0.1", "--no-dashboard")


class Scheduler:
    """The processes, and where the scheduler is."""

    def __init__(self, folder, workers):
        self._file = Path(folder) / "scheduler.json"
        self._processes = []
        self._start("dask_scheduler", "--port", "0", "--scheduler-file", self._file, *LOOPBACK)
        self.address = self._address()
        self.workers = [self.start_worker() for _ in range(workers)]

    @property
    def process(self):
        """That of the scheduler itself."""
        return self._processes[0]

    def start_worker(self):
        """One worker more, whose kernels are those of the tests."""
        return self._start("dask_worker", self.address, *ONE_THREAD, *LOOPBACK)

    def stop(self):
        for process in self._processes:
            process.kill()
            process.wait(PATIENCE)

    def _start(self, program, *arguments):
        command = [sys.executable, "-m", f"distributed.cli.{program}", *map(str, arguments)]
        path = os.pathsep.join([str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = {**os.environ, "PYTHONPATH": path, "CORTADO_CORES": "1"}
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._processes.append(subprocess.Popen(command, env=environment, **quiet))
        return self._processes[-1]

    def _address(self):
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            try:
                return json.loads(self._file.read_text())["address"]
            except (FileNotFoundError, ValueError):  # not there yet, or half written
                time.sleep(0.05)
        raise TimeoutError("the scheduler did not start")


@contextmanager
def scheduler(folder, workers):
    """A scheduler with so many workers, none of which is started again when it is lost."""
    started = Scheduler(folder, workers)
    try:
        yield started
    finally:
        started.stop()
