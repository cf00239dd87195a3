"""Tests that may be skipped where everything that a package can bring is installed, as `.ci/run` does.

With the environment variable `CORTADO_REQUIRE_ALL=1` a run of pytest fails if it skips a test for a reason that is not
in `INCURABLE`, or more of them than stand there.
"""

from collections import Counter
from collections.abc import Iterable

INCURABLE = {
    "there is no CUDA device": None,
    "root may write anywhere": 2,
    "its kernels here are those of space": 8,
    "LagrangeBench has no Python of its own": 2,
}
"""Reasons that no package beside Cortado can cure, and how many tests have them at most. Any number may want a GPU."""


def complaints(reasons: Iterable[str]) -> list[str]:
    """One sentence for each reason that no run with all packages may have, or may have so often."""
    found = []
    for reason, number in Counter(reasons).items():
        most = INCURABLE.get(reason, 0)
        if most is not None and number > most:
            found.append(f"{number} skipped, at most {most} may be: {reason}")
    return found


def reason_of(report) -> str:
    """The reason that a skipped test gave. `report` is a report of pytest of a test or of a file."""
    return report.longrepr[2].removeprefix("Skipped: ")
