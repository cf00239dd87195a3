"""How far a long computation is: a bar with the time left, or now and then a line where no terminal is; and what is
known before it ends."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Protocol, TextIO

from cortado.files.terminal import is_quiet, tell

LINE_INTERVAL = 10.0
"""[s] between two lines when the stream is no terminal."""


def announce(result: str) -> None:
    """What is known while work goes on, on stdout; not where progress is not shown."""
    if not _hidden.get() and not is_quiet():
        tell(result)


class Advance(Protocol):
    """Reports `n` more steps done, with the latest values of anything worth seeing (loss=0.1)."""

    def __call__(self, n: int = 1, **fields: Any) -> None: ...


_hidden: ContextVar[bool] = ContextVar("hidden", default=False)


@contextmanager
def untracked() -> Iterator[None]:
    """Nothing that is computed within it, in this thread, shows its progress: it is a part of something larger."""
    token = _hidden.set(True)
    try:
        yield
    finally:
        _hidden.reset(token)


@contextmanager
def track(
    total: int, description: str, *, stream: TextIO | None = None, interval: float | None = None
) -> Iterator[Advance]:
    """Shows the progress of `total` steps on a stream, stderr when none is given; where that is no terminal, by a line
    every `interval` seconds, `LINE_INTERVAL` when none is given.

    Use:
        with track(120, "optimise") as advance:
            for loss in ...:
                advance(loss=loss)
    """
    stream = sys.stderr if stream is None else stream
    if _hidden.get() or is_quiet():
        yield _nothing
    elif stream.isatty():
        with _bar(total, description, stream) as advance:
            yield advance
    else:
        yield _Lines(total, description, stream, LINE_INTERVAL if interval is None else interval)


@contextmanager
def _bar(total: int, description: str, stream: TextIO) -> Iterator[Advance]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        TextColumn("{task.fields[shown]}", style="dim"),
    )
    with Progress(*columns, console=Console(file=stream)) as progress:
        task = progress.add_task(description, total=total, shown="")

        def advance(n: int = 1, **fields: Any) -> None:
            if fields:
                progress.update(task, shown=_text(fields))
            progress.advance(task, n)

        yield advance


def _nothing(n: int = 1, **fields: Any) -> None:
    pass


class _Lines:
    """Writes at most one line every `interval` seconds, and one for the last step. The time left follows from the steps
    after the first report, before which kernels are compiled, or what an earlier process has done is skipped."""

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
        words = [f"{self._description} {self._done}/{self._total}" if known else f"{self._description} {self._done}"]
        if known and self._done > skipped:
            left = (now - begun) * (self._total - self._done) / (self._done - skipped)
            words.append(f"{_clock(left)} left")
        print(", ".join([*words, *filter(None, [_text(fields)])]), file=self._stream, flush=True)


def _text(fields: dict[str, Any]) -> str:
    """Fields as words: loss 0.1235, step 7."""
    words = {name: f"{value:.4g}" if isinstance(value, float) else value for name, value in fields.items()}
    return ", ".join(f"{name} {word}" for name, word in words.items())


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"
