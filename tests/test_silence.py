"""What Warp says of itself and of CUDA drivers, and what is said instead: processes of their own."""

import os
import subprocess
import sys

import pytest

import cortado.device.modules
from bad_tasks import TINY_SCENE
from compiling_notice import COMPILING, UNOPTIMISED
from cortado import InputError, Simulation
from cortado.device.modules import start_warp, why_no_gpu
from test_compiling import ONE_PHASE

FIRST = f"""{UNOPTIMISED}
BEFORE
import cortado
simulation = cortado.Simulation(cortado.load_scene("docs/figures/dam_break_plane.toml", {ONE_PHASE}))
simulation.run(2)
print("level", wp.config.log_level)
"""


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """A cache that a first run has filled, and what that run said."""
    folder = tmp_path_factory.mktemp("kernels")
    return folder, said(folder)


def said(cache, before="", program=FIRST, options=(), **environment):
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache), **environment}
    command = [sys.executable, "-c", program.replace("BEFORE", before), *options]
    done = subprocess.run(command, capture_output=True, env=environment, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines(), done.stderr


def test_one_line_says_that_kernels_are_compiled(compiled):
    _, (out, err) = compiled
    assert out == ["level 30"]
    assert COMPILING.fullmatch(err)


def test_nothing_is_said_where_they_come_from_the_cache(compiled):
    folder, _ = compiled
    assert said(folder) == (["level 30"], "")


def test_whoever_wants_to_hear_warp_does(compiled):
    folder, _ = compiled
    out, _ = said(folder, CORTADO_VERBOSE="1")
    assert out[0].startswith("Warp ") and out[-1] == "level 20"
    assert any(line.startswith("Module cortado_") and line.endswith("(cached)") for line in out)
    assert said(folder, CORTADO_VERBOSE="0") == (["level 30"], "")


@pytest.mark.parametrize(("level", "greets"), [("DEBUG", True), ("WARNING", False), ("ERROR", False)])
def test_a_level_that_was_chosen_is_kept(compiled, level, greets):
    folder, _ = compiled
    out, _ = said(folder, before=f"wp.config.log_level = wp.LOG_{level}; print('level', wp.LOG_{level})")
    assert out[0] == out[-1] and any(line.startswith("Warp ") for line in out) == greets


@pytest.mark.parametrize(
    ("found", "needed", "words"),
    [
        (None, (13, 0), "no GPU with a CUDA driver is found"),
        ((12, 9), (13, 0), "supports CUDA 12.9 and Warp needs 13.0: install a newer driver"),
        ((13, 0), (13, 0), "no GPU with a CUDA driver is found"),
        ((12, 9), None, "no GPU with a CUDA driver is found"),
    ],
)
def test_what_is_said_of_versions(monkeypatch, found, needed, words):
    monkeypatch.setattr(cortado.device.modules, "installed_driver", lambda: found)
    monkeypatch.setattr(cortado.device.modules, "_needed", lambda: needed)
    assert words in why_no_gpu()


def test_python_is_told_too(monkeypatch, tmp_path):
    (tmp_path / "scene.toml").write_text(TINY_SCENE)
    monkeypatch.setattr(cortado.device.modules, "installed_driver", lambda: (11, 0))
    monkeypatch.setattr("warp.get_cuda_device_count", lambda: 0)
    with pytest.raises(InputError, match=r"device is 'cuda', .* the CUDA driver is too old, as it supports CUDA 11"):
        Simulation(str(tmp_path / "scene.toml"), device="cuda")


def test_warp_says_what_it_needs():
    start_warp()
    assert (cortado.device.modules._needed() or (99, 0)) >= (11, 4)
