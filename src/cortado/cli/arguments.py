"""How a function becomes a command, the arguments that several commands have, and words that name a command.

What is asked of the values of arguments is checked here, before a command begins and imports what it needs.
"""

import io
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass
from functools import partial, wraps
from inspect import Parameter, signature
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tyro.conf import Positional, UseAppendAction, arg
from tyro.extras import SubcommandApp

from cortado.errors import InputError
from cortado.files.disk import LOCK
from cortado.files.terminal import keeping, quietly
from cortado.scene.scene import read_toml

if TYPE_CHECKING:
    from cortado.executors import Executor
    from cortado.runs.recording import FrameChoice

Work = Callable[[], str]
"""The work of a command once its arguments are understood; returns the text that it prints."""
Scene = Annotated[Positional[Path], arg(metavar="SCENE.toml")]
Task = Annotated[Positional[Path], arg(metavar="TASK.toml")]
Flag = Annotated[bool, arg(help_behavior_hint="")]
"""An option without a value, of which the help says no default."""
Overrides = Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="KEY=VALUE")]
Device = Annotated[str, arg(help='"cpu", or "cuda:0" for the first GPU.')]
Precision = Annotated[str, arg(help='"float32" or "float64".')]
Json = Annotated[bool, arg(help="Print JSON for machines.", help_behavior_hint="")]
Quiet = Annotated[bool, arg(help="Say nothing but results, warnings and errors.", help_behavior_hint="")]

STEPS = 200
"""Steps of a run whose length is not given."""


def command(group: SubcommandApp, answers: bool = False) -> Callable[[Callable[..., Work]], Callable[..., Work]]:
    """Return a decorator that makes a function a command of a group, with an option --quiet. At its end a command
    prints its answer, if it ``answers``, or a line about the files that it wrote."""

    def register(function: Callable[..., Work]) -> Callable[..., Work]:
        @wraps(function)
        def with_quiet(*arguments: Any, quiet: bool = False, **options: Any) -> Work:
            work = function(*arguments, **options)
            return partial(_quiet, work, answers) if quiet else work

        own = signature(function)
        option = Parameter("quiet", Parameter.KEYWORD_ONLY, default=False, annotation=Quiet)
        with_quiet.__signature__ = own.replace(parameters=[*own.parameters.values(), option])  # type: ignore[attr-defined]
        with_quiet.__annotations__ = {**function.__annotations__, "quiet": Quiet}
        del with_quiet.__wrapped__  # of which tyro would take the annotations
        group.command(with_quiet)
        return function

    return register


def _quiet(work: Work, answers: bool) -> str:
    with quietly():
        text = work()
    return text if answers else ""


@dataclass(frozen=True)
class Program:
    """A group of commands, with the name by which one runs it."""

    name: str
    app: SubcommandApp
    description: str
    overview: Callable[[], str] | None = None
    """Returns the text that it prints without arguments, if not its help."""

    def parsed(self, arguments: Sequence[str]) -> Any:
        """Return the work of the command that the arguments name; print help and exit where they ask for it or are
        misused."""
        config = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)
        return self.app.cli(prog=self.name, description=self.description, args=arguments, config=config)

    def completion_script(self, shell: str) -> str:
        """Return the completion script for a shell, as tyro prints it; bash completes names of files where nothing else
        fits."""
        box = io.StringIO()
        with redirect_stdout(box), suppress(SystemExit):
            self.parsed(["--tyro-print-completion", shell])
        return box.getvalue().rstrip("\n").replace("complete -F ", "complete -o bashdefault -o default -F ")


