"""What the hardware allows: the bytes that a launch must read and write at least, over the bandwidth of a copy.

The bytes of a launch are

    sum over arrays of (entries used) (bytes of an entry),   for a sum over neighbours   + 4 (neighbours listed) + 8 n

Every array counts once, however often its entries are read, and also where it is both read and written: an entry for
each of the n particles, or fewer if it has fewer. The neighbour list counts with the indices that are listed, those of
wall particles and those that fill a list up included, and with the two lengths of each list. Positions and weights of
wall particles are left out. The floor is so a little too low rather than too high; a launch can be faster than it only
where its arrays fit in a cache, which a copy of `COPIED` bytes does not.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp

from benchmarks.bench.timing import median_seconds
from cortado.device.launching import unbundled
from cortado.device.threads import usable_cores

COPIED = 128 * 2**20
"""[bytes] that are copied to measure the bandwidth."""


def least_bytes(arguments: Sequence[Any], threads: int, particles: int, listed: int) -> int:
    """[bytes] that a launch must read and write at least, with so many neighbours in all lists together."""
    entries = max(threads, particles) if threads > 1 else 1
    arrays = {a.ptr: a for a in unbundled(arguments) if isinstance(a, wp.array)}
    total = sum(min(len(a), entries) * wp.types.type_size_in_bytes(a.dtype) for a in arrays.values())
    return total + (4 * listed + 8 * particles if sums_over_neighbours(arguments) else 0)


def sums_over_neighbours(arguments: Sequence[Any]) -> bool:
    """Whether a launch reads or writes the list of neighbours."""
    return len(arguments) > 0 and hasattr(arguments[0], "neighbours")


def copy_bandwidth(device: Any, repeats: int) -> float:
    """[bytes / s] read and written by a copy within a device's memory; on a CPU all cores copy."""
    if device.is_cpu:
        cores = usable_cores()
        source = np.ones(COPIED, dtype=np.uint8)
        target = np.zeros_like(source)
        parts = list(zip(np.array_split(target, cores), np.array_split(source, cores), strict=True))
        with ThreadPoolExecutor(cores) as pool:  # NumPy copies without holding the interpreter
            seconds = median_seconds(lambda: list(pool.map(lambda part: np.copyto(*part), parts)), repeats)
    else:
        first, second = (wp.zeros(COPIED // 4, dtype=wp.float32, device=device) for _ in range(2))
        seconds = median_seconds(lambda: wp.copy(second, first), repeats, lambda: wp.synchronize_device(device))
    return 2.0 * COPIED / seconds
