"""Turn functions into commands, and define arguments that several commands share."""

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
Scene = Annotated[Positional[Path], arg(metavar="SCENE.toml")]
Task = Annotated[Positional[Path], arg(metavar="TASK.toml")]
Flag = Annotated[bool, arg(help_behavior_hint="")]
"""A command-line option without a value."""
Overrides = Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="KEY=VALUE")]
Device = Annotated[str, arg(help='"cpu", or "cuda:0" for the first GPU.')]
Precision = Annotated[str, arg(help='"float32" or "float64".')]
Json = Annotated[bool, arg(help="Print JSON for machines.", help_behavior_hint="")]
Quiet = Annotated[bool, arg(help="Say nothing but results, warnings and errors.", help_behavior_hint="")]
STEPS = 200
"""Number of steps of a run if the user gives neither a number of steps nor a time."""


def command(group: SubcommandApp, answers: bool = False) -> Callable[[Callable[..., Work]], Callable[..., Work]]:
    """The option --quiet hides the returned text, unless ``answers`` is true."""

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
    name: str
    app: SubcommandApp
    description: str
    overview: Callable[[], str] | None = None
    """Function that returns the text to print without arguments, or None to print the help."""

    def parsed(self, arguments: Sequence[str]) -> Any:
        """Parse the arguments and return the function that runs the command. Exit after printing help or an error."""
        config = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)
        return self.app.cli(prog=self.name, description=self.description, args=arguments, config=config)

    def completion_script(self, shell: str) -> str:
        box = io.StringIO()
        with redirect_stdout(box), suppress(SystemExit):
            self.parsed(["--tyro-print-completion", shell])
        return box.getvalue().rstrip("\n").replace("complete -F ", "complete -o bashdefault -o default -F ")


@dataclass(frozen=True)
class FrameOptions:
    """Options that choose which states of a run are recorded."""

    record_every: int | None = None
    """Steps from one recorded frame to the next; 1 by default, and in a sweep a 100th of all steps."""
    fps: float | None = None
    """Recorded frames per simulated second, instead of --record-every; films have a separate setting."""

    def check(self) -> None:
        if self.fps is not None and self.record_every is not None:
            raise InputError("--fps is given, but must be left out, as --record-every selects the recorded states.")
        require_at_least(1, 1 if self.record_every is None else self.record_every, "--record-every")

    def choice(self, otherwise: int = 1) -> "FrameChoice":
        """Without options, every ``otherwise``-th step is recorded."""
        from cortado.runs.recording import EverySteps, FramesPerSecond

        return EverySteps(self.record_every or otherwise) if self.fps is None else FramesPerSecond(self.fps)


ALL_FRAMES = FrameOptions()


@dataclass(frozen=True)
class Where:
    scheduler: str | None = None
    workers: int | None = None

    def __post_init__(self) -> None:
        if self.scheduler is not None and self.workers is not None:
            raise InputError("--scheduler and --workers are both given, but exclude each other: leave one out.")
        if self.workers is not None:
            from cortado.executors import require_processes

            require_processes("--workers", self.workers)

    @property
    def option(self) -> str | None:
        return "--scheduler" if self.scheduler is not None else None if self.workers is None else "--workers"

    @contextmanager
    def executor(self, device: str, items: int) -> "Iterator[Executor]":
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


def require_shared(out: Path, what: str) -> None:
    if not (out / LOCK).exists():
        raise InputError(f"A worker does not see {out}, but {what} must be in a file system that all machines share.")


def require_at_least(least: int, value: int, option: str) -> None:
    if value < least:
        raise InputError(f"{option} is {value}, but must be at least {least}.")


def require_one_of_both(resume: bool, overwrite: bool) -> None:
    if resume and overwrite:
        raise InputError("--resume and --overwrite are both given, but exclude each other: leave one out.")


def steps_or_time(steps: int | None, time: float | None) -> int | None:
    if time is None:
        return STEPS if steps is None else steps
    if steps is not None:
        raise InputError("--time is given, but must be left out, as --steps says how long the scene is simulated.")
    if not 0.0 < time < inf:
        raise InputError(f"--time is {time:g}, but must be a number of seconds greater than 0.")
    return None


def text_overrides(file: Path, overrides: Sequence[str]) -> list[str]:
    words = as_text(overrides)
    read_toml(file, words)
    return words


def as_text(options: Sequence[str]) -> list[str]:
    for option in options:
        try:
            option.encode()
        except UnicodeEncodeError:
            raise InputError(f"{option!r} is among the options, but must be text in UTF-8.") from None
    return list(options)


def command_line() -> list[str]:
    return ["cortado", *sys.argv[1:]]
