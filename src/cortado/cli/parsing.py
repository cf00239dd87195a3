"""From the words of a command line to the command that they name, and what completes such words in a shell."""

import io
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from typing import Any

import tyro
from tyro.extras import SubcommandApp


@dataclass(frozen=True)
class Program:
    """A group of commands, and what one types to run it."""

    name: str
    app: SubcommandApp
    description: str
    overview: Callable[[], str] | None = None
    """What it prints without arguments, if not its help."""


def parsed(program: Program, arguments: Sequence[str]) -> Any:
    """What the command returns that the arguments name; prints help and exits where they ask for it, or where they are
    misused."""
    config = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)
    return program.app.cli(prog=program.name, description=program.description, args=arguments, config=config)


def completion_script(program: Program, shell: str) -> str:
    """The script for a shell, as tyro prints it and exits; bash completes names of files where nothing else fits."""
    box = io.StringIO()
    with redirect_stdout(box), suppress(SystemExit):
        parsed(program, ["--tyro-print-completion", shell])
    return box.getvalue().rstrip("\n").replace("complete -F ", "complete -o bashdefault -o default -F ")
