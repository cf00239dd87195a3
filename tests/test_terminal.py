"""What reaches the terminal, whatever stands at its end: processes of their own, with broken streams."""

import os
import subprocess
import sys

import pytest

from cortado.files.terminal import printable

MISTAKE = ("run", "absent.toml")
SENTENCE = "absent.toml: the scene cannot be read: No such file or directory.\n"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain, with é and 流", "plain, with é and 流"),
        ("\x1b[31mred\x07", "\\x1b[31mred\\x07"),
        ("two\nlines\r\tand\x7f", "two\\nlines\\r\\tand\\x7f"),
        ("\u202eevil \x9b2J", "\\u202eevil \\x9b2J"),
        (os.fsdecode(b"b\xff\x80"), "b\\xff\\x80"),
        ("\ud800", "\\ud800"),
    ],
)
def test_what_steers_a_terminal_is_escaped(text, shown):
    assert printable(text) == shown


def in_shell(line: str, *arguments: str, **environment: str) -> tuple[int, str]:
    """Exit code and output of a line of a shell in which $* is the command; what is broken is not in it."""
    command = [sys.executable, "-m", "cortado", *arguments]
    done = subprocess.run(
        ["bash", "-c", line, "bash", *command], capture_output=True, env={**os.environ, **environment}, timeout=60
    )
    return done.returncode, (done.stdout + done.stderr).decode()


@pytest.mark.parametrize(
    ("line", "arguments", "code", "said"),
    [
        ('"$@"', MISTAKE, 2, SENTENCE),
        ('"$@" 2>&-', MISTAKE, 2, ""),
        ('"$@" <&- >&- 2>&-', MISTAKE, 2, ""),
        ('"$@" 2>/dev/full', MISTAKE, 2, ""),
        ('"$@" 2> >(exec 0<&-; sleep 1)', MISTAKE, 2, ""),
        ('"$@" | true; exit ${PIPESTATUS[0]}', ["run", "--help"], 141, ""),
        (
            '"$@" >/dev/full',
            ["--help"],
            1,
            "The result cannot be written to the standard output: No space left on device.\n",
        ),
        (
            '"$@" >&-',
            ["schema"],
            1,
            "The result cannot be written to the standard output: Bad file descriptor.\n",
        ),
    ],
    ids=["whole", "no stderr", "no streams", "full stderr", "broken stderr", "broken stdout", "full stdout", "none"],
)
def test_broken_streams_leave_the_exit_code(line, arguments, code, said):
    assert in_shell(line, *arguments) == (code, said)


def test_names_that_cannot_be_shown_are_escaped():
    name = os.fsdecode("é".encode() + b"\xff\x1b[31m")
    for encoding, accent in (("ascii", "\\xe9"), ("utf-8", "é")):
        found = in_shell('"$@"', "run", name, PYTHONIOENCODING=encoding)
        assert found == (2, f"{accent}\\xff\\x1b[31m: the scene cannot be read: No such file or directory.\n")
