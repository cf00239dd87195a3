"""A cache of kernels that cannot be written, and one with a damaged file; never that of whoever runs the tests."""

import os
import shutil
import subprocess
import sys
from functools import partial

import pytest

KERNEL = """
import sys
import warp as wp
from cortado.device.warp_start import complaint, start_warp

@wp.kernel(module="unique")
def twice(x: wp.array(dtype=float)):
    i = wp.tid()
    x[i] = 2.0 * x[i]

start_warp()
x = wp.ones(3, dtype=float, device="cpu")
try:
    wp.launch(twice, 3, inputs=[x], device="cpu")
except Exception as error:
    print(complaint(error))
else:
    print(x.numpy().sum(), wp.config.kernel_cache_dir)
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    path = tmp_path_factory.mktemp("program") / "twice.py"
    path.write_text(KERNEL)
    return path


def run(program, cache, temporary):
    """What the kernel prints, with this cache, and what it warns of."""
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache), "TMPDIR": str(temporary)}
    done = subprocess.run([sys.executable, program], capture_output=True, env=environment, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


@pytest.fixture(scope="module")
def compiled(program, tmp_path_factory):
    """A cache that a run has filled."""
    cache = tmp_path_factory.mktemp("compiled") / "cache"
    out, err = run(program, cache, cache.parent)
    assert out.startswith("6.0") and err == ""
    return cache


@pytest.fixture
def cache(compiled, tmp_path):
    """The same, to be damaged."""
    return shutil.copytree(compiled, tmp_path / "cache")


@pytest.fixture
def twice(program, tmp_path):
    return partial(run, program, temporary=tmp_path)


@pytest.mark.skipif(sys.platform != "linux", reason="object files are looked at on Linux")
@pytest.mark.parametrize("damage", [lambda file: file[:-50], lambda file: b"noise" * 100, lambda file: b""])
def test_a_damaged_kernel_is_compiled_again_elsewhere(twice, cache, damage):
    (file,) = cache.rglob("*.o")
    file.write_bytes(damage(file.read_bytes()))
    out, err = twice(cache)
    assert out.startswith("6.0") and len(err.splitlines()) == 1
    assert f"({file.parent.name} in it is damaged and should be deleted)" in err


def test_a_damaged_note_of_a_kernel_is_said_in_a_sentence(twice, cache):
    (file,) = cache.rglob("*.meta")
    file.write_bytes(file.read_bytes()[:100])
    out, _ = twice(cache)
    assert out.startswith(f"A compiled kernel in {file.parent.parent} cannot be used (") and len(out.splitlines()) == 1
    assert "delete that folder, or set the environment variable WARP_CACHE_PATH to another one." in out


def test_a_cache_that_cannot_be_written_is_replaced(twice, tmp_path):
    (tmp_path / "file").touch()
    out, err = twice(tmp_path / "file" / "cache")
    total, folder = out.split()
    assert total == "6.0" and folder.startswith(str(tmp_path / "cortado-kernels-")) and not os.path.exists(folder)
    assert err.startswith(f"Warning: Compiled kernels cannot be kept in {tmp_path / 'file' / 'cache'}")
    assert len(err.splitlines()) == 1 and "(Not a directory)" in err and "WARP_CACHE_PATH" in err


def test_other_errors_are_no_complaint_of_the_cache():
    from cortado.device.warp_start import complaint

    assert complaint(ValueError("steps")) is None and complaint(OSError(28, "No space left on device")) is None


def test_what_another_process_is_compiling_is_not_damaged(tmp_path):
    from cortado.device.warp_start import _trouble

    for name in ("wp_cortado_a_846ebbe_p512_t139785425587072", "wp_cortado_a_846ebbe"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.o").write_bytes(b"\x7fELF, and no more yet")
    assert _trouble(str(tmp_path)) == "wp_cortado_a_846ebbe in it is damaged and should be deleted"
    (tmp_path / "wp_cortado_a_846ebbe" / "a.o").unlink()
    assert _trouble(str(tmp_path)) is None
