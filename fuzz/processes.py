"""Runs one command in a process of its own, watches its time and its memory, and tells how it ended.

Importing Cortado and starting Warp takes seconds. `by_fork` therefore forks a process that has done both, but has not
launched a kernel, and calls the command line there; `by_console` starts the real command.
"""

import faulthandler
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

POLL = 0.01
"""[s] between two looks at a process."""
LONGEST_OUTPUT = 200_000
"""Bytes of an output that are kept."""
PATIENCE = 4.0
"""How many times the limit a process may take that computes on a busy machine, and has not used the limit itself."""


@dataclass(frozen=True)
class Limits:
    """What a command may take."""

    seconds: float = 20.0
    """Of computing, or of waiting for something that does not come."""
    memory: int = 2_000_000_000
    """Bytes that it holds at once, beyond those that it was forked with."""


LIMITS = Limits()
"""Of every command that is given no others."""


@dataclass(frozen=True)
class Kill:
    """A signal that is sent to a command."""

    after: float
    """[s]"""
    number: int = signal.SIGKILL


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    arguments: tuple[str, ...]
    code: int
    """Its exit code, or minus the signal that it died of."""
    out: str
    err: str
    seconds: float
    computed: float
    """[s] of computing, with that of processes which it started."""
    memory: int
    """The most bytes that it held."""
    hung: bool = False
    """Whether it was ended because it took too long."""
    swollen: bool = False
    """Whether it was ended because it held too much memory."""
    stack: str = ""
    """Where it was when it had taken too long, if that is known."""


def by_fork(arguments: Sequence[str], folder: Path, limits: Limits = LIMITS, kill: Kill | None = None) -> Outcome:
    """Run ``cortado`` with these arguments in a fork of this process, with the folder as working directory."""

    def command() -> None:
        from cortado.__main__ import main

        sys.argv = ["cortado", *arguments]
        main()

    return call(command, tuple(arguments), folder, limits, kill)


def call(
    function: Callable[[], None],
    arguments: tuple[str, ...],
    folder: Path,
    limits: Limits = LIMITS,
    kill: Kill | None = None,
) -> Outcome:
    """Call a function in a fork of this process as if it were a program; the arguments are for the record."""
    out, err, stack = (_file(folder, name) for name in ("out", "err", "stack"))
    sys.stdout.flush()
    sys.stderr.flush()
    shared, child = _anonymous(os.getpid()), os.fork()
    if child == 0:
        _be_program(function, folder, out, err, stack)
    return _watched(child, arguments, (out, err, stack), limits, kill, shared)


def by_console(
    command: Sequence[str | bytes],
    folder: Path,
    environment: Mapping[str, str] | None = None,
    limits: Limits = LIMITS,
    kill: Kill | None = None,
    **options: object,
) -> Outcome:
    """Run a program, such as `CONSOLE` and its arguments; the options are those of `subprocess.Popen`."""
    out, err, stack = (_file(folder, name) for name in ("out", "err", "stack"))
    with open(out, "wb") as out_file, open(err, "wb") as err_file:
        given = {"stdin": subprocess.DEVNULL, "stdout": out_file, "stderr": err_file, "cwd": folder, **options}
        process = subprocess.Popen(command, env=environment, start_new_session=True, **given)  # type: ignore[call-overload]
    arguments = tuple(os.fsdecode(word) for word in command)
    outcome = _watched(process.pid, arguments, (out, err, stack), limits, kill)
    process.returncode = outcome.code  # it has been waited for
    return outcome


def console() -> list[str]:
    """The command line as a program of its own."""
    return [sys.executable, "-m", "cortado"]


def _file(folder: Path, name: str) -> Path:
    """A file for the next output of that name in a folder."""
    number = 1
    while (path := folder / f"{number}.{name}").exists():
        number += 1
    path.touch()
    return path


