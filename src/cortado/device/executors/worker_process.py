"""What a worker process of this machine does as it starts: a preload of Dask's."""

import signal
from typing import Any


def dask_setup(worker: Any) -> None:
    """Leave Ctrl-C, which a terminal sends to all processes, to the one that started the workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
