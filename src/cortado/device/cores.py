"""The number of cores that this process may use."""

import os


def usable_cores() -> int:
    """The cores of this process where the system tells them, and those of the machine elsewhere."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
