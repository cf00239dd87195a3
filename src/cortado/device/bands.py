"""Launches of kernels whose threads do not need one another: on a CPU they are cut into bands, which all cores take in
turn, as Warp launches in one thread there."""

from collections.abc import Callable
from functools import partial
from typing import Any

import warp as wp

from cortado.device.cores import usable_cores
from cortado.device.launching import launch, recorded
from cortado.device.threads import MOST_CORES, in_parallel

BANDS = 8
"""Bands for each core: one may take longer than another."""
LEAST, LEAST_SHARED_OFTEN = 1_000, 50_000
"""Threads of a band, and of a launch that is cut where it is one of many that take little time each."""


class BandLauncher:
    """Launches kernels with so many threads on one device, with arguments by name (see `launch`). A kernel works on
    thread ``first + wp.tid()``."""

    def __init__(self, device: Any):
        self.device, self._compiled = device, set[Any]()

    def __call__(self, kernel: wp.Kernel, count: int, **arguments: Any) -> None:
        cores = min(usable_cores(), MOST_CORES) if self.device.is_cpu else 1
        bands = max(min(BANDS * cores, count // LEAST), 1) if cores > 1 else 1
        bounds = [count * band // bands for band in range(bands + 1)]

        def work(band: int) -> None:
            launch(kernel, bounds[band + 1] - bounds[band], self.device, first=bounds[band], **arguments)

        begin = 0
        if kernel not in self._compiled:
            work(0)
            self._compiled.add(kernel)
            begin = 1
        in_parallel(work, range(begin, bands), cores)

    def to_and_fro(
        self, kernel: wp.Kernel, rounds: int, values: wp.array, other: wp.array, **arguments: Any
    ) -> wp.array:
        """Launch a kernel with a thread for each of the ``values`` so many times: it computes ``found`` of ``values``,
        and of that the next; ``values`` and ``other`` are written to in turn. Returns that which was found last."""
        count, both = len(values), ({"values": values, "found": other}, {"values": other, "found": values})
        if self.device.is_cpu and count > LEAST_SHARED_OFTEN:
            ways: list[Callable[[], None]] = [partial(self, kernel, count, **arguments, **one) for one in both]
        else:
            ways = [recorded(kernel, count, self.device, first=0, **arguments, **one) for one in both]
        for k in range(rounds):
            ways[k % 2]()
        return other if rounds % 2 else values
