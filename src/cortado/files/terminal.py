"""Messages on stdout and stderr, progress of long computations, and handling of signals.

Ctrl-C and SIGTERM end a command with a sentence and the exit code that shells expect. In a ``with`` block of
`keeping`, a signal raises `KeyboardInterrupt`, so that files are closed. Elsewhere the signal ends the process at once,
because a library could swallow an exception.
"""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from types import FrameType
from typing import Any, TextIO

from cortado.errors import ComputationError


def printable(text: str) -> str:
    r"""Return a text on one line. Control characters and invalid UTF-8 bytes are escaped, such as ``\x1b``."""
    return "".join(letter if letter.isprintable() else _escape(letter) for letter in text)


def say(sentence: str, end: str = "\n") -> None:
    print(printable(sentence), end=end, file=sys.stderr, flush=True)


def note(sentence: str, end: str = "\n") -> None:
    """Print a progress message on stderr, except inside `quietly`."""
    if not is_quiet():
        say(sentence, end)


@contextmanager
def timed_note(what: str) -> Iterator[None]:
    """Print ``what`` on stderr, and then the computing time of the block, except inside `quietly`."""
    begun = time.monotonic()
    note(what, end="")
    try:
        yield
    except BaseException:
        note(".")
        raise
    note(f": {time.monotonic() - begun:.1f} s")


def is_quiet() -> bool:
    return _Quiet.depth > 0


@contextmanager
def quietly() -> Iterator[None]:
    """Suppress the output of all threads, except results, warnings and errors."""
    _Quiet.depth += 1
    try:
        yield
    finally:
        _Quiet.depth -= 1


class _Quiet:
    depth = 0


def tell(result: str) -> None:
    with to_stdout():
        print("\n".join(map(printable, result.split("\n"))))


