"""How a function becomes a command of the command line."""

from collections.abc import Callable
from functools import partial, wraps
from inspect import Parameter, signature
from typing import Annotated, Any

from tyro.conf import arg
from tyro.extras import SubcommandApp

from cortado.files.terminal import quietly

Work = Callable[[], str]
"""What a command does once its arguments are understood; returns what it prints."""
Quiet = Annotated[bool, arg(help="Say nothing but results, warnings and errors.", help_behavior_hint="")]


def command(group: SubcommandApp, answers: bool = False) -> Callable[[Callable[..., Work]], Callable[..., Work]]:
    """Makes a function a command of a group, with an option --quiet. What it prints at the end is either what was asked
    for, as it ``answers``, or a line about the files that it wrote."""

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
