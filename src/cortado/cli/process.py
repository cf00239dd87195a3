"""Run a command and exit with its exit code. A failure is printed as one sentence."""

import io
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from difflib import get_close_matches
from errno import EMFILE, ENFILE, ENOMEM
from signal import SIGINT

from cortado.cli.arguments import Program, Work
from cortado.cli.subcommands import CORTADO
from cortado.errors import LONGEST, ComputationError, CortadoError, CortadoWarning, InputError, MassWarning
from cortado.files.terminal import Interrupted, say, tell, to_stdout
from cortado.version import __version__


def main(arguments: Sequence[str] | None = None, program: Program = CORTADO) -> None:
    arguments = sys.argv[1:] if arguments is None else arguments
    os.environ["MPLBACKEND"] = "agg"  # pictures go to files, whatever the user has chosen for windows
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning  # type: ignore[assignment]
            work = _understood(program, arguments)
            logging.getLogger("matplotlib").setLevel(logging.ERROR)  # where its folder cannot be written it goes on
            from cortado.device.modules import start_warp  # with Warp, once the command is understood

            start_warp()
            text = work()
            if text:
                tell(text)
    except CortadoError as error:
        say(str(error))
        sys.exit(1 if isinstance(error, ComputationError) else 2)
    except KeyboardInterrupt as stop:
        stop = stop if isinstance(stop, Interrupted) else Interrupted(SIGINT)
        say(str(stop))
        sys.exit(stop.code)
    except BrokenPipeError:
        sys.exit(141)  # as for a process that SIGPIPE ends
    except Exception as error:
        from cortado.device.modules import complaint

        sentence = shortage(error) or complaint(error)
        if sentence is None:
            raise
        say(sentence)
        sys.exit(1)


def _understood(program: Program, arguments: Sequence[str]) -> Work:
    box = io.StringIO()
    try:
        with redirect_stderr(box), to_stdout():
            if not arguments and program.overview:
                print(program.overview())
                sys.exit(0)
            if list(arguments) == ["--version"]:
                print(f"cortado {__version__}")
                sys.exit(0)
            return program.parsed(arguments)
    except SystemExit as end:
        if not end.code:
            raise
        raise InputError(usage_sentence(box.getvalue(), arguments, program.name)) from None


def _show_warning(message: Warning, category: type[Warning], *rest: object) -> None:
    if issubclass(category, CortadoWarning) and not issubclass(category, MassWarning):
        say(f"Warning: {message}")


_COMMAND = re.compile(
    r"(new|examples|describe|run|compare|convergence|optimise|fit|picture|export|view|sweep|dataset|schema|completion"
    r"|gradients( check)?|figure|study)(?= |$)"
)


def _unknown_command(match: re.Match[str]) -> str:
    word, commands = match.groups()
    close = get_close_matches(word, commands.split(", "), n=1)
    return f"{word} is unknown{f'; {close[0]} may be meant' if close else f', but must be one of {commands}'}"


_SENTENCES: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (r"Expected one of \{(.*)\}", r"a command is missing, one of \1"),
    (r"Unrecognized or misplaced options: (\S+?),?(?: .*)?", r"\1 is no option here"),
    (r"Unrecognized .*?options: (\S+?),?(?: .*)? Perhaps you meant: (\S+).*", r"\1 is unknown; \2 may be meant"),
    (r"Unrecognized .*?options: (\S+?),?(?: .*)? Available subcommands: (.*)", _unknown_command),
    (r"Unrecognized .*?options: (\S+?),?(?: .*)?", r"\1 is unknown, or one too many"),
    (r"Missing from .*?: (\S+) .*", r"\1 is missing"),
    (r"Missing value for argument '(-\S+)'.*", r"\1 is given without a value"),
    (r"Missing value for argument '(\S+)'.*", r"the \1 is missing"),
    (r"invalid choice '(.*)' for argument '(.*)'\. Expected one of \((.*?),?\)", r"\2 is '\1', but must be one of \3"),
    (r"Error parsing (\S+): invalid literal for int.*?: (.*)", r"\1 is \2, but must be a whole number"),
    (r"Error parsing (\S+): could not convert string to float: (.*)", r"\1 is \2, but must be a number"),
    (r"Error parsing (\S+): no type .*\|INT .*? from \[(.*?)\]\. .*", r"\1 is \2, but must be a whole number"),
    (r"Error parsing (\S+): no type .*\|FLOAT .*? from \[(.*?)\]\. .*", r"\1 is \2, but must be a number"),
    (r"Error parsing (\S+): (.*)", r"\1 cannot be used: \2"),
)


def usage_sentence(box: str, arguments: Sequence[str], program: str = "cortado") -> str:
    words = " ".join(arguments)
    lines = ["" if set(line) <= set("│|╭╮╰╯─-+ ") else line.strip("│| ") for line in box.splitlines()[1:]]
    text = " ".join(line for line in lines if line)
    text = re.split(r" (?:Argument helptext:|For full helptext,)", text)[0].rstrip(". ")
    found = ((re.fullmatch(theirs, text), ours) for theirs, ours in _SENTENCES)
    said = next((ours(match) if callable(ours) else match.expand(ours) for match, ours in found if match), text)
    said = said if len(said) <= 2 * LONGEST else f"{said[: 2 * LONGEST]}..."
    command = _COMMAND.match(words)
    return f"{said}; see {program} {f'{command[0]} ' if command else ''}--help."


def shortage(error: BaseException | None) -> str | None:
    """Return a sentence if an error was caused by a lack of memory, files or threads, or None."""
    while error is not None:
        said = str(error) if isinstance(error, OSError | ImportError | RuntimeError) else ""
        if isinstance(error, MemoryError) or os.strerror(ENOMEM) in said or "failed to map segment" in said:
            what = f" ({error})" if str(error) else ""
            return f"Memory ran out{what}; take a larger spacing, or record fewer frames with --record-every."
        if os.strerror(EMFILE) in said or os.strerror(ENFILE) in said:
            return f"Too many files are open ({error}); allow this process more of them (ulimit -n 1024)."
        if "can't start new thread" in said:
            return "No more threads can be started; allow this process more of them (ulimit -u) or more memory."
        error = error.__cause__ or error.__context__
    return None
