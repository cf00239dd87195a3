"""The number of cores that this process may use."""

import os

from cortado.errors import InputError, shown

VARIABLE = "CORTADO_CORES"
"""The environment variable that limits it, for processes that share a machine."""


def usable_cores() -> int:
    """The cores of this process where the system tells them, and those of the machine elsewhere; no more than the
    environment variable CORTADO_CORES says. Raises `InputError` where that is no number of cores."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get(VARIABLE, "").strip()
    if not limit:
        return there
    if not limit.isdecimal() or int(limit) < 1:
        raise InputError(f"The environment variable {VARIABLE} is {shown(limit)}, but must be a number of cores.")
    return min(int(limit), there)
