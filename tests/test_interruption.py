"""What ends a command: signals, broken streams, and the end of memory, open files or threads."""

import builtins
import errno
import os
import signal
import subprocess
import sys

import pytest

from bad_tasks import TINY_SCENE
from cortado.cli.process import shortage
from cortado.files.terminal import printable
from signals import listen

STOPPED = "print('here', flush=True); time.sleep(60)"
SLOW_IMPORT = f"import time; {STOPPED}"
START = "import time; from cortado.files.terminal import keeping, leave_at_once; leave_at_once(); "
KEEPING = f"""{START}
class Late:
    def __del__(self):
        print('here', flush=True)
        time.sleep(0.5)

try:
    with keeping(lambda: "two frames are in runs"):
        WORK
except KeyboardInterrupt as stop:
    print(stop)
    raise SystemExit(stop.code)
"""
WORKERS = f"""{START}
import os, signal
from multiprocessing.context import SpawnProcess
from cortado.cli.arguments import Where

start, begun = SpawnProcess.start, []

def begin(process):
    start(process)
    begun.append(process)
    if len(begun) == 2:
        os.NUMBER  # while workers are still being imported
        os.NUMBER

SpawnProcess.start = begin
try:
    with Where(workers=2).executor("cpu", 2) as executor:
        print("too late")
except KeyboardInterrupt as stop:
    print(stop)
    raise SystemExit(stop.code)
"""


def stopped(number: int, *arguments: str, **environment: str) -> tuple[int, str]:
    """Exit code and what a Python process says that gets a signal when it says 'here'."""
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "preexec_fn": listen}
    process = subprocess.Popen([sys.executable, *arguments], env={**os.environ, **environment}, **options)
    assert process.stdout is not None and process.stdout.readline() == "here\n"
    process.send_signal(number)
    out, _ = process.communicate(timeout=30)
    return process.returncode, out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_import_is_interrupted_in_one_sentence(tmp_path, number):
    (tmp_path / "tyro.py").write_text(SLOW_IMPORT)  # what the command line imports first
    found = stopped(number, "-m", "cortado", "run", "scene.toml", PYTHONPATH=str(tmp_path))
    assert found == (128 + number, "Interrupted.\n")


@pytest.mark.parametrize(
    ("number", "work"), [(signal.SIGINT, STOPPED), (signal.SIGTERM, "Late()\n        time.sleep(60)")]
)
def test_what_is_kept_is_said(number, work):
    """At work, and in a finaliser, which drops exceptions."""
    found = stopped(number, "-c", KEEPING.replace("WORK", work))
    assert found == (128 + number, "Interrupted; two frames are in runs.\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_workers_that_begin_are_interrupted_in_one_sentence(number):
    """Ctrl-C goes to all processes of a terminal, also to those that are still being imported; a second one too."""
    sent = "killpg(0, signal.SIGINT)" if number == signal.SIGINT else "kill(os.getpid(), signal.SIGTERM)"
    program = [sys.executable, "-c", WORKERS.replace("NUMBER", sent)]
    options = {"start_new_session": True, "preexec_fn": listen, "timeout": 120}
    done = subprocess.run(program, capture_output=True, text=True, **options)
    assert (done.returncode, done.stdout, done.stderr) == (128 + number, "Interrupted.\n", "")


def test_signals_may_be_ignored_and_stderr_silenced():
    ignoring = f"import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); {START}"
    found = stopped(signal.SIGINT, "-c", f"{ignoring} print('here', flush=True); time.sleep(0.2); print('done')")
    assert found == (0, "done\n")
    silenced = f"import os; {START} os.dup2(os.open(os.devnull, os.O_WRONLY), 2); {STOPPED}"
    assert stopped(signal.SIGINT, "-c", silenced) == (130, "Interrupted.\n")


MISTAKE = ("run", "absent.toml")
UNWRITTEN = "The result cannot be written to the standard output: "


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain, with é and 流", "plain, with é and 流"),
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


STREAMS = {
    "err closed": ('"$@" 2>&-', MISTAKE, 2, ""),
    "all closed": ('"$@" <&- >&- 2>&-', MISTAKE, 2, ""),
    "err full": ('"$@" 2>/dev/full', MISTAKE, 2, ""),
    "err unread": ('"$@" 2> >(exec 0<&-; sleep 1)', MISTAKE, 2, ""),
    "out unread": ('"$@" | true; exit ${PIPESTATUS[0]}', ["run", "--help"], 141, ""),
    "out full": ('"$@" >/dev/full', ["--help"], 1, f"{UNWRITTEN}No space left on device.\n"),
    "out closed": ('"$@" >&-', ["schema"], 1, f"{UNWRITTEN}Bad file descriptor.\n"),
}


@pytest.mark.parametrize("line, arguments, code, said", STREAMS.values(), ids=STREAMS)
def test_broken_streams_leave_the_exit_code(line, arguments, code, said):
    assert in_shell(line, *arguments) == (code, said)


@pytest.mark.parametrize("encoding, accent", [("ascii", "\\xe9"), ("utf-8", "é")], ids=["ascii", "utf-8"])
def test_names_that_cannot_be_shown_are_escaped(encoding, accent):
    name = os.fsdecode("é".encode() + b"\xff\x1b[31m")
    found = in_shell('"$@"', "run", name, PYTHONIOENCODING=encoding)
    assert found == (2, f"{accent}\\xff\\x1b[31m: the scene cannot be read: No such file or directory.\n")


MAPPING = "libx.so: failed to map segment from shared object"


def caused(error, cause):
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "begin"),
    [
        (MemoryError(), "Memory ran out; take a larger spacing"),
        (ImportError(MAPPING), f"Memory ran out ({MAPPING}); take"),
        (caused(RuntimeError("Failed to load warp.so"), OSError(MAPPING)), f"Memory ran out ({MAPPING}); take"),
        (OSError(errno.EMFILE, "Too many open files", "font.ttf"), "Too many files are open ([Errno 24] Too many"),
        (RuntimeError("can't start new thread"), "No more threads can be started; allow"),
    ],
)
def test_a_shortage_is_told(cortado_command, monkeypatch, tmp_path, error, begin):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(TINY_SCENE)

    def end(*_):
        raise error

    monkeypatch.setattr("cortado.cli.run.write_run_report", end)
    code, _, err = cortado_command("run", "scene.toml", "--steps", 2, "--out", "dam")
    assert code == 1 and err.splitlines()[-1].startswith(begin)
    assert (tmp_path / "dam" / "trajectory.vtkhdf").exists() and (tmp_path / "dam" / "result.json").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="limits of bash, as Linux counts them")
@pytest.mark.parametrize(("limit", "word"), [("-v 300000", "Memory ran out"), ("-n 6", "Too many files are open")])
def test_limits_of_a_shell(tmp_path, limit, word):
    (tmp_path / "empty.toml").touch()  # read before anything large is imported
    line = f'ulimit {limit}; exec "{sys.executable}" -m cortado run empty.toml'
    ended = subprocess.run(["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 1 and ended.stderr.splitlines()[-1].startswith(word), ended.stderr


def test_a_library_that_does_not_fit_is_not_called_missing(monkeypatch):
    for error in (OSError(errno.EACCES, "no"), RuntimeError("no"), ImportError("undefined symbol")):
        assert shortage(error) is None
    from cortado.pictures.video_files import pyav

    real = builtins.__import__

    def importing(name, *rest):
        if name == "av":
            raise ImportError(MAPPING)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", importing)
    with pytest.raises(ImportError, match="failed to map"):
        pyav()
