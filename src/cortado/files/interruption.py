"""Ctrl-C and SIGTERM end a command with a sentence and the exit code that shells expect, at any moment.

As long as there is nothing to keep, the process ends on the spot: an exception would come out of the import of some
library, or get lost in it. Within `keeping` it is a `KeyboardInterrupt`, so that files are closed on the way out.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
AGAIN = 0.01
"""Delay [s] before an interruption is retried that came where Python drops exceptions, as in a finaliser."""

_stderr = 2
"""Descriptor of a copy of stderr, as stderr is silenced for a while when Warp starts."""


class Interrupted(KeyboardInterrupt):
    """An exception for a signal that interrupts a command; takes its number and words on what is kept."""

    def __init__(self, number: int, kept: str = ""):
        super().__init__(number, kept)
        self.code = 128 + number
        """The exit code."""
        self.kept = kept

    def __str__(self) -> str:
        return f"Interrupted; {self.kept}." if self.kept else "Interrupted."


def leave_at_once() -> None:
    """Make signals end the process at once from now on; ignored signals stay ignored (nohup, background jobs)."""
    global _stderr
    with suppress(OSError):  # it may be closed
        _stderr = os.dup(2)
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _leave)
    sys.unraisablehook = _try_again


def finish() -> None:
    """Ignore signals from now on, as the command has ended."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def keeping(kept: Callable[[], str]) -> Iterator[None]:
    """Turn signals in the block into exceptions; ``kept`` returns the end of their sentence, on what is kept and where,
    or nothing. Of nested blocks, the innermost with a text counts."""
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
    """A delay of signals for a while. Threads and processes that begin meanwhile never get Ctrl-C, which a terminal
    sends to all of them."""

    def __init__(self) -> None:
        self._late: list[int] = []
        self._mask: set[int] | None = None
        self._handler: Any = None

    def begin(self) -> None:
        """Delay signals from now on."""
        if hasattr(signal, "pthread_sigmask"):  # not on Windows
            self._mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        if signal.getsignal(signal.SIGTERM) in (_leave, _raise):  # a process that inherited a mask could not be ended
            self._handler = signal.signal(signal.SIGTERM, lambda number, _: self._late.append(number))

    def end(self) -> None:
        """Deliver the signals that came; repeated calls do nothing."""
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
    """Delay signals in the block, to leave written files whole; threads other than the first never get them."""
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
    """Return the end of an interruption's sentence, or of one that was being handled as it came."""
    if not isinstance(stop, Interrupted):
        return ""
    return stop.kept or _first_said(None if stop.__suppress_context__ else stop.__context__)


def _leave(number: int, _: FrameType | None) -> None:
    with suppress(OSError):
        os.write(_stderr, b"Interrupted.\n")
    os._exit(128 + number)


def _raise(number: int, _: FrameType | None) -> None:
    raise Interrupted(number)


def _try_again(dropped: "sys.UnraisableHookArgs") -> None:
    if not isinstance(dropped.exc_value, Interrupted):
        sys.__unraisablehook__(dropped)
    else:
        number = dropped.exc_value.args[0]
        if not hasattr(signal, "setitimer"):  # on Windows
            _leave(number, None)
        signal.signal(signal.SIGALRM, lambda *_: _raise(number, None))
        signal.setitimer(signal.ITIMER_REAL, AGAIN)
