"""Which files are read: regular ones of a modest size."""

import os
import socket

import pytest

from cortado.files.input_files import content, reason, regular_file


def a_pipe(path):
    os.mkfifo(path)


def a_socket(path):
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


def a_large_file(path):
    path.write_bytes(b"")
    os.truncate(path, 3_400_000)


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda path: path.mkdir(), "it is a directory, but must be a regular file"),
        (a_pipe, "it is a pipe, but must be a regular file"),
        (a_socket, "it is a socket, but must be a regular file"),
        (lambda path: path.symlink_to("/dev/zero"), "it is a device, but must be a regular file"),
        (lambda path: path.symlink_to(path), "symbolic links"),
        (lambda path: None, "No such file"),
        (a_large_file, "it has 3,400,000 bytes, but must have at most 1,000,000"),
    ],
)
def test_what_is_not_read(tmp_path, monkeypatch, make, words):
    monkeypatch.chdir(tmp_path)  # the name of a socket must be short
    make(tmp_path / "x")
    for read in (regular_file, content):
        with pytest.raises(OSError) as caught:
            read(tmp_path / "x", 1_000_000)
        assert words in reason(caught.value)


def test_a_name_that_no_file_can_have():
    with pytest.raises(OSError) as caught:
        content("a\0b", 10)
    assert reason(caught.value) == "no file can have this name"


def test_a_link_to_a_file_is_read(tmp_path):
    (tmp_path / "file").write_bytes(b"12345")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    assert content(tmp_path / "link", 5) == b"12345"


def test_a_file_that_the_system_makes_up_has_an_end():
    """Its size is said to be 0."""
    with pytest.raises(OSError, match="it has 2 bytes, but must have at most 1"):
        content("/proc/self/status", 1)