@contextmanager
def to_stdout() -> Iterator[None]:
    """A closed pipe raises `BrokenPipeError`. Any other error in printing raises `ComputationError`."""
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
    """Make stdout and stderr usable. Closed streams are replaced by the null device. Characters that the terminal lacks
    are escaped. Errors of stderr are ignored. Writing a result to a closed stdout still fails."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            _point_nowhere(number, os.O_RDONLY if number == 1 else os.O_RDWR)
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))
    sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    stderr = os.fdopen(sys.stderr.fileno(), "wb", closefd=False)
    sys.stderr = _Steady(stderr, sys.stderr.encoding, "backslashreplace", line_buffering=True)


class _Steady(io.TextIOWrapper):
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


LINE_INTERVAL = 10.0


def announce(result: str) -> None:
    if not _hidden.get() and not is_quiet():
        tell(result)


Advance = Callable[..., None]
"""A function that reports ``n`` finished steps, by default one step, with values to show such as ``loss=0.1``."""

_hidden: ContextVar[bool] = ContextVar("hidden", default=False)


@contextmanager
def untracked() -> Iterator[None]:
    token = _hidden.set(True)
    try:
        yield
    finally:
        _hidden.reset(token)


@contextmanager
def track(
    total: int, description: str, *, stream: TextIO | None = None, interval: float | None = None
) -> Iterator[Advance]:
    """Show the progress of ``total`` steps, by default on stderr. A terminal shows a bar, and other streams get a line
    every ``interval`` seconds. Example: ``with track(120, "optimise") as advance: advance(loss=loss)``."""
    stream = sys.stderr if stream is None else stream
    if _hidden.get() or is_quiet():
        yield lambda n=1, **fields: None
    elif stream.isatty():
        with _bar(total, description, stream) as advance:
            yield advance
    else:
        yield _Lines(total, description, stream, LINE_INTERVAL if interval is None else interval)


@contextmanager
def _bar(total: int, description: str, stream: TextIO) -> Iterator[Advance]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    left, values = TimeRemainingColumn(elapsed_when_finished=True), TextColumn("{task.fields[shown]}", style="dim")
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), left, values
    with Progress(*columns, console=Console(file=stream)) as progress:
        task = progress.add_task(description, total=total, shown="")

        def advance(n: int = 1, **fields: Any) -> None:
            shown: dict[str, Any] = {"shown": _text(fields)} if fields else {}
            progress.update(task, advance=n, **shown)

        yield advance


class _Lines:
    """The estimate of the remaining time ignores the time before the first report, when kernels are compiled."""

    def __init__(self, total: int, description: str, stream: TextIO, interval: float) -> None:
        self._total, self._description, self._stream, self._interval = total, description, stream, interval
        self._done = 0
        self._first: tuple[int, float] | None = None
        self._started = self._last_line = time.monotonic()

    def __call__(self, n: int = 1, **fields: Any) -> None:
        self._done += n
        now = time.monotonic()
        skipped, begun = self._first = self._first or (self._done, now)
        is_last = self._done - n < self._total <= self._done
        finished_late = is_last and now - self._started >= self._interval
        if now - self._last_line < self._interval and not finished_late:
            return
        self._last_line = now
        known = self._done <= self._total  # else there was more to do than was thought
        words = [f"{self._description} {self._done}{f'/{self._total}' if known else ''}"]
        if known and self._done > skipped:
            left = (now - begun) * (self._total - self._done) / (self._done - skipped)
            minutes, seconds = divmod(round(left), 60)
            words.append(f"{minutes // 60}:{minutes % 60:02}:{seconds:02} left")
        print(", ".join([*words, *filter(None, [_text(fields)])]), file=self._stream, flush=True)


def _text(fields: dict[str, Any]) -> str:
    words = {name: f"{value:.4g}" if isinstance(value, float) else value for name, value in fields.items()}
    return ", ".join(f"{name} {word}" for name, word in words.items())


SIGNALS = (signal.SIGINT, signal.SIGTERM)
AGAIN = 0.01
"""Delay before an interruption is raised again [s], in case Python ignored the exception."""

_stderr = 2


class Interrupted(KeyboardInterrupt):
    """The exception for a signal that interrupts a command. ``kept`` describes the results that remain."""

    def __init__(self, number: int, kept: str = ""):
        super().__init__(number, kept)
        self.code = 128 + number
        self.kept = kept

    def __str__(self) -> str:
        return f"Interrupted; {self.kept}." if self.kept else "Interrupted."


def leave_at_once() -> None:
    """End the process at once on later signals. Signals that the process ignores remain ignored, as with nohup."""
    global _stderr
    with suppress(OSError):  # it may be closed
        _stderr = os.dup(2)
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _leave)
    sys.unraisablehook = _try_again


def finish() -> None:
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def keeping(kept: Callable[[], str]) -> Iterator[None]:
    """Turn signals into exceptions during the ``with`` block. ``kept`` returns the last part of the exception's
    message, such as the names of saved files. In nested blocks the innermost text that is not empty is used."""
    ours = [number for number in SIGNALS if signal.getsignal(number) is _leave]
    for number in ours:
        signal.signal(number, _raise)
    try:
        yield
    except Interrupted as stop:
        raise Interrupted(stop.args[0], _first_said(stop) or kept()) from None
    except KeyboardInterrupt:
        raise Interrupted(signal.SIGINT, kept()) from None
    finally:
        for number in ours:
            signal.signal(number, _leave)


class Hold:
    """Threads and processes that start while signals are delayed never receive the Ctrl-C of a terminal."""

    def __init__(self) -> None:
        self._late: list[int] = []
        self._mask: set[int] | None = None
        self._handler: Any = None

    def begin(self) -> None:
        if hasattr(signal, "pthread_sigmask"):  # not on Windows
            self._mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        if signal.getsignal(signal.SIGTERM) in (_leave, _raise):  # a process that inherited a mask could not be ended
            self._handler = signal.signal(signal.SIGTERM, lambda number, _: self._late.append(number))

    def end(self) -> None:
        if self._handler is not None:
            signal.signal(signal.SIGTERM, self._handler)
            self._handler = None
        if self._mask is not None:
            mask, self._mask = self._mask, None
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        while self._late:
            os.kill(os.getpid(), self._late.pop())


@contextmanager
def held() -> Iterator[None]:
    """Delay signals during the ``with`` block, so that files are written completely."""
    late, before = list[int](), dict[int, Any]()
    if threading.current_thread() is threading.main_thread():
        heard = [number for number in SIGNALS if callable(signal.getsignal(number))]
        before = {number: signal.signal(number, lambda number, _: late.append(number)) for number in heard}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in late:
            signal.raise_signal(number)


def _first_said(stop: BaseException | None) -> str:
    if not isinstance(stop, Interrupted):
        return ""
    return stop.kept or _first_said(None if stop.__suppress_context__ else stop.__context__)


def _leave(number: int, _: FrameType | None) -> None:
    with suppress(OSError):
        os.write(_stderr, b"Interrupted.\n")
    os._exit(128 + number)


def _raise(number: int, _: FrameType | None) -> None:
    raise Interrupted(number)


def _try_again(dropped: sys.UnraisableHookArgs) -> None:
    if not isinstance(dropped.exc_value, Interrupted):
        sys.__unraisablehook__(dropped)
    else:
        number = dropped.exc_value.args[0]
        if not hasattr(signal, "setitimer"):  # on Windows
            _leave(number, None)
        signal.signal(signal.SIGALRM, lambda *_: _raise(number, None))
        signal.setitimer(signal.ITIMER_REAL, AGAIN)
