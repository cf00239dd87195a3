"""Where and when measurements were made."""

import os
import platform
import time
from contextlib import suppress
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from cortado import __version__

LOOK = 0.3
"""[s] for which the other processes are watched."""


def environment() -> dict[str, Any]:
    """The machine, the versions that matter, the date, and what else the machine is doing."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "cores_busy_elsewhere": _busy_cores(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "cortado": __version__,
        "warp": _version("warp-lang"),
        "numpy": _version("numpy"),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _busy_cores() -> float | None:
    """How many cores other processes keep busy while this one sleeps; None where the system does not say."""
    with suppress(OSError, ValueError):
        before = _processor_ticks()
        time.sleep(LOOK)
        total, idle = (after - first for after, first in zip(_processor_ticks(), before, strict=True))
        return round((os.cpu_count() or 1) * (1.0 - idle / total), 2) if total else None
    return None


def _processor_ticks() -> tuple[int, int]:
    """All ticks of all cores since the machine started, and those in which they had nothing to do."""
    ticks = [int(word) for word in Path("/proc/stat").read_text().splitlines()[0].split()[1:]]
    return sum(ticks[:8]), ticks[3] + ticks[4]


def _processor() -> str:
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line for line in lines if line.startswith("model name")).partition(":")[2].strip()
    return platform.processor()


def _version(package: str) -> str | None:
    with suppress(metadata.PackageNotFoundError):
        return metadata.version(package)
    return None
