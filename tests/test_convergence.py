"""``cortado convergence``: the order and the limit of numbers, and runs that do not belong together."""

import json

import numpy as np
import pytest

from bad_scenes import assert_one_sentence
from bad_tasks import TINY_SCENE
from cortado.optimisation.sweep import Extrapolation


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("sizes", [[0.8, 0.4, 0.2, 0.1], [0.3, 0.2, 0.1], [0.1, 0.09, 0.07]])
@pytest.mark.parametrize("scale", [1.0, -30.0])
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
        ([1.0, 1.5, 2.0], "it does not come to rest"),
        ([1.0, 1.5, 3.0], "it does not come to rest"),
        ([1.0, 1.0, 2.0], "it does not come to rest"),
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
    monkeypatch.setattr("cortado.cli.commands.run.write_run_report", lambda *_: None)


def run(cortado_command, name, step, *options, steps=4):
    command = ["run", "scene.toml", "--steps", steps, "--out", name, "--set", f"solver.time_step={step}", *options]
    assert cortado_command(*command)[0] == 0


@pytest.mark.usefixtures("scene")
def test_a_table_of_time_steps(cortado_command):
    sweep = ["sweep", "scene.toml", "--set", "solver.time_step=0.002,0.001,0.0005", "--steps", 8]
    assert cortado_command(*sweep)[0] == 0
    code, out, err = cortado_command("convergence", "runs/sweep")
    assert (code, err) == (0, "") and out.startswith("3 runs until 0.004 s, by solver.time_step")
    table = json.loads(cortado_command("convergence", "runs/sweep", "--json")[1])
    assert table["solver.time_step"] == [0.002, 0.001, 0.0005]
    (height,) = [row for row in table["rows"] if row["name"] == "centre of mass, y"]
    assert height["unit"] == "m" and 0.5 < height["order"] < 3.0 and height["error"] > 0.0
    assert f"{height['limit']:.6g}" in out


@pytest.mark.usefixtures("scene")
def test_a_number_of_ones_own_is_in_the_table(cortado_command, tmp_path):
    (tmp_path / "own.py").write_text(
        "def lowest(trajectory):\n    return trajectory.positions[-1, :, 1].min()\n\n\n"
        "def bad(trajectory):\n    return trajectory.nothing\n\n\ndef rows(trajectory):\n    return [1.0, 2.0]\n"
    )
    (tmp_path / "broken.py").write_text("def lowest(:\n")
    assert cortado_command("sweep", "scene.toml", "--set", "solver.time_step=0.002,0.001,0.0005", "--steps", 4)[0] == 0
    code, out, err = cortado_command("convergence", "runs/sweep", "--quantity", "own.py:lowest")
    assert (code, err) == (0, "") and any(line.startswith("lowest ") for line in out.splitlines())
    for given, words in (
        ("own.py", "must be FILE.py:FUNCTION"),
        ("own.py:highest", "has no function highest"),
        ("own.py:bad", "failed: AttributeError"),
        ("own.py:rows", "must return a number"),
        ("broken.py:lowest", "cannot be read: SyntaxError"),
        ("none.py:lowest", "cannot be read: FileNotFoundError"),
    ):
        code, out, err = cortado_command("convergence", "runs/sweep", "--quantity", given)
        assert (code, out) == (2, "") and words in err
        assert_one_sentence(err.removesuffix("\n"))


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
        ("aab", "have one solver.time_step"),
        ("aaa", "do not differ"),
    ):
        code, out, err = cortado_command("convergence", *runs)
        assert (code, out) == (2, "") and words in err, err
        assert_one_sentence(err.removesuffix("\n"))
    assert cortado_command("convergence", "nowhere", "a", "b")[0] == 2
