"""Arguments that several commands have, and what is asked of their values before a command begins."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from cortado.errors import InputError
from cortado.scene.toml import read_toml

Scene = Annotated[Positional[Path], arg(metavar="SCENE.toml")]
Flag = Annotated[bool, arg(help_behavior_hint="")]
"""An option without a value, of which the help says no default."""
Overrides = Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="KEY=VALUE")]
Device = Annotated[str, arg(help='"cpu", or "cuda:0" for the first GPU.')]
Precision = Annotated[str, arg(help='"float32" or "float64".')]
Json = Annotated[bool, arg(help="Print JSON for machines.", help_behavior_hint="")]


def require_at_least(least: int, value: int, option: str) -> None:
    """Raises `InputError` for a value that is smaller, with the option's name in the sentence."""
    if value < least:
        raise InputError(f"{option} is {value}, but must be at least {least}.")


def require_toml(file: Path, overrides: Sequence[str] = ()) -> None:
    """Raises `SceneError` for a file that cannot be read, or for overrides of what it has not: at once, as what a
    command imports after that takes a second."""
    read_toml(file, overrides)


def as_text(options: Sequence[str]) -> list[str]:
    """What was given to --set or --only; raises `InputError` for bytes that are no text."""
    for option in options:
        try:
            option.encode()
        except UnicodeEncodeError:
            raise InputError(f"{option!r} is among the options, but must be text in UTF-8.") from None
    return list(options)


def command_line() -> list[str]:
    """The command as it was typed, which a run writes into its folder."""
    return ["cortado", *sys.argv[1:]]
