"""Numbers of what is marked, in their order, found on the device."""

import warp as wp

from cortado.device.bands import BandLauncher
from cortado.device.modules import kernel_module


@wp.kernel(module=kernel_module("marked"), enable_backward=False)
def list_marked(
    first: wp.int32,
    marks: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
    numbers: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    if marks[i] > 0:
        numbers[counts[i] - 1] = i


def marked(marks: wp.array, launch: BandLauncher) -> tuple[wp.array, wp.array]:
    """The numbers of those of (n,) marks that are 1 and not 0, and how many of them there are up to each, (n,)."""
    counts = wp.empty_like(marks)
    wp.utils.array_scan(marks, counts)
    numbers = wp.empty(last_of(counts), dtype=wp.int32, device=marks.device)
    launch(list_marked, len(marks), marks=marks, counts=counts, numbers=numbers)
    return numbers, counts


def last_of(numbers: wp.array) -> int:
    """The last of whole numbers (n,) on a device."""
    return int(numbers[len(numbers) - 1 :].numpy()[0])
