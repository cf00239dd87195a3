"""What is said on stderr where kernels are compiled for the first time."""

import re

COMPILING = re.compile(r"Compiling (\d+ kernel modules for \w+|kernels), once on this machine(: [\d.]+ s|\.)\n")


def without_compiling(err):
    """What stderr would have if all kernels came from the cache, for tests that may be the first to need one."""
    return "".join(line for line in err.splitlines(keepends=True) if not COMPILING.fullmatch(line))
