"""What Warp says of itself, and what is said instead: processes of their own, as Warp starts once in each."""

import os
import subprocess
import sys

import pytest

from compiling_notice import COMPILING, UNOPTIMISED

FIRST = f"""{UNOPTIMISED}
BEFORE
import cortado
simulation = cortado.Simulation("docs/figures/dam_break_plane.toml")
simulation.run(2)
print("level", wp.config.log_level)
"""


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """A cache that a first run has filled, and what that run said."""
    folder = tmp_path_factory.mktemp("kernels")
    return folder, said(folder)


def said(cache, before="", **environment):
    """Lines on stdout, and stderr, of a run in a process."""
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache), **environment}
    done = subprocess.run(
        [sys.executable, "-c", FIRST.replace("BEFORE", before)], capture_output=True, env=environment, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines(), done.stderr


def test_one_line_says_that_kernels_are_compiled(compiled):
    _, (out, err) = compiled
    assert out == ["level 30"]
    assert COMPILING.fullmatch(err)


def test_nothing_is_said_where_they_come_from_the_cache(compiled):
    """Neither a greeting nor a warning that there is no driver of a GPU."""
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


def test_the_command_line_says_the_same(compiled, tmp_path):
    """A kernel of another viscosity is among those that it needs, at first."""
    folder, _ = compiled
    scene = "docs/figures/dam_break_plane.toml"
    options = ["--set", "forces.viscosity=stress", "--steps", "2", "--no-pictures", "--overwrite"]
    program = UNOPTIMISED + "import runpy; runpy.run_module('cortado', run_name='__main__')"
    command = [sys.executable, "-c", program, "run", scene, "--out", str(tmp_path), *options]
    errors = []
    for _ in range(2):
        environment = {**os.environ, "WARP_CACHE_PATH": str(folder)}
        done = subprocess.run(command, capture_output=True, env=environment, text=True)
        assert done.returncode == 0, done.stderr
        errors.append(done.stderr)
    assert COMPILING.fullmatch(errors[0]) and errors[1] == ""
