"""From the words of a command line to the command that they name, and what completes such words in a shell."""

import io
from collections.abc import Sequence
from contextlib import redirect_stdout, suppress
from typing import Any

import tyro
from tyro.extras import SubcommandApp


def parsed(app: SubcommandApp, arguments: Sequence[str]) -> Any:
    """What the command returns that the arguments name; prints help and exits where they ask for it, or where they are
    misused."""
    return app.cli(
        prog="cortado",
        description="A differentiable SPH fluid simulator. --version prints which one; cortado alone gives examples.",
        args=arguments,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )


def completion_script(app: SubcommandApp, shell: str) -> str:
    """The script for a shell, as tyro prints it and exits; bash completes names of files where nothing else fits."""
    box = io.StringIO()
    with redirect_stdout(box), suppress(SystemExit):
        parsed(app, ["--tyro-print-completion", shell])
    return box.getvalue().rstrip("\n").replace("complete -F ", "complete -o bashdefault -o default -F ")
