"""Files that appear whole or not at all, and disks that refuse."""

import errno
import os
import stat

import pytest

import cortado.files.output_files
from cortado.errors import ComputationError, InputError
from cortado.files.output_files import unfinished, write_atomically
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


def test_a_link_under_the_temporary_name_is_not_followed(tmp_path, monkeypatch):
    (tmp_path / "precious").write_text("mine")
    monkeypatch.setattr(cortado.files.output_files.secrets, "token_hex", lambda count: "guessed")
    unfinished(tmp_path / "a").symlink_to(tmp_path / "precious")
    with pytest.raises(InputError, match="cannot be written"):
        write_atomically(tmp_path / "a", "theirs")
    assert (tmp_path / "precious").read_text() == "mine"


def test_temporary_names_cannot_be_guessed(tmp_path):
    assert len({unfinished(tmp_path / "a") for _ in range(100)}) == 100


def test_a_device_or_a_pipe_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is a device or a pipe"):
        write_atomically(tmp_path / "pipe", "text")
    assert (tmp_path / "pipe").is_fifo() and len(list(tmp_path.iterdir())) == 1
