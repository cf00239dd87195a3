"""A command from its words to its exit code, with a sentence where it fails."""

import io
import logging
import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import redirect_stderr
from signal import SIGINT

from cortado.cli.command import Work
from cortado.cli.parsing import Program, parsed
from cortado.cli.shortage import shortage
from cortado.cli.subcommands import CORTADO
from cortado.cli.usage import usage_sentence
from cortado.errors import ComputationError, CortadoError, CortadoWarning, InputError, MassWarning
from cortado.files.interruption import Interrupted
from cortado.files.terminal import say, tell, to_stdout
from cortado.version import __version__

BROKEN_PIPE = 141
"""Exit code where nobody reads the result: that of a process which the signal SIGPIPE ended."""


def main(arguments: Sequence[str] | None = None, program: Program = CORTADO) -> None:
    """Run a command of a program; exits with its code unless that is 0."""
    arguments = sys.argv[1:] if arguments is None else arguments
    os.environ["MPLBACKEND"] = "agg"  # pictures go to files, whatever the user has chosen for windows
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning  # type: ignore[assignment]
            work = _understood(program, arguments)
            logging.getLogger("matplotlib").setLevel(logging.ERROR)  # where its folder cannot be written it goes on
            from cortado.device.warp_start import start_warp  # with Warp, once the command is understood

            start_warp()
            text = work()
            if text:
                tell(text)
    except ComputationError as error:
        sys.exit(_say(error, 1))
    except CortadoError as error:
        sys.exit(_say(error, 2))
    except KeyboardInterrupt as stop:
        stop = stop if isinstance(stop, Interrupted) else Interrupted(SIGINT)
        sys.exit(_say(stop, stop.code))
    except BrokenPipeError:
        sys.exit(BROKEN_PIPE)
    except Exception as error:
        sentence = shortage(error) or _complaint(error)
        if sentence is None:
            raise
        sys.exit(_say(sentence, 1))


def _understood(program: Program, arguments: Sequence[str]) -> Work:
    """The command that the arguments name; prints help or the version and exits where they ask for it."""
    box = io.StringIO()
    try:
        with redirect_stderr(box), to_stdout():
            if not arguments and program.overview:
                print(program.overview())
                sys.exit(0)
            if list(arguments) == ["--version"]:
                print(f"cortado {__version__}")
                sys.exit(0)
            return parsed(program, arguments)
    except SystemExit as end:
        if not end.code:
            raise
        raise InputError(usage_sentence(box.getvalue(), arguments, program.name)) from None


def _say(error: BaseException | str, code: int) -> int:
    say(str(error))
    return code


def _complaint(error: Exception) -> str | None:
    from cortado.device.warp_start import complaint

    return complaint(error)


def _show_warning(message: Warning, category: type[Warning], *rest: object) -> None:
    if issubclass(category, CortadoWarning) and not issubclass(category, MassWarning):
        say(f"Warning: {message}")
