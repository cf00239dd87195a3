"""`cortado compare`: what differs between two runs, in numbers, and that a difference is no failure."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from bad_scenes import assert_one_sentence
from bad_tasks import GOOD_TASK, TINY_SCENE
from cortado import Trajectory
from cortado.cli import main


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    folder = tmp_path_factory.mktemp("first")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        Path("scene.toml").write_text(TINY_SCENE)
        run("one")
    return folder


@pytest.fixture(autouse=True)
def runs(first, tmp_path, monkeypatch, unrendered):
    """Two runs of one scene that are equal."""
    shutil.copytree(first, tmp_path, dirs_exist_ok=True)
    shutil.copytree(first / "one", tmp_path / "other")
    monkeypatch.chdir(tmp_path)


def run(out, *options):
    main(["run", "scene.toml", "--steps", "4", "--out", out, "--quiet", "--no-pictures", *options])


def said(capsys, *arguments):
    capsys.readouterr()
    main(["compare", *arguments])
    return capsys.readouterr().out


def compared(capsys, *arguments):
    return json.loads(said(capsys, *arguments, "--json"))


def test_a_run_equals_itself_made_again(capsys):
    run("again")
    found = compared(capsys, "one", "again")
    assert found["equal"] is True and not found["scene"] and not found["metrics"]
    assert all(field["greatest"] == 0.0 for field in found["last_state"]["fields"].values())
    out = said(capsys, "one", "again")
    assert out.endswith("The two runs are equal.\n") and "bit for bit" in out


def test_differences_are_numbers_with_units(capsys):
    run("faster", "--set", "fluid.0.velocity=[0.5,0]", "--precision", "float64")
    found = compared(capsys, "one", "faster")
    assert found["equal"] is False
    assert found["scene"] == {"fluid.0.velocity": [[0.0, 0.0], [0.5, 0.0]]}
    assert found["settings"] == {"precision": ["float32", "float64"]}
    ends = [Trajectory.load(f"{name}/trajectory.vtkhdf")[-1] for name in ("one", "faster")]
    apart = np.linalg.norm(ends[0].positions.astype(float) - ends[1].positions, axis=1)
    positions = found["last_state"]["fields"]["positions"]
    assert positions["greatest"] == pytest.approx(apart.max()) and positions["unit"] == "m"
    assert positions["root_mean_square"] == pytest.approx(np.sqrt((apart**2).mean()))
    out = said(capsys, "one", "faster")
    assert "fluid.0.velocity: [0.0, 0.0] | [0.5, 0.0]" in out and f"at most {apart.max():.3g} m (particle" in out
    assert out.endswith("The two runs differ.\n")


def test_another_machine_is_told_but_is_no_difference(capsys):
    assert not compared(capsys, "one", "other")["environment"]
    file = Path("other/environment.json")
    file.write_text(file.read_text().replace('"cortado": "', '"cortado": "9'))
    found = compared(capsys, "one", "other")
    assert found["equal"] is True and found["environment"]


def test_other_sizes_cannot_be_compared_one_by_one(capsys):
    run("finer", "--set", "discretisation.spacing=0.04")
    found = compared(capsys, "one", "finer")
    assert "cannot be compared one by one" in found["last_state"]["unlike"] and found["equal"] is False
    run("longer", "--steps", "5")
    found = compared(capsys, "one", "longer")
    assert found["metrics"]["lines"] == [4, 5] and found["last_state"]["times_s"] == pytest.approx([0.0084, 0.0105])
    assert found["equal"] is False


def test_one_metric_or_one_particle_is_enough(capsys):
    metrics = Path("other/metrics.jsonl")
    lines = metrics.read_text().splitlines()
    row = json.loads(lines[2])
    lines[2] = json.dumps({**row, "iterations": row["iterations"] + 2})
    metrics.write_text("\n".join(lines) + "\n")
    found = compared(capsys, "one", "other")
    assert found["metrics"] == {"first_different_line": 3, "greatest_difference": {"iterations": 2}}
    assert found["equal"] is False


def test_searches_can_be_compared_too(capsys):
    Path("task.toml").write_text(GOOD_TASK)
    easy = ["--set", "optimise.iterations=1", "--set", "optimise.check={}", "--quiet", "--no-pictures"]
    main(["optimise", "task.toml", "--out", "a", *easy])
    main(["optimise", "task.toml", "--out", "b", *easy, "--set", "optimise.learning_rate=0.1"])
    found = compared(capsys, "a", "b")
    assert found["last_state"] is None and "optimise.learning_rate" in found["settings"] and not found["equal"]
    assert "kind: 'optimise' | 'run'" in said(capsys, "a", "one")


def test_mistakes_are_sentences(capsys):
    for name, file, text in (("damaged", "scene.json", "{"), ("torn", "trajectory.vtkhdf", "nothing")):
        shutil.copytree("one", name)
        Path(name, file).write_text(text)
    for arguments, words in [
        (["one"], "RUN|DATA.csv is missing"),
        (["one", "absent"], "There is no run in "),
        (["one", "damaged"], "cannot be read"),
        (["one", "torn"], "torn"),
    ]:
        with pytest.raises(SystemExit, match="2"):
            main(["compare", *arguments])
        out, err = capsys.readouterr()
        assert_one_sentence(err.removesuffix("\n"))
        assert out == "" and words in err


# ---- times -------------------------------------------------------------------------------------------------------
def positions_at(name, time):
    trajectory = Trajectory.load(f"{name}/trajectory.vtkhdf")
    (k,) = np.flatnonzero(np.isclose(trajectory.times, time))
    return trajectory.positions[k].astype(float)


def test_states_of_other_times_are_not_subtracted(capsys):
    """The last ones that are at the same time are compared, and it is said at which."""
    run("longer", "--steps", "6")
    found = compared(capsys, "one", "longer")["last_state"]
    assert found["times_s"] == pytest.approx([0.0084, 0.0126]) and found["compared_at_s"] == pytest.approx(0.0084)
    assert found["fields"]["positions"]["greatest"] == 0.0
    out = said(capsys, "one", "longer")
    assert "last state at 0.0084 s | 0.0126 s, compared at 0.0084 s: positions the same bit for bit" in out
    assert out.endswith("The two runs differ.\n")


def test_runs_with_other_time_steps_are_compared_at_the_same_time(capsys):
    run("halved", "--steps", "7", "--set", "solver.time_step=0.00105")
    found = compared(capsys, "one", "halved")
    state = found["last_state"]
    assert state["compared_at_s"] == pytest.approx(0.0063)
    apart = np.linalg.norm(positions_at("one", 0.0063) - positions_at("halved", 0.0063), axis=1)
    assert state["fields"]["positions"]["greatest"] == pytest.approx(apart.max())
    assert found["metrics"] == {"unlike": "time steps of 0.0021 s and 0.00105 s cannot be compared one by one"}
    assert "metrics: time steps of 0.0021 s and 0.00105 s cannot be compared" in said(capsys, "one", "halved")


def test_runs_without_a_common_time_are_not_compared(capsys):
    run("other_times", "--steps", "3", "--set", "solver.time_step=0.0013")
    found = compared(capsys, "one", "other_times")
    assert not found["last_state"]["fields"] and "different times" in found["last_state"]["unlike"]
    assert found["equal"] is False
    assert "last state at 0.0084 s | 0.0039 s: these are different times" in said(capsys, "one", "other_times")


def test_a_run_that_lacks_its_last_frame_differs_by_it_alone(capsys):
    path = Path("other/trajectory.vtkhdf")
    Trajectory.load(path)[:-1].save(path)
    found = compared(capsys, "one", "other")
    assert found["equal"] is False and not found["result"] and not found["metrics"]
    assert found["last_state"]["compared_at_s"] == pytest.approx(0.0063)
