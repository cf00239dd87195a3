"""Devices by their names; and the CUDA driver: which one there is, and what to say where it is too old for Warp, which
then finds no GPU."""

import ctypes
import os
import sys
from contextlib import suppress
from typing import Any

import warp as wp

from cortado.device.kernel_cache import start_warp
from cortado.errors import InputError, shown

Version = tuple[int, int]
VISIBLE = "CUDA_VISIBLE_DEVICES"
"""The environment variable that says which GPUs a process has."""
PLACE = "https://nvidia.github.io/warp/stable/user_guide/installation.html"


def why_no_gpu() -> str:
    """Why Warp, which has started, finds no GPU, in words."""
    needed, found = _needed(), installed_driver()
    if needed is None or found is None or found >= needed:
        return "no GPU with a CUDA driver is found"
    return (
        f"the CUDA driver is too old, as it supports CUDA {_shown(found)} and Warp needs {_shown(needed)}: install a "
        f"newer driver of NVIDIA's, or see {PLACE}"
    )


def installed_driver() -> Version | None:
    """The version of CUDA that the driver of this machine supports; None where there is none."""
    with suppress(OSError, AttributeError):
        library = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
        version = ctypes.c_int()
        if library.cuDriverGetVersion(ctypes.byref(version)) == 0 and version.value > 0:
            return version.value // 1000, version.value % 1000 // 10
    return None


def _needed() -> Version | None:
    """The version that Warp needs; None where it does not say, or was built without CUDA."""
    with suppress(ImportError, AttributeError):  # Warp keeps it for itself, and may move it
        from warp._src.context import runtime

        return runtime.min_driver_version
    return None


def _shown(version: Version) -> str:
    return f"{version[0]}.{version[1]}"


def device_named(name: str) -> Any:
    """Warp's device of that name; raises `InputError` where there is none."""
    found = ", ".join(str(device) for device in wp.get_devices())
    none = "" if wp.get_cuda_device_count() else f"; {why_no_gpu()}"
    if not isinstance(name, str):
        raise InputError(f"device is {shown(name)}, but must be one of: {found}{none}.")
    try:
        if name == "cuda" and none:
            raise ValueError  # Warp itself would write on stderr
        return wp.get_device(name)
    except (RuntimeError, ValueError) as error:
        raise InputError(f"device is {shown(name)}, but must be one of: {found}{none}.") from error


def visible_gpus() -> list[str]:
    """The GPUs that this process may use, as CUDA names them."""
    start_warp()
    given = [name.strip() for name in os.environ.get(VISIBLE, "").split(",") if name.strip()]
    present = wp.get_cuda_device_count()
    return given[:present] if given else [str(k) for k in range(present)]
