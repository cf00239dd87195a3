"""``cortado convergence``, of runs that belong together; ``cortado compare RUN DATA.csv``, of what was measured."""

import json
from pathlib import Path

import numpy as np
import pytest

from bad_scenes import assert_refused
from bad_tasks import TINY_SCENE
from cortado.cli.compare import Extrapolation
from cortado.runs.run_folder import RunFolder
from cortado.runs.sensor import Readings


@pytest.mark.parametrize("order", [0.5, 2.0])
@pytest.mark.parametrize("sizes, scale", [([0.8, 0.4, 0.2, 0.1], 1.0), ([0.1, 0.09, 0.07], -30.0)])
def test_a_power_of_the_size_is_found(order, sizes, scale):
    found = Extrapolation.of(sizes, [7.0 + scale * h**order for h in sizes])
    assert found.order == pytest.approx(order, rel=1e-6) and found.limit == pytest.approx(7.0, rel=1e-7)
    assert not found.flag and found.error == pytest.approx(1.25 * abs(scale) * sizes[-1] ** order)


@pytest.mark.parametrize(("order", "taken"), [(4.0, 2.0), (0.1, 0.5)])
def test_an_order_that_no_method_has_is_not_believed(order, taken):
    """Of sizes that are halved twice: f_2 - f_1 is known, and the error is 3 times what the order taken says."""
    sizes = [0.4, 0.2, 0.1]
    found = Extrapolation.of(sizes, [7.0 + h**order for h in sizes])
    away = (0.2**order - 0.1**order) / (2.0**taken - 1.0)
    assert found.order == pytest.approx(order) and found.flag == f"the order is taken as {taken:g}"
    assert found.error == pytest.approx(3.0 * away) and found.limit == pytest.approx(7.0 + 0.1**order - away)


def test_the_example_of_celik_and_others():
    """Their table 1, the second column: the length of reattachment, a recirculation on three grids."""
    found = Extrapolation.of([1 / 4500**0.5, 1 / 8000**0.5, 1 / 18000**0.5], [5.863, 5.972, 6.063])
    assert found.order == pytest.approx(1.53, abs=0.01) and found.limit == pytest.approx(6.1685, abs=2e-3)
    assert found.error / 6.063 == pytest.approx(0.022, abs=5e-4) and not found.flag


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ([1.0, 2.0, 1.5], "it goes up and down"),
        ([1.0, 1.5, 3.0], "it does not come to rest"),
        ([2.0, 1.0, 1.0], "the two finest are equal"),
        ([1.0, np.nan, 2.0], "not a number"),
        ([1e9, 1.0, 1.0 - 1e-9], "it has no order that can be told"),
    ],
)
def test_numbers_without_an_order_say_so(values, words):
    found = Extrapolation.of([0.4, 0.2, 0.1], values)
    assert found.order is None and found.flag == words
    differ = np.ptp(values)
    assert found.error is None if np.isnan(differ) else found.error == pytest.approx(3.0 * differ)


