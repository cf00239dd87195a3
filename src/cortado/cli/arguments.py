"""Arguments that several commands have, and what is asked of their values before a command begins."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, UseAppendAction, arg

from cortado.errors import InputError
from cortado.scene.toml import read_toml

if TYPE_CHECKING:
    from cortado.runs.recording import FrameChoice

Scene = Annotated[Positional[Path], arg(metavar="SCENE.toml")]
Flag = Annotated[bool, arg(help_behavior_hint="")]
"""An option without a value, of which the help says no default."""
Overrides = Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="KEY=VALUE")]
Device = Annotated[str, arg(help='"cpu", or "cuda:0" for the first GPU.')]
Precision = Annotated[str, arg(help='"float32" or "float64".')]
Json = Annotated[bool, arg(help="Print JSON for machines.", help_behavior_hint="")]


STEPS = 200
"""Of a run that is not said to be longer or shorter."""


def require_at_least(least: int, value: int, option: str) -> None:
    """Raises `InputError` for a value that is smaller, with the option's name in the sentence."""
    if value < least:
        raise InputError(f"{option} is {value}, but must be at least {least}.")


def steps_or_time(steps: int | None, time: float | None) -> int | None:
    """The number of steps, `STEPS` if neither was given; None with a time [s]. Raises `InputError` for both, and for a
    time that is none."""
    if time is None:
        return STEPS if steps is None else steps
    if steps is not None:
        raise InputError("--time is given, but must be left out, as --steps says how long the scene is simulated.")
    if not 0.0 < time < inf:
        raise InputError(f"--time is {time:g}, but must be a number of seconds greater than 0.")
    return None


@dataclass(frozen=True)
class FrameOptions:
    """Which states of a run are frames of its trajectory."""

    record_every: int | None = None
    """Steps from one frame of the trajectory to the next; if left out 1, or in a sweep a 100th of all steps."""
    fps: float | None = None
    """Frames of the trajectory in a second that is simulated, not of a film; in the place of --record-every."""

    def check(self) -> None:
        """Raises `InputError` for --record-every that is too small, and where --fps is given besides."""
        if self.fps is not None and self.record_every is not None:
            raise InputError("--fps is given, but must be left out, as --record-every says which states are recorded.")
        require_at_least(1, 1 if self.record_every is None else self.record_every, "--record-every")

    def choice(self, otherwise: int = 1) -> "FrameChoice":
        """Those of options that were checked: every so many steps if nothing is said."""
        from cortado.runs.recording import EverySteps, FramesPerSecond

        return EverySteps(self.record_every or otherwise) if self.fps is None else FramesPerSecond(self.fps)


ALL_FRAMES = FrameOptions()


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
