"""``cortado compare RUN DATA.csv``: what sensors read beside what was measured."""

import json
from pathlib import Path

import numpy as np
import pytest

from bad_scenes import assert_one_sentence
from cortado.runs.run_folder import RunFolder
from cortado.runs.sensor import Readings


@pytest.fixture
def run(tmp_path, monkeypatch):
    """The folder of a run whose gauge has read 2 t."""
    monkeypatch.chdir(tmp_path)
    folder = RunFolder.create("run", "{}", ["cortado"])
    times = np.linspace(0.0, 1.0, 11)
    folder.write_sensors(
        {"gauge": Readings(times, np.stack([2 * times, 0 * times], axis=1), {"height": "m", "f": "N"})}
    )
    return folder


def test_readings_come_back_bit_for_bit_and_what_is_missing_is_a_sentence(run, cortado_command):
    found = run.read_sensors()["gauge"]
    assert found.units == {"height": "m", "f": "N"}
    np.testing.assert_array_equal(found["height"], 2 * np.linspace(0.0, 1.0, 11))
    assert "cannot be read" in cortado_command("compare", "run", "data.csv")[2]
    run.sensors.unlink()
    code, _, err = cortado_command("compare", "run", "data.csv")
    assert code == 2 and "has no sensors.csv" in err


@pytest.mark.parametrize("head", ["time,gauge.height", "time [s], gauge.height [m]"])
def test_the_error_is_that_at_the_measured_times(run, cortado_command, head):
    Path("data.csv").write_text(f"{head}\n0.05,0.0\n0.33,0.66\n1.0,2.2\n0.5,\n3.0,9.0\n")
    code, out, err = cortado_command("compare", "run", "data.csv")
    assert (code, err) == (0, "") and "3 points, 1 more are outside of the run" in out
    assert "0.129 m (root mean square)" in out and "at most 0.2 m at 1 s" in out
    assert (run.figures / "measured.png").exists()
    errors = json.loads(cortado_command("compare", "run", "data.csv", "--json")[1])["errors"]["gauge.height"]
    assert errors["root_mean_square"] == pytest.approx(np.sqrt((0.1**2 + 0.2**2) / 3))
    assert errors["mean"] == pytest.approx(-0.1 / 3) and errors["unit"] == "m"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time,gauge.depth\n0,1\n", "has the column 'gauge.depth', but must have some of gauge.height, gauge.f"),
        ("time,gauge.height [mm]\n0,1\n", "has gauge.height in mm, but must have it in m"),
        ("time [ms],gauge.height\n0,1\n", "but must have time [s]"),
        ("gauge.height\n1\n", "but must have time [s], and some of gauge.height"),
        ("time;gauge.height\n0,5;1\n", "has semicolons between its columns, but must have commas"),
        ("time\n1\n", "has times alone"),
        ("time,gauge.height\n2,1\n", "has no value of gauge.height within the run"),
        ("time,gauge.height\n0.1,x\n", "line 2, gauge.height is 'x'"),
        ("", "must have a line of different names"),
    ],
)
@pytest.mark.usefixtures("run")
def test_tables_that_do_not_fit_are_sentences(cortado_command, text, words):
    Path("data.csv").write_text(text)
    code, out, err = cortado_command("compare", "run", "data.csv")
    assert (code, out) == (2, "") and words in err, err
    assert_one_sentence(err.removesuffix("\n"))
