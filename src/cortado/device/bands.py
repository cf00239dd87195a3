"""Launches of kernels whose threads do not need one another: on a CPU they are cut into bands, which all cores take in
turn, as Warp launches in one thread there."""

from collections.abc import Callable
from concurrent.futures import wait
from functools import partial
from typing import Any

import warp as wp

from cortado.device.cores import usable_cores
from cortado.device.launching import launch
from cortado.device.threads import MOST_CORES, helpers

BANDS = 8
"""Bands for each core: one may take longer than another."""
LEAST_SHARED = 10_000
"""Threads of a launch that is cut."""


class BandLauncher:
    """Launches kernels with so many threads on one device, with arguments by name (see `launch`). A kernel works on
    thread ``first + wp.tid()``."""

    def __init__(self, device: Any):
        self.device, self._compiled = device, set[Any]()

    def __call__(self, kernel: wp.Kernel, count: int, **arguments: Any) -> None:
        cores = min(usable_cores(), MOST_CORES) if self.device.is_cpu else 1
        bands = BANDS * cores if cores > 1 and count > LEAST_SHARED else 1
        bounds = [count * band // bands for band in range(bands + 1)]

        def work(band: int) -> None:
            launch(kernel, bounds[band + 1] - bounds[band], self.device, first=bounds[band], **arguments)

        begin = 0
        if kernel not in self._compiled:
            work(0)
            self._compiled.add(kernel)
            begin = 1
        _shared(partial(map, work), range(begin, bands), cores)


def _shared(work: Callable[[Any], Any], items: Any, cores: int) -> None:
    """Do work for each item, on so many cores."""
    waiting = iter(items)

    def take() -> None:
        for _ in work(waiting):
            pass

    called = [helpers().submit(take) for _ in range(cores - 1)]
    try:
        take()
    finally:
        begun = [helper for helper in called if not helper.cancel()]
        wait(begun)
    for helper in begun:
        helper.result()
