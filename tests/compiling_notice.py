"""What is said on stderr where kernels are compiled for the first time, and how programs compile them fast."""

import re

UNOPTIMISED = "import warp as wp; wp.config.optimization_level = 0\n"
"""First line of a program of which it matters what it compiles, and when, but not how fast kernels are then: compiling
takes half as long, and the numbers have the same bits."""
COMPILING = re.compile(r"Compiling (\d+ kernel modules for \w+|kernels), once on this machine(: [\d.]+ s|\.)\n")


def without_compiling(err):
    """What stderr would have if all kernels came from the cache, for tests that may be the first to need one."""
    return "".join(line for line in err.splitlines(keepends=True) if not COMPILING.fullmatch(line))
