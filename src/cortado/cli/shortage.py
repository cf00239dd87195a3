"""What to say where the computer, or a limit set to the process, has no more memory, open files or threads to give."""

import os
from collections.abc import Iterator
from errno import EMFILE, ENFILE, ENOMEM

_MEMORY = (os.strerror(ENOMEM), "failed to map segment")
_FILES = (os.strerror(EMFILE), os.strerror(ENFILE))
_THREADS = ("can't start new thread",)
"""Told by their words: an error of the dynamic linker is an `ImportError`, or an `OSError` without a number."""


def shortage(error: BaseException) -> str | None:
    """A sentence for an error that came of a shortage, directly or as the cause of another; None for any other."""
    for cause in _causes(error):
        if isinstance(cause, MemoryError) or _says(cause, _MEMORY):
            what = f" ({cause})" if str(cause) else ""
            return f"Memory ran out{what}; take a larger spacing, or record fewer frames with --record-every."
        if _says(cause, _FILES):
            return f"Too many files are open ({cause}); allow this process more of them (ulimit -n 1024)."
        if _says(cause, _THREADS):
            return "No more threads can be started; allow this process more of them (ulimit -u) or more memory."
    return None


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """The error, what it came of, what that came of, and so on."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _says(error: BaseException, words: tuple[str, ...]) -> bool:
    return isinstance(error, OSError | ImportError | RuntimeError) and any(word in str(error) for word in words)