@dataclass(frozen=True)
class FrameOptions:
    """Which states of a run are frames of its trajectory."""

    record_every: int | None = None
    """Steps from one frame of the trajectory to the next; if left out 1, or in a sweep a 100th of all steps."""
    fps: float | None = None
    """Frames of the trajectory in a second that is simulated, not of a film; in the place of --record-every."""

    def check(self) -> None:
        """Raise `InputError` for --record-every that is too small, and where --fps is given besides."""
        if self.fps is not None and self.record_every is not None:
            raise InputError("--fps is given, but must be left out, as --record-every says which states are recorded.")
        require_at_least(1, 1 if self.record_every is None else self.record_every, "--record-every")

    def choice(self, otherwise: int = 1) -> "FrameChoice":
        """Return the choice of frames by checked options: every ``otherwise`` steps if none is given."""
        from cortado.runs.recording import EverySteps, FramesPerSecond

        return EverySteps(self.record_every or otherwise) if self.fps is None else FramesPerSecond(self.fps)


ALL_FRAMES = FrameOptions()


@dataclass(frozen=True)
class Where:
    """The options --scheduler and --workers of a command; raises `InputError` for both of them, and for more processes
    than make sense."""

    scheduler: str | None = None
    """The address of a scheduler of Dask's."""
    workers: int | None = None
    """Number of worker processes on this machine."""

    def __post_init__(self) -> None:
        if self.scheduler is not None and self.workers is not None:
            raise InputError("--scheduler and --workers are both given, but only one of them can be meant.")
        if self.workers is not None:
            from cortado.executors import require_processes

            require_processes("--workers", self.workers)

    @property
    def option(self) -> str | None:
        """Return the option that was given."""
        return "--scheduler" if self.scheduler is not None else None if self.workers is None else "--workers"

    @contextmanager
    def executor(self, device: str, items: int) -> "Iterator[Executor]":
        """Yield the executor: a Dask scheduler if one is given, workers if they are asked for, or else this process.
        Workers end with the block, and on a GPU each has one of its own. There are no more of them than ``items``,
        the computations that run at a time."""
        from cortado.executors import Distributed, InProcess, local_workers

        if self.scheduler is not None:
            with Distributed(self.scheduler) as there:
                yield there
        elif self.workers is not None:
            processes = min(self.workers, max(items, 1))
            with keeping(lambda: ""), local_workers(processes, device.partition(":")[0]) as here:
                yield here
        else:
            yield InProcess()


HERE = Where()
"""Computation in this process."""


def require_shared(out: Path, what: str) -> None:
    """Raise `InputError` where a worker process does not see a folder in which its command is at work."""
    if not (out / LOCK).exists():
        raise InputError(f"A worker does not see {out}, but {what} must be in a file system that all machines share.")


def require_at_least(least: int, value: int, option: str) -> None:
    """Raise `InputError` for a value that is smaller, with the option's name in the sentence."""
    if value < least:
        raise InputError(f"{option} is {value}, but must be at least {least}.")


def require_one_of_both(resume: bool, overwrite: bool) -> None:
    """Raise `InputError` where a command is to go on with a run and to replace it."""
    if resume and overwrite:
        raise InputError("--resume and --overwrite are both given, but only one of them can be meant.")


def steps_or_time(steps: int | None, time: float | None) -> int | None:
    """Return the number of steps, `STEPS` if neither was given; None with a time [s]. Raise `InputError` for both."""
    if time is None:
        return STEPS if steps is None else steps
    if steps is not None:
        raise InputError("--time is given, but must be left out, as --steps says how long the scene is simulated.")
    if not 0.0 < time < inf:
        raise InputError(f"--time is {time:g}, but must be a number of seconds greater than 0.")
    return None


def text_overrides(file: Path, overrides: Sequence[str]) -> list[str]:
    """Return the overrides of --set for a file as text. Raise `SceneError` for a file that cannot be read, or for
    overrides of keys that it has not: at once, as the imports of a command after that take a second."""
    words = as_text(overrides)
    read_toml(file, words)
    return words


def as_text(options: Sequence[str]) -> list[str]:
    """Return the values of --set or --only; raise `InputError` for bytes that are no text."""
    for option in options:
        try:
            option.encode()
        except UnicodeEncodeError:
            raise InputError(f"{option!r} is among the options, but must be text in UTF-8.") from None
    return list(options)


def command_line() -> list[str]:
    """Return the command as it was typed, which a run writes into its folder."""
    return ["cortado", *sys.argv[1:]]
