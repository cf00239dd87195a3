"""Files: which are read, that those written appear whole or not at all, and that one process writes a folder."""

import errno
import fcntl
import os
import runpy
import signal
import socket
import stat
import subprocess
import sys

import pytest

import cortado.files.disk
from cortado.errors import ComputationError, InputError
from cortado.files import disk
from cortado.files.disk import LOCK, content, locked, reason, regular_file, unfinished, write_atomically
from full_disk import largest_file


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.json"
    write_atomically(path, "old")
    with largest_file(5), pytest.raises(ComputationError, match=r"a\.json cannot be written: File too large; free"):
        write_atomically(path, "much that is new")
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.json"]
    assert path.stat().st_mode & stat.S_IRUSR


def test_a_full_disk_is_told_from_a_wrong_path(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="cannot be written: No such file or directory; choose"):
        write_atomically(tmp_path / "absent" / "a", "text")

    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ComputationError, match="No space left"):
        write_atomically(tmp_path / "a", "text")
    assert os.listdir(tmp_path) == []


def test_links_in_place_of_a_temporary_file_or_of_a_lock_are_not_followed(tmp_path, monkeypatch):
    (tmp_path / "precious").write_text("mine")
    monkeypatch.setattr(cortado.files.disk.secrets, "token_hex", lambda count: "guessed")
    unfinished(tmp_path / "a").symlink_to(tmp_path / "precious")
    with pytest.raises(InputError, match="cannot be written"):
        write_atomically(tmp_path / "a", "theirs")
    assert (tmp_path / "precious").read_text() == "mine"
    (tmp_path / "precious").write_text("mine")
    (tmp_path / LOCK).symlink_to(tmp_path / "precious")
    with pytest.raises(InputError, match="cannot be written"), locked(tmp_path):
        pass
    assert (tmp_path / "precious").read_text() == "mine"


def test_a_device_a_pipe_or_a_link_under_a_name_that_can_be_guessed_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is a device or a pipe"):
        write_atomically(tmp_path / "pipe", "text")
    assert (tmp_path / "pipe").is_fifo() and len(list(tmp_path.iterdir())) == 1
    assert len({unfinished(tmp_path / "a") for _ in range(100)}) == 100


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda path: path.mkdir(), "it is a directory, but must be a regular file"),
        (os.mkfifo, "it is a pipe, but must be a regular file"),
        (lambda path: socket.socket(socket.AF_UNIX).bind(str(path)), "it is a socket, but must be a regular file"),
        (lambda path: path.symlink_to("/dev/zero"), "it is a device, but must be a regular file"),
        (lambda path: path.symlink_to(path), "symbolic links"),
        (lambda path: None, "No such file"),
        (
            lambda path: (path.touch(), os.truncate(path, 3_400_000)),
            "it has 3,400,000 bytes, but must have at most 1,000",
        ),
    ],
)
def test_what_is_not_read(tmp_path, monkeypatch, make, words):
    monkeypatch.chdir(tmp_path)  # the name of a socket must be short
    make(tmp_path / "x")
    for read in (regular_file, content):
        with pytest.raises(OSError) as caught:
            read(tmp_path / "x", 1_000_000)
        assert words in reason(caught.value)


def test_what_the_system_makes_up_has_an_end_and_a_name_must_be_possible(tmp_path):
    """Its size is said to be 0."""
    with pytest.raises(OSError, match="it has 2 bytes, but must have at most 1"):
        content("/proc/self/status", 1)
    with pytest.raises(OSError) as caught:
        content("a\0b", 10)
    assert reason(caught.value) == "no file can have this name"
    (tmp_path / "file").write_bytes(b"12345")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    assert content(tmp_path / "link", 5) == b"12345"


HOLDER = """
import sys, time
from pathlib import Path
from cortado.files.disk import locked

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


def test_the_lock_ends_with_the_block_and_without_locks_a_folder_is_written_too(tmp_path, monkeypatch):
    with locked(tmp_path):
        with pytest.raises(InputError, match=f"process {os.getpid()}"), locked(tmp_path):
            pass
        assert os.listdir(tmp_path) == [LOCK]
    with locked(tmp_path):
        pass

    def unknown(*arguments):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", unknown)
    with locked(tmp_path):
        pass
    assert os.listdir(tmp_path) == []


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
    found = runpy.run_path(disk.__file__)
    with open(tmp_path / LOCK, "w+b") as file:
        found["lock"](file.fileno())
        assert asked == [(found["BEYOND"], 2, 1)] and file.tell() == 0
        with pytest.raises(BlockingIOError):
            found["lock"](file.fileno())
