"""Where and when measurements were made."""

import os
import platform
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from cortado.device.threads import usable_cores
from cortado.version import __version__


def environment() -> dict[str, Any]:
    """The machine, the versions that matter, and the date."""
    return {
        "processor": _processor(),
        "cores": usable_cores(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "cortado": __version__,
        "commit": _commit(),
        "warp": _version("warp-lang"),
        "numpy": _version("numpy"),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


class OtherProcesses:
    """Watches how many cores the other processes of the machine keep busy, from when it is made."""

    def __init__(self, own_seconds: Callable[[], float] = time.process_time):
        """``own_seconds``: processor time [s] that is not others'."""
        self._own_seconds = own_seconds
        self._before = self._now()

    def busy_cores(self) -> float | None:
        """On average since then; None where the system does not say. The machine counts in hundredths of a second."""
        now = self._now()
        if now is None or self._before is None:
            return None
        wall, busy, own = (after - before for after, before in zip(now, self._before, strict=True))
        return round(max(busy - own, 0.0) / wall, 2)

    def _now(self) -> tuple[float, float, float] | None:
        """Wall time, the time that all cores of the machine were busy, and our own part of it [s]."""
        with suppress(OSError, ValueError):
            ticks = [int(word) for word in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
            busy = (sum(ticks) - ticks[3] - ticks[4]) / os.sysconf("SC_CLK_TCK")  # but for idle and waiting for disks
            return time.perf_counter(), busy, self._own_seconds()
        return None


def _processor() -> str:
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line for line in lines if line.startswith("model name")).partition(":")[2].strip()
    return platform.processor()


def _commit() -> str | None:
    """The commit of this clone; None where Git does not say."""
    with suppress(OSError, subprocess.CalledProcessError):
        command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short=8", "HEAD"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    return None


def _version(package: str) -> str | None:
    with suppress(metadata.PackageNotFoundError):
        return metadata.version(package)
    return None
