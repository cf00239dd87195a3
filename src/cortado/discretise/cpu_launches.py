"""Launches of kernels with NumPy arrays on the CPU, where scenes are discretised whatever device a simulation is on."""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray


@cache
def _in_bands() -> Any:
    import warp as wp

    from cortado.device.launching import BandLauncher

    return BandLauncher(wp.get_device("cpu"))


def launch_on_cpu(kernel: Any, threads: int, in_bands: bool = True, **arguments: Any) -> None:
    """Launch a kernel with arguments by name; it writes to the NumPy arrays that it is given. All cores take it in
    bands (`cortado.device.launching`), where no two threads may write to one place, or otherwise one thread takes
    it."""
    from cortado.device.launching import launch
    from cortado.device.threads import WARP

    if threads:
        with WARP:
            given = {name: shared(x) if isinstance(x, np.ndarray) else x for name, x in arguments.items()}
            if in_bands:
                _in_bands()(kernel, threads, **given)
            else:
                launch(kernel, threads, _in_bands().device, **given)


def shared(values: NDArray[Any], dtype: Any = None) -> Any:
    """A Warp array in the memory of a NumPy array; one of more than one axis has vectors along the last one."""
    import warp as wp

    types = {"float64": (wp.float64, wp.vec3d), "int32": (wp.int32, wp.vec3i), "bool": (wp.bool, None)}
    found = dtype or types[values.dtype.name][values.ndim > 1]
    return wp.array(values, dtype=found, device="cpu", copy=False)
