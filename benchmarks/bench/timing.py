"""How work is timed: warm, synchronised, the median of a few repeats."""

import os
import time
from collections.abc import Callable
from functools import partial
from statistics import median

import warp as wp

from cortado.device.launching import CapturedGraph, KernelLauncher
from cortado.device.reduction import add

MOST_LAUNCHES = 20
"""Launches at most that are timed together, so that the cost of waiting for the device is shared by them."""
BATCH = 0.005
"""[s] that launches which are timed together should take: fewer than `MOST_LAUNCHES` of them where each takes long."""
MOST_REPEATS = 100_000
"""Of what is timed: more of them tell nothing more of a median, and of a dam break take days."""

Work = Callable[[], object]


def now() -> float:
    """[s] by the clock; where ``CORTADO_CORES=1`` leaves one core of a CPU by the time of the processor, which other
    processes do not lengthen."""
    return time.process_time() if os.environ.get("CORTADO_CORES") == "1" else time.perf_counter()


def median_seconds(work: Work, repeats: int, wait: Work = lambda: None, before: Work = lambda: None) -> float:
    """Seconds of the median of some repeats, after one that compiles kernels and one that captures graphs. ``wait``
    waits for the device; ``before`` is done before each repeat and not timed."""
    for _ in range(2):
        before()
        work()
    times = []
    for _ in range(repeats):
        before()
        wait()
        start = now()
        work()
        wait()
        times.append(now() - start)
    return median(times)


class LaunchTimer:
    """Times one launch at a time, as a step does it: in a captured graph where the launcher allows one."""

    def __init__(self, launcher: KernelLauncher, repeats: int):
        self._launcher, self._repeats = launcher, repeats

    def __call__(self, work: Callable[[], None]) -> float:
        """Median seconds of one launch. The launch is repeated, and must compute the same every time."""
        work()
        once = median_seconds(work, 1, self._wait)
        launches = max(1, min(MOST_LAUNCHES, int(BATCH / once)))

        def batch() -> None:
            for _ in range(launches):
                work()

        graph = CapturedGraph(batch, self._launcher)
        graph()
        return median_seconds(graph, self._repeats, self._wait) / launches

    def _wait(self) -> None:
        wp.synchronize_device(self._launcher.device)


def empty_launch_seconds(launcher: KernelLauncher, repeats: int) -> float:
    """Median seconds of a launch that adds one number: what every launch of a step costs at least."""
    number, total = (wp.zeros(1, dtype=wp.float32, device=launcher.device) for _ in range(2))
    return LaunchTimer(launcher, repeats)(partial(add, number, total))
