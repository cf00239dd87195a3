"""What the host looks at often: copied into memory that a GPU writes to by itself."""

from typing import Any

import numpy as np
import warp as wp


class HostCopy:
    """A small array of a device as the host reads it, without allocating anything each time."""

    def __init__(self, array: wp.array):
        self._array = array
        self._copy: Any = array if array.device.is_cpu else None

    def read(self, rows: int | None = None) -> np.ndarray:
        """What the array holds, or so many of its first ``rows``, when all work that was given to the device is done;
        the next call overwrites it. Of no rows the device is not asked."""
        if rows == 0:
            return wp.empty((0, *self._array.shape[1:]), dtype=self._array.dtype, device="cpu").numpy()
        if self._copy is None:
            self._copy = wp.empty_like(self._array, device="cpu", pinned=True)
        if self._copy is not self._array:
            wp.copy(self._copy, self._array)
            wp.synchronize_stream(self._array.device)
        return self._copy.numpy()[:rows]
