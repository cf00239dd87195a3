"""Estimates of the memory of a computation, and how much is free, for a sentence before it is allocated.

They count particles with their neighbour lists, wall particles, tables and records of every step, the frames that a
report reads back, and in a renderer nodes, pixels and samples. The bytes of each were measured, and hold to a factor of
about 1.5. Checkpoints are not counted, as a rollout keeps no more of them than there is room for.
"""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

from cortado.errors import InputError

_PARTICLE, _WALL, _STEP, _FRAME, _PIXEL = 56.0, 110.0, 50.0, 150.0, 110.0
"""[bytes]"""
_WEIGHING = 1600.0
"""Bytes of a wall particle while its weight is computed."""
_REALS_OF_PARTICLE, _REALS_OF_WALL, _REALS_OF_STEP, _REALS_OF_PIXEL = 90.0, 12.0, 8.0, 12.0
_REALS_BACKWARD, _REALS_OF_ITERATION = 40.0, 8.0
"""[numbers]"""
_CGROUP = Path("/sys/fs/cgroup")
_LIMITS = (("memory.max", "memory.current"), ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"))


def sampling_parts(particles: float, walls: float) -> dict[str, float]:
    """Return the memory [bytes] for cutting a scene into particles, by a phrase for each part."""
    of_walls = (_WALL + _WEIGHING) * walls
    return {f"{particles:.3g} particles of fluid": 100.0 * particles, f"{walls:.3g} wall particles": of_walls}


def simulation_parts(particles: int, walls: int, neighbours: int, real: int) -> dict[str, float]:
    """Return the memory [bytes] of a simulation, given the length of neighbour lists and the bytes of a number."""
    return {
        f"{particles:.3g} particles of fluid": particles * (_PARTICLE + 4.0 * neighbours + _REALS_OF_PARTICLE * real),
        f"{walls:.3g} wall particles": walls * (_WALL + _REALS_OF_WALL * real),
    }


def step_parts(steps: int, real: int) -> dict[str, float]:
    """Return the memory [bytes] of the tables and records of a run's steps."""
    return {f"what is kept of {steps:.3g} steps": steps * (_STEP + _REALS_OF_STEP * real)}


def frame_parts(frames: int, numbers: int, real: int) -> dict[str, float]:
    """Return the memory [bytes] of ``frames`` frames with ``numbers`` numbers each."""
    return {f"{frames:.3g} frames": frames * (_FRAME + float(numbers) * real)}


def gradient_parts(particles: int, iterations: int, real: int) -> dict[str, float]:
    """Return the memory [bytes] of a gradient, given the pressure iterations of a step."""
    return {
        f"the gradient of {particles:.3g} particles": particles
        * real
        * (_REALS_BACKWARD + _REALS_OF_ITERATION * iterations)
    }


def field_parts(nodes: float, real: int) -> dict[str, float]:
    """Return the memory [bytes] of a colour field, or of its adjoint."""
    return {f"{nodes:.3g} nodes of the field of colours": 4.0 * nodes * real}


def picture_parts(pixels: int, real: int) -> dict[str, float]:
    """Return the memory [bytes] of a picture, and of showing it in a report."""
    return {f"{pixels:.3g} pixels": pixels * (_PIXEL + _REALS_OF_PIXEL * real)}


def sample_parts(samples: int, pixels: int, real: int) -> dict[str, float]:
    """Return the memory [bytes] of the adjoints of all samples along the rays of all pixels."""
    return {f"{samples} samples behind each of {pixels:.3g} pixels": 4.0 * samples * pixels * real}


def require(parts: Mapping[str, float], advice: str, device: Any = None) -> None:
    """Raise `InputError` if memory [bytes], by its purpose, exceeds the free memory; ``device`` is Warp's."""
    lack = shortage(parts, device)
    if lack:
        raise InputError(f"This needs {lack}; {advice}.")


def shortage(parts: Mapping[str, float], device: Any = None) -> str:
    """Return the needed and the free memory in words; empty if it suffices."""
    needed, free = sum(parts.values()), available(device)
    if needed <= free:
        return ""
    most = max(parts, key=lambda name: parts[name])
    where = "" if device is None or device.is_cpu else f" on {device}"
    return f"about {_gb(needed)} of memory, most of it for {most}, but only {_gb(free)} are free{where}"


def within(budget: float, device: Any = None) -> int:
    """Return a memory budget [bytes] for data that can be recomputed: at most half of the free memory."""
    return int(min(budget, 0.5 * available(device)))


def available(device: Any = None) -> float:
    """Return the free memory [bytes] of a Warp device, or of this process on a CPU; infinite where unknown."""
    if device is not None and not device.is_cpu:
        return float(device.free_memory)
    return max(min(float(psutil.virtual_memory().available), _of_container(), _of_process()), 0.0)


def _of_container() -> float:
    """Return the control group's memory limit less its use [bytes], with cached files as free; infinite without one."""
    for limit, used in _LIMITS:
        with suppress(OSError, ValueError):
            stat = (_CGROUP / used).with_name("memory.stat").read_text().split()
            cached = int(stat[stat.index("inactive_file") + 1])
            return float((_CGROUP / limit).read_text()) - float((_CGROUP / used).read_text()) + cached
    return float("inf")


def _of_process() -> float:
    """Return the limit of the address space (``ulimit -v``) less its use [bytes]; infinite without one."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            return float(limit - psutil.Process().memory_info().vms)
    return float("inf")


def _gb(size: float) -> str:
    return f"{size / 1e9:.3g} GB"
