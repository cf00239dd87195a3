"""What Warp says of itself is kept back, unless it is asked for; that kernels are compiled is said in one line.

Who sets the environment variable CORTADO_VERBOSE to 1 hears all of it: the greeting, a line for every module that is
loaded, warnings about drivers. Who sets ``warp.config.log_level`` before the first simulation is made keeps that level,
if it is another one than Warp's own.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from pathlib import Path
from typing import Any

from cortado.io.terminal import say

VARIABLE = "CORTADO_VERBOSE"
BUILDERS = ("build_cpu", "build_cuda")
"""Functions of Warp that compile the file of a module, one of their first two arguments."""
OURS = "wp_cortado_"
"""How the names of folders and files of our modules begin."""


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
        with _without_c_stderr():
            yield
    finally:
        wp.config.log_level = max(chosen, wp.LOG_WARNING)


def announce_compilation() -> None:
    """From now on one line on stderr says so when the first kernel of Cortado's has to be compiled, which takes long
    enough to wonder; nothing where all of them come from the cache."""
    try:
        from warp._src import build
    except ImportError:  # Warp keeps it for itself, and may move it
        return
    for name in BUILDERS:
        function = getattr(build, name, None)
        if function is not None and not hasattr(function, "__wrapped__"):
            setattr(build, name, _announcing(function))


def _announcing(function: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(function)
    def announced(*arguments: Any, **options: Any) -> Any:
        if any(Path(str(argument)).name.startswith(OURS) for argument in arguments[:2]):
            _say_once()
        return function(*arguments, **options)

    return announced


@cache
def _say_once() -> None:
    import warp as wp

    folder = wp.config.kernel_cache_dir
    say(f"Compiling kernels for the first time, which may take half a minute; they are kept in {folder}.")


@contextmanager
def _without_c_stderr() -> Iterator[None]:
    """What C code writes to stderr goes nowhere: Warp's warns there of a missing CUDA driver."""
    try:
        stderr = os.dup(2)
    except OSError:  # there is none
        yield
        return
    nothing = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 2)
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(nothing)
