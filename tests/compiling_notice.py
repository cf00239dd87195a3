"""What is said on stderr where kernels are compiled for the first time."""

COMPILING = "Compiling kernels for the first time, which may take half a minute; they are kept in "


def without_compiling(err):
    """What stderr would have if all kernels came from the cache, for tests that may be the first to need one."""
    return "".join(line for line in err.splitlines(keepends=True) if not line.startswith(COMPILING))
