"""One process at a time writes a folder."""

import errno
import fcntl
import os
import runpy
import signal
import subprocess
import sys

import pytest

from cortado.errors import InputError
from cortado.files import output_files
from cortado.files.output_files import LOCK, locked

HOLDER = """
import sys, time
from pathlib import Path
from cortado.files.output_files import locked

with locked(Path(sys.argv[1])):
    print("locked", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_refused_until_the_first_has_ended(tmp_path):
    folder = tmp_path / "runs" / "a"
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, folder], stdout=subprocess.PIPE, text=True)
    assert holder.stdout.readline() == "locked\n"
    with pytest.raises(InputError, match=rf"a is being written by process {holder.pid} on .*--out"), locked(folder):
        pass
    holder.send_signal(signal.SIGKILL)
    holder.communicate()
    assert os.listdir(folder) == [LOCK]
    with locked(folder):
        pass
    assert os.listdir(folder) == []


def test_the_lock_ends_with_the_block(tmp_path):
    with locked(tmp_path):
        with pytest.raises(InputError, match=f"process {os.getpid()}"), locked(tmp_path):
            pass
        assert os.listdir(tmp_path) == [LOCK]
    with locked(tmp_path):
        pass


def test_a_lock_that_its_owner_removed_is_not_taken_for_one(tmp_path, monkeypatch):
    """The process before ends after the file was opened and before it is locked."""
    (tmp_path / LOCK).touch()
    flock = fcntl.flock

    def slow(file, operation):
        monkeypatch.setattr(fcntl, "flock", flock)
        (tmp_path / LOCK).unlink()
        flock(file, operation)

    monkeypatch.setattr(fcntl, "flock", slow)
    with locked(tmp_path), pytest.raises(InputError, match="is being written"), locked(tmp_path):
        pass


def test_without_locks_a_folder_is_written_all_the_same(tmp_path, monkeypatch):
    def unknown(*arguments):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", unknown)
    with locked(tmp_path):
        pass
    assert os.listdir(tmp_path) == []


def test_a_link_in_place_of_the_lock_is_not_followed(tmp_path):
    (tmp_path / "precious").write_text("mine")
    (tmp_path / LOCK).symlink_to(tmp_path / "precious")
    with pytest.raises(InputError, match="cannot be written"), locked(tmp_path):
        pass
    assert (tmp_path / "precious").read_text() == "mine"


def test_a_lock_on_windows_is_one_byte_that_others_need_not_read(tmp_path, monkeypatch):
    """With what Windows has in the place of flock, as there is no Windows to run it on."""
    asked = []

    class Msvcrt:
        LK_NBLCK = 2

        @staticmethod
        def locking(file, mode, size):
            asked.append((os.lseek(file, 0, os.SEEK_CUR), mode, size))
            if len(asked) > 1:
                raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setitem(sys.modules, "msvcrt", Msvcrt)
    monkeypatch.setattr(sys, "platform", "win32")
    found = runpy.run_path(output_files.__file__)
    with open(tmp_path / LOCK, "w+b") as file:
        found["lock"](file.fileno())
        assert asked == [(found["BEYOND"], 2, 1)] and file.tell() == 0
        with pytest.raises(BlockingIOError):
            found["lock"](file.fileno())
