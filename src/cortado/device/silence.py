"""What Warp says of itself is kept back, unless it is asked for; `cortado.device.compiling` says what is compiled.

Who sets the environment variable CORTADO_VERBOSE to 1 hears all of it: the greeting, a line for every module that is
loaded, warnings about drivers. Who sets ``warp.config.log_level`` before the first simulation is made keeps that level,
if it is another one than Warp's own.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

VARIABLE = "CORTADO_VERBOSE"


def verbose() -> bool:
    """Whether the user wants to hear Warp."""
    return os.environ.get(VARIABLE, "0") not in ("", "0")


@contextmanager
def silenced() -> Iterator[None]:
    """Warp may be started within it without a word; afterwards it only says warnings and errors.

    A level that the user has chosen is left as it is; below Warp's own, where all is wanted, so is the start.
    """
    import warp as wp

    chosen = wp.config.log_level
    if verbose() or chosen < wp.LOG_INFO:
        yield
        return
    wp.config.log_level = wp.LOG_ERROR
    try:
        with open(os.devnull, "w") as nothing, c_stderr_to(nothing.fileno()):
            yield
    finally:
        wp.config.log_level = max(chosen, wp.LOG_WARNING)


@contextmanager
def c_stderr_to(file: int) -> Iterator[None]:
    """What C code writes to stderr goes to an open file: Warp's warns there of a missing CUDA driver, and its compiler
    says there what is wrong."""
    try:
        stderr = os.dup(2)
    except OSError:  # there is none
        yield
        return
    try:
        os.dup2(file, 2)
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
