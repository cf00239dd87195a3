"""A command line that cannot be understood, in one sentence instead of the box that tyro draws around several.

Where tyro's words are none of those below, such as those of another release, they come as they are.
"""

import re
from collections.abc import Callable, Sequence
from difflib import get_close_matches

from cortado.errors import LONGEST

_COMMAND = re.compile(
    r"(new|examples|describe|run|compare|convergence|optimise|fit|picture|export|view|sweep|dataset|schema|completion"
    r"|gradients( check)?|figure|study)(?= |$)"
)
_EDGES = "│|╭╮╰╯─-+ "


def _unknown_command(match: re.Match[str]) -> str:
    word, commands = match.groups()
    close = get_close_matches(word, commands.split(", "), n=1)
    return (
        f"{word} is unknown; {close[0]} may be meant" if close else f"{word} is unknown, but must be one of {commands}"
    )


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
    (
        r"Error parsing (\S+): no type .*\|INT .*? from \[(.*?)\]\. .*",
        r"\1 is \2, but must be a whole number",
    ),
    (
        r"Error parsing (\S+): no type .*\|FLOAT .*? from \[(.*?)\]\. .*",
        r"\1 is \2, but must be a number",
    ),
    (r"Error parsing (\S+): (.*)", r"\1 cannot be used: \2"),
)
"""What tyro says, and what we say."""


MOVED = {
    "bench": "python -m benchmarks bench",
    "gradients figure": "python -m experiments figure",
    "gradients study": "python -m experiments study",
}
"""Commands of before, and what one types in a clone of the repository in their place."""


def usage_sentence(box: str, arguments: Sequence[str], program: str = "cortado") -> str:
    """What tyro says in its box about the arguments of a program, as a sentence of ours."""
    words = " ".join(arguments)
    for before, now in MOVED.items():
        if program == "cortado" and f"{words} ".startswith(f"{before} "):
            return f"cortado {before} is now {now}, in a clone of the repository."
    lines = ["" if set(line) <= set(_EDGES) else line.strip("│| ") for line in box.splitlines()[1:]]
    text = " ".join(line for line in lines if line)
    text = re.split(r" (?:Argument helptext:|For full helptext,)", text)[0].rstrip(". ")
    found = ((re.fullmatch(theirs, text), ours) for theirs, ours in _SENTENCES)
    said = next((ours(match) if callable(ours) else match.expand(ours) for match, ours in found if match), text)
    said = said if len(said) <= 2 * LONGEST else f"{said[: 2 * LONGEST]}..."
    command = _COMMAND.match(words)
    return f"{said}; see {program} {f'{command[0]} ' if command else ''}--help."
