"""What the command line says where memory, open files or threads end: a sentence and exit code 1, never a traceback."""

import builtins
import errno
import subprocess
import sys

import pytest

from bad_tasks import TINY_SCENE
from cortado.cli.process import shortage

MAPPING = "libx.so: failed to map segment from shared object"


def caused(error, cause):
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "begin"),
    [
        (MemoryError(), "Memory ran out; take a larger spacing"),
        (MemoryError("Unable to allocate 64 GiB"), "Memory ran out (Unable to allocate 64 GiB); take"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "Memory ran out ([Errno 12]"),
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

    monkeypatch.setattr("cortado.cli.commands.run.write_run_report", end)
    code, _, err = cortado_command("run", "scene.toml", "--steps", 2, "--out", "dam")
    assert code == 1 and err.splitlines()[-1].startswith(begin)
    assert (tmp_path / "dam" / "trajectory.vtkhdf").exists() and (tmp_path / "dam" / "result.json").exists()


@pytest.mark.parametrize("error", [OSError(errno.EACCES, "no"), RuntimeError("no"), ImportError("undefined symbol")])
def test_other_errors_are_none(error):
    assert shortage(error) is None


@pytest.mark.skipif(sys.platform != "linux", reason="limits of bash, as Linux counts them")
@pytest.mark.parametrize(("limit", "word"), [("-v 300000", "Memory ran out"), ("-n 6", "Too many files are open")])
def test_limits_of_a_shell(tmp_path, limit, word):
    (tmp_path / "empty.toml").touch()  # read before anything large is imported
    line = f'ulimit {limit}; exec "{sys.executable}" -m cortado run empty.toml'
    ended = subprocess.run(["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 1 and ended.stderr.splitlines()[-1].startswith(word), ended.stderr


def test_a_library_that_does_not_fit_is_not_called_missing(monkeypatch):
    from cortado.files.image_encoding import pyav

    real = builtins.__import__

    def importing(name, *rest):
        if name == "av":
            raise ImportError(MAPPING)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", importing)
    with pytest.raises(ImportError, match="failed to map"):
        pyav()
