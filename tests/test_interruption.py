"""Ctrl-C and SIGTERM at any moment: a sentence, and the exit code that shells expect."""

import os
import signal
import subprocess
import sys

import pytest

from signals import NEEDED, listen

STOPPED = "print('here', flush=True); time.sleep(60)"
SLOW_IMPORT = f"import time; {STOPPED}"
START = "import time; from cortado.files import interruption; interruption.leave_at_once(); "
KEEPING = f"""{START}
class Late:
    def __del__(self):
        print('here', flush=True)
        time.sleep(0.5)

try:
    with interruption.keeping(lambda: "two frames are in runs"):
        WORK
except KeyboardInterrupt as stop:
    print(stop)
    raise SystemExit(stop.code)
"""
WORKERS = f"""{START}
import os, signal
from multiprocessing.context import SpawnProcess
from cortado.cli.commands.options import Where

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
    process = subprocess.Popen(
        [sys.executable, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env={**os.environ, **environment},
        text=True,
        preexec_fn=listen,
    )
    assert process.stdout is not None and process.stdout.readline() == "here\n"
    process.send_signal(number)
    out, _ = process.communicate(timeout=30)
    return process.returncode, out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_import_is_interrupted_in_one_sentence(tmp_path, number):
    (tmp_path / "tyro.py").write_text(SLOW_IMPORT)  # what the command line imports first
    found = stopped(number, "-m", "cortado", "run", "scene.toml", PYTHONPATH=str(tmp_path))
    assert found == (128 + number, "Interrupted.\n")


def test_a_silenced_stderr_does_not_swallow_the_sentence():
    silenced = f"import os; {START} os.dup2(os.open(os.devnull, os.O_WRONLY), 2); {STOPPED}"
    assert stopped(signal.SIGINT, "-c", silenced) == (130, "Interrupted.\n")


@pytest.mark.parametrize(
    "work", [STOPPED, "Late()\n        time.sleep(60)"], ids=["at work", "in a finaliser, which drops exceptions"]
)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_is_kept_is_said(number, work):
    found = stopped(number, "-c", KEEPING.replace("WORK", work))
    assert found == (128 + number, "Interrupted; two frames are in runs.\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_workers_that_begin_are_interrupted_in_one_sentence(number):
    """Ctrl-C goes to all processes of a terminal, also to those that are still being imported; a second one too."""
    sent = "killpg(0, signal.SIGINT)" if number == signal.SIGINT else "kill(os.getpid(), signal.SIGTERM)"
    program = [sys.executable, "-c", WORKERS.replace("NUMBER", sent)]
    done = subprocess.run(
        program, capture_output=True, text=True, timeout=120, start_new_session=True, preexec_fn=listen
    )
    assert (done.returncode, done.stdout, done.stderr) == (128 + number, "Interrupted.\n", "")


def test_the_tests_themselves_may_run_where_signals_are_ignored():
    """As jobs in the background of a script do, and under nohup."""
    before = {number: signal.signal(number, signal.SIG_IGN) for number in NEEDED}
    try:
        assert stopped(signal.SIGINT, "-c", f"{START} {STOPPED}") == (130, "Interrupted.\n")
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_a_signal_that_is_ignored_stays_so():
    ignoring = f"import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); {START}"
    found = stopped(signal.SIGINT, "-c", f"{ignoring} print('here', flush=True); time.sleep(0.2); print('done')")
    assert found == (0, "done\n")
