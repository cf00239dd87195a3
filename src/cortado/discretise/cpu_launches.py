"""Launches of kernels of the discretisation, which works on the CPU whatever device a simulation is on, with arrays of
NumPy's."""

from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray


def started() -> None:
    """Start Warp, which modules of kernels need."""
    from cortado.device.warp_start import start_warp

    start_warp()


@cache
def _launchers() -> tuple[Any, Any]:
    """What launches kernels in one thread, and what cuts them into bands for all cores."""
    started()
    import warp as wp

    from cortado.device.launching import BandLauncher, launch

    cpu = wp.get_device("cpu")
    return partial(launch, device=cpu), BandLauncher(cpu)


def launched(kernel: Any, threads: int, **arguments: Any) -> None:
    """Launch a kernel in one thread, with arguments by name; it writes to arrays that it takes."""
    _perform(0, kernel, threads, arguments)


def launched_in_bands(kernel: Any, threads: int, **arguments: Any) -> None:
    """The same in bands (`cortado.device.launching`): no two threads of the kernel may write to one place."""
    _perform(1, kernel, threads, arguments)


def _perform(which: int, kernel: Any, threads: int, arguments: dict[str, Any]) -> None:
    from cortado.device.threads import WARP

    if threads:
        with WARP:
            given = {name: shared(x) if isinstance(x, np.ndarray) else x for name, x in arguments.items()}
            _launchers()[which](kernel, threads, **given)


def shared(values: NDArray[Any], dtype: Any = None) -> Any:
    """An array of Warp's in the memory of one of NumPy's; what has more than one axis is vectors along the last one."""
    import warp as wp

    types = {"float64": (wp.float64, wp.vec3d), "int32": (wp.int32, wp.vec3i), "bool": (wp.bool, None)}
    found = dtype or types[values.dtype.name][values.ndim > 1]
    return wp.array(values, dtype=found, device="cpu", copy=False)