@pytest.fixture
def scene(tmp_path, monkeypatch):
    (tmp_path / "scene.toml").write_text(TINY_SCENE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cortado.cli.run.write_run_report", lambda *_: None)


def run(cortado_command, name, step, *options, steps=4):
    command = ["run", "scene.toml", "--steps", steps, "--out", name, "--set", f"solver.time_step={step}", *options]
    command.append("--no-pictures")
    assert cortado_command(*command)[0] == 0


@pytest.mark.usefixtures("scene")
def test_a_table_of_time_steps_has_numbers_of_ones_own(cortado_command):
    sweep = ["sweep", "scene.toml", "--set", "solver.time_step=0.002,0.001,0.0005", "--steps", 8]
    assert cortado_command(*sweep, "--no-pictures")[0] == 0
    code, out, err = cortado_command("convergence", "runs/sweep")
    assert (code, err) == (0, "") and out.startswith("3 runs until 0.004 s, by solver.time_step")
    table = json.loads(cortado_command("convergence", "runs/sweep", "--json")[1])
    assert table["solver.time_step"] == [0.002, 0.001, 0.0005]
    (height,) = [row for row in table["rows"] if row["name"] == "centre of mass, y"]
    assert height["unit"] == "m" and 0.5 < height["order"] < 3.0 and height["error"] > 0.0
    assert f"{height['limit']:.6g}" in out
    Path("own.py").write_text(
        "def lowest(trajectory):\n    return trajectory.positions[-1, :, 1].min()\n\n\n"
        "def rows(trajectory):\n    return [1.0, 2.0]\n"
    )
    code, out, err = cortado_command("convergence", "runs/sweep", "--quantity", "own.py:lowest")
    assert (code, err) == (0, "") and any(line.startswith("lowest ") for line in out.splitlines())
    for given, words in (
        ("own.py:highest", "has no function highest"),
        ("own.py:rows", "must return a number"),
        ("none.py:lowest", "cannot be read: FileNotFoundError"),
    ):
        assert_refused(cortado_command("convergence", "runs/sweep", "--quantity", given), words)


@pytest.mark.usefixtures("scene")
def test_what_drains_took_is_no_part_of_the_centre_of_mass(cortado_command):
    Path("scene.toml").write_text(TINY_SCENE + '\n[[drain]]\nshape = "box"\nname = "side"\nlower = [0.2, 0.0]\n')
    assert (
        cortado_command(
            "sweep", "scene.toml", "--set", "solver.time_step=0.002,0.001,0.0005", "--steps", 4, "--no-pictures"
        )[0]
        == 0
    )
    table = json.loads(cortado_command("convergence", "runs/sweep", "--json")[1])
    (place,) = [row for row in table["rows"] if row["name"] == "centre of mass, x"]
    assert place["values"] == pytest.approx([0.1] * 3, abs=0.01)


@pytest.mark.usefixtures("scene")
def test_runs_with_unlike_amounts_of_fluid_are_warned_of(cortado_command):
    sweep = ["sweep", "scene.toml", "--set", "discretisation.spacing=0.1,0.07,0.05", "--steps", 2, "--no-pictures"]
    assert cortado_command(*sweep)[0] == 0
    code, _, err = cortado_command("convergence", "runs/sweep")
    assert code == 0 and "Warning: the runs do not have the same fluid: " in err and "with a spacing of 0.07 m" in err


@pytest.mark.usefixtures("scene")
def test_runs_that_do_not_belong_together_are_refused(cortado_command):
    run(cortado_command, "a", 0.002, steps=2)
    run(cortado_command, "b", 0.001)
    run(cortado_command, "c", 0.0005)
    run(cortado_command, "d", 0.0005, "--set", "phase.0.viscosity=0.2", steps=8)
    run(cortado_command, "e", 0.0005, "--precision", "float64", steps=8)
    for runs, words in (
        ("ab", "takes at least 3"),
        ("abc", "but all runs must end at the same time"),
        ("abd", "differ in phase.0.viscosity"),
        ("abe", "in float64, but must be in float32"),
        ("aab", "have the same solver.time_step"),
        ("aaa", "do not differ"),
    ):
        assert_refused(cortado_command("convergence", *runs), words)
    assert cortado_command("convergence", "nowhere", "a", "b")[0] == 2


@pytest.fixture
def recorded(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = RunFolder.create("run", "{}", ["cortado"])
    times = np.linspace(0.0, 1.0, 11)
    values = np.stack([2 * times, 0 * times], axis=1)
    folder.write_sensors({"gauge": Readings(times, values, {"height": "m", "f": "N"})})
    return folder


def test_readings_come_back_bit_for_bit_and_what_is_missing_is_a_sentence(recorded, cortado_command):
    found = recorded.read_sensors()["gauge"]
    assert found.units == {"height": "m", "f": "N"}
    np.testing.assert_array_equal(found["height"], 2 * np.linspace(0.0, 1.0, 11))
    assert "cannot be read" in cortado_command("compare", "run", "data.csv")[2]
    recorded.sensors.unlink()
    assert_refused(cortado_command("compare", "run", "data.csv"), "has no sensors.csv")


@pytest.mark.parametrize("head", ["time,gauge.height", "time [s], gauge.height [m]"])
def test_the_error_is_that_at_the_measured_times(recorded, cortado_command, head):
    Path("data.csv").write_text(f"{head}\n0.05,0.0\n0.33,0.66\n1.0,2.2\n0.5,\n3.0,9.0\n")
    code, out, err = cortado_command("compare", "run", "data.csv")
    assert (code, err) == (0, "") and "3 points, 1 more are outside of the run" in out
    assert "0.129 m (root mean square)" in out and "at most 0.2 m at 1 s" in out
    assert (recorded.figures / "measured.png").exists()
    errors = json.loads(cortado_command("compare", "run", "data.csv", "--json")[1])["errors"]["gauge.height"]
    assert errors["root_mean_square"] == pytest.approx(np.sqrt((0.1**2 + 0.2**2) / 3))
    assert errors["mean"] == pytest.approx(-0.1 / 3) and errors["unit"] == "m"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time,gauge.depth\n0,1\n", "has the column 'gauge.depth', but the sensors have the columns gauge.height"),
        ("time,gauge.height [mm]\n0,1\n", "has gauge.height in mm, but gauge.height must be in m"),
        ("gauge.height\n1\n", "but must have time [s], and at least one of gauge.height"),
        ("time\n1\n", "has only times"),
        ("time,gauge.height\n2,1\n", "has no value of gauge.height from 0 to 1 s"),
        ("", "must have a line of different names"),
    ],
)
@pytest.mark.usefixtures("recorded")
def test_tables_that_do_not_fit_are_sentences(cortado_command, text, words):
    Path("data.csv").write_text(text)
    assert_refused(cortado_command("compare", "run", "data.csv"), words)