def _be_program(function: Callable[[], None], folder: Path, out: Path, err: Path, stack: Path) -> None:
    """What the forked process does until its end; it never returns."""
    code = 70
    try:
        os.setsid()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        for path, descriptor in ((os.devnull, 0), (out, 1), (err, 2)):
            os.dup2(os.open(path, os.O_RDWR), descriptor)
        sys.stdout, sys.stderr = (os.fdopen(k, "w", closefd=False, errors="backslashreplace") for k in (1, 2))
        faulthandler.disable()
        faulthandler.register(signal.SIGUSR1, open(stack, "w"), all_threads=True)  # noqa: SIM115 until the end
        os.chdir(folder)
        code = _exit_code(function)
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def _exit_code(function: Callable[[], None]) -> int:
    """What Python makes of the end of a program."""
    try:
        function()
    except SystemExit as end:
        if end.code is None or isinstance(end.code, int):
            return end.code or 0
        print(end.code, file=sys.stderr)
        return 1
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def _watched(
    child: int,
    arguments: tuple[str, ...],
    files: tuple[Path, Path, Path],
    limits: Limits,
    kill: Kill | None,
    shared: int = 0,
) -> Outcome:
    """Wait for the end of a process, and bring it about where it takes too much; ``shared``: bytes that it was forked
    with, which do not count."""
    started = time.monotonic()
    hung = swollen = sent = False
    try:
        while True:
            ended, status, usage = os.wait4(child, os.WNOHANG)
            seconds = time.monotonic() - started
            if ended:
                break
            if kill is not None and not sent and seconds >= kill.after:
                sent = _signal_group(child, kill.number)
            elif not (hung or swollen):
                hung = _is_hung(child, seconds, limits.seconds)
                swollen = _resident(child) - shared > limits.memory
                if hung or swollen:
                    _end(child)
            time.sleep(POLL)
    finally:
        _signal_group(child, signal.SIGKILL)  # and whatever it has left behind
    out, err, stack = (_read(path) for path in files)
    code = os.waitstatus_to_exitcode(status)
    computed, memory = usage.ru_utime + usage.ru_stime, max(1024 * usage.ru_maxrss - shared, 0)
    return Outcome(arguments, code, out, err, seconds, computed, memory, hung, swollen, stack if hung else "")


def _is_hung(child: int, seconds: float, limit: float) -> bool:
    """Whether a process has computed for longer than the limit, or has mostly waited for that long."""
    if seconds < limit:
        return False
    used = _processor_seconds(child)
    return used >= limit or used + _queued_seconds(child) < 0.25 * seconds or seconds >= PATIENCE * limit


def _processor_seconds(child: int) -> float:
    """[s] of computing, of a process and of all that it has started in its session."""
    ticks = 0
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            fields = path.read_text().rpartition(")")[2].split()
            ticks += (int(fields[11]) + int(fields[12])) * (int(fields[3]) == child)
    return ticks / os.sysconf("SC_CLK_TCK")


def _queued_seconds(child: int) -> float:
    """[s] for which a process could have computed, but others did."""
    with suppress(OSError):
        return 1e-9 * int(Path(f"/proc/{child}/schedstat").read_text().split()[1])
    return 0.0


def _resident(process: int) -> int:
    """Bytes that a process holds."""
    return _pages(process)[0]


def _anonymous(process: int) -> int:
    """Those that are of no file, with which a fork begins."""
    resident, of_files = _pages(process)
    return resident - of_files


def _pages(process: int) -> tuple[int, int]:
    """Bytes that a process holds, and those of them that are of files."""
    with suppress(OSError):
        fields = Path(f"/proc/{process}/statm").read_text().split()
        size = os.sysconf("SC_PAGE_SIZE")
        return int(fields[1]) * size, int(fields[2]) * size
    return 0, 0


def _end(child: int) -> None:
    """Let a forked process note where it is, and kill it."""
    with suppress(OSError, IndexError):
        handled = int(Path(f"/proc/{child}/status").read_text().split("SigCgt:")[1].split()[0], 16)
        if handled >> (signal.SIGUSR1 - 1) & 1:
            os.kill(child, signal.SIGUSR1)
            time.sleep(0.1)
    _signal_group(child, signal.SIGKILL)


def _signal_group(child: int, number: int) -> bool:
    """Whether there was a group to signal: a fork begins its own a moment after its start."""
    try:
        os.killpg(child, number)
    except ProcessLookupError:
        return False
    return True


def _read(path: Path) -> str:
    with open(path, "rb") as file:
        text = file.read(LONGEST_OUTPUT).decode("utf-8", "backslashreplace")
    if not text:
        path.unlink()
    return text
