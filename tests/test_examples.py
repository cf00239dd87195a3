"""The examples in Python run without a screen, end in a check, and the check can fail."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cortado.pictures.image_files import read_picture

FOLDER = Path(__file__).parents[1] / "examples"
MISTAKES = {
    "first_gradient.py": ("iterations=12", "iterations=2", "gravity is"),
    "custom_loss.py": ("2.0 * (share - self.wanted)", "(share - self.wanted)", "the adjoint is not the derivative"),
    "carried_cup.py": ("2.0 * end.velocities", "-2.0 * end.velocities", "water is spilt, or sloshes"),
    "flipped_bottle.py": ("optimiser, 4)", "optimiser, 1)", "the bottle does not plunge upright where it should"),
    "poured_jug.py": ("(-1.0, 1.0)", "(-0.01, 0.01)", "too much of the syrup is not in the glass"),
    "steered_raft.py": ("optimiser, 16,", "optimiser, 1,", "the raft is not where it should be"),
    "stirred_tank.py": ("optimiser, ITERATIONS,", "optimiser, 1,", "the viscosity is not that of the torque"),
    "struck_pillar.py": ("values[:, 0] = true", "values[:, 0] = 2.0 * true", "the density is not that of the load"),
    "two_fluids.py": ('"tilt": [20.0, 10.0]', '"tilt": [-20.0, 10.0]', "the milk is not where the tilt sends it"),
}
"""A mistake in each, and what its check says of it."""

SHORTER = {"stirred_tank.py": ("STEPS, ITERATIONS, TIME_STEP = 25, 6,", "STEPS, ITERATIONS, TIME_STEP = 5, 4,")}
"""What makes a short run of one that takes a minute."""
DRAWN = MISTAKES.keys() - {"first_gradient.py", "custom_loss.py"}
"""Those that write a picture."""


def source_of(name: str) -> str:
    """Of an example, or of its short run."""
    source = (FOLDER / name).read_text()
    long, short = SHORTER.get(name, ("", ""))
    assert long in source
    return source.replace(long, short)


def run(path: Path, folder: Path) -> subprocess.CompletedProcess:
    environment = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    command = [sys.executable, str(path)]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=240)


def test_there_are_nine_short_ones():
    paths = list(FOLDER.glob("*.py"))
    assert {path.name for path in paths} == MISTAKES.keys() and len(paths) == 9
    assert all(len(path.read_text().splitlines()) <= 60 for path in paths)


@pytest.mark.parametrize("name", MISTAKES)
def test_an_example_ends_well(name, tmp_path):
    (tmp_path / name).write_text(source_of(name))
    done = run(tmp_path / name, tmp_path)
    assert done.returncode == 0, done.stderr
    written = sorted(path.name for path in tmp_path.iterdir() if path.name != name)
    assert written == ([Path(name).stem + ".png"] if name in DRAWN else [])
    for file in written:
        assert np.ptp(read_picture(tmp_path / file)) > 0.5


@pytest.mark.parametrize("name", MISTAKES)
def test_its_check_can_fail(name, tmp_path):
    right, wrong, said = MISTAKES[name]
    source = source_of(name)
    assert source.count(right) == 1
    (tmp_path / name).write_text(source.replace(right, wrong))
    done = run(tmp_path / name, tmp_path)
    assert done.returncode == 1 and f"AssertionError: {said}" in done.stderr
