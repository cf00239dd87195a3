"""Messages to the user, whatever stands at the other end of stdout and stderr."""

import io
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from cortado.errors import ComputationError


def printable(text: str) -> str:
    """The text on one line, without characters that would steer a terminal: each becomes its escape, such as ``\\x1b``.

    A byte of a file name that is not UTF-8, which Python keeps as a lone surrogate, becomes that byte's escape.
    """
    return "".join(letter if letter.isprintable() else _escape(letter) for letter in text)


def say(sentence: str, end: str = "\n") -> None:
    """One line on stderr: a mistake or a warning; the beginning of one with another ``end``."""
    print(printable(sentence), end=end, file=sys.stderr, flush=True)


def note(sentence: str, end: str = "\n") -> None:
    """What is good to know, on stderr, unless `quietly`: what is being done, how far it is."""
    if not is_quiet():
        say(sentence, end)


@contextmanager
def timed_note(what: str) -> Iterator[None]:
    """One line as of `note`: what is done within, and at the end how long it took."""
    begun = time.monotonic()
    note(what, end="")
    try:
        yield
    except BaseException:
        note(".")
        raise
    note(f": {time.monotonic() - begun:.1f} s")


def is_quiet() -> bool:
    """Whether only results, warnings and errors are wanted."""
    return _Quiet.depth > 0


@contextmanager
def quietly() -> Iterator[None]:
    """Within it all threads write only results, warnings and errors."""
    _Quiet.depth += 1
    try:
        yield
    finally:
        _Quiet.depth -= 1


class _Quiet:
    """How often `quietly` was entered and not left."""

    depth = 0


def tell(result: str) -> None:
    """A result, of one line or several, on stdout."""
    with to_stdout():
        print("\n".join(map(printable, result.split("\n"))))


@contextmanager
def to_stdout() -> Iterator[None]:
    """What is printed within it arrives; else raises `ComputationError`, or `BrokenPipeError` if nobody reads it."""
    try:
        try:
            yield
        finally:  # also where the process is about to exit
            sys.stdout.flush()
    except BrokenPipeError:
        _point_nowhere(sys.stdout.fileno())
        raise
    except OSError as problem:
        _point_nowhere(sys.stdout.fileno())
        raise ComputationError(f"The result cannot be written to the standard output: {problem.strerror}.") from None


def steady_streams() -> None:
    """Make stdout and stderr of this process usable: streams that are closed go nowhere, but a
    result that is written to a closed stdout fails, characters that the terminal
    cannot show are escaped, and a stderr that nobody reads any more is no reason to stop."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            _point_nowhere(number, os.O_RDONLY if number == 1 else os.O_RDWR)
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))
    sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    stderr = os.fdopen(sys.stderr.fileno(), "wb", closefd=False)
    sys.stderr = _Steady(stderr, sys.stderr.encoding, "backslashreplace", line_buffering=True)


class _Steady(io.TextIOWrapper):
    """Goes on where the stream that it writes to is broken."""

    def write(self, text: str) -> int:
        try:
            return super().write(text)
        except OSError:
            return len(text)

    def flush(self) -> None:
        with suppress(OSError):
            super().flush()


def _point_nowhere(descriptor: int, mode: int = os.O_RDWR) -> None:
    nowhere = os.open(os.devnull, mode)  # the same number where that was free, and the lowest
    if nowhere != descriptor:
        os.dup2(nowhere, descriptor)
        os.close(nowhere)


def _escape(letter: str) -> str:
    code = ord(letter)
    return f"\\x{code - 0xDC00:02x}" if 0xDC80 <= code <= 0xDCFF else letter.encode("unicode_escape").decode()
