"""Sweeps: combinations, their folders and their table; interrupted, gone on with, and on workers."""

import csv
import json
import signal
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import cortado.cli.sweep
from bad_scenes import assert_refused, one_sentence
from bad_tasks import GOOD_TASK, TINY_SCENE
from cortado import InputError, Trajectory
from cortado import executors as of_dask
from cortado.cli import main
from cortado.cli.arguments import ALL_FRAMES
from cortado.cli.sweep import combinations, write_table
from cortado.files.terminal import Interrupted
from cortado.runs.sensor import from_csv
from dask_processes import scheduler

RATES = ("--set", "optimise.learning_rate=0.5,0.25")
FOUR = (*RATES, "--set", "problem.steps=4,5")
TASK = GOOD_TASK[: GOOD_TASK.index("[optimise.check]")]
"""Content with any result."""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, unrendered):
    (tmp_path / "scene.toml").write_text(TINY_SCENE)
    (tmp_path / "task.toml").write_text(TASK)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone")
    (folder / "task.toml").write_text(TASK)
    main(["sweep", str(folder / "task.toml"), *FOUR, "--out", str(folder / "all")])
    return folder / "all"


@pytest.fixture
def sweep(cortado_command):
    return partial(cortado_command, "sweep")


def rows(out):
    with open(Path(out) / "sweep.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_the_first_key_changes_slowest():
    found = combinations(["a=1,2", "b.c=[0, -9.81],[1,2]", "name='x,y'"])
    wanted = [[f"a={a}", f"b.c={c}", "name='x,y'"] for a in (1, 2) for c in ("[0, -9.81]", "[1,2]")]
    assert [one.overrides for one in found] == wanted


def test_values_that_go_together_are_no_product():
    found = combinations(["c=5,6"], zipped=["a=1,1", "b=3,4"])
    assert [one.overrides for one in found] == [[f"c={c}", "a=1", f"b={b}"] for c in (5, 6) for b in (3, 4)]
    assert [one.name for one in combinations([], zipped=["a=1,2", "b=3,4"])] == ["a=1,b=3", "a=2,b=4"]


COUNT = ",".join(map(str, range(400)))


@pytest.mark.parametrize(
    "options, zipped, words",
    [
        ([], ["a=1,2", "b=3"], "--zip gives 2 of a, 1 of b, but must give the same number of values for each"),
        (["a=1,2"], ["a=1,2"], "--zip gives a, which --set gives too"),
        ([f"a={COUNT}"], [f"b={COUNT}"], "makes 160,000"),
        ([], [], "--set is missing"),
        (["a=1,,2"], [], "--set is 'a=1,,2'"),
        (["a=1,2", "a=3"], [], "--set gives a twice"),
        (["a=1,2,1"], [], "must give each value of a once"),
    ],
)
def test_values_that_make_no_combinations_are_a_sentence(options, zipped, words):
    with one_sentence() as caught:
        combinations(options, zipped)
    assert words in str(caught.value)


def test_values_may_hold_commas_within_brackets_and_quotes():
    (one, other) = combinations(["fluid.0.upper=[[1, 2], {a = 3, b = ','}],[4]"])
    assert one.values == (("fluid.0.upper", "[[1, 2], {a = 3, b = ','}]"),) and other.values[0][1] == "[4]"


def test_folders_have_names_of_their_own_that_say_what_is_in_them():
    plain, strange, other, long = (
        combinations([option])[0].name for option in ("solver.time_step=1e-3", "a=[1, 2]", "a=[1; 2]", f"a={'x' * 300}")
    )
    assert plain == "solver.time_step=1e-3"
    assert strange.startswith("a=_1,_2_-") and other.startswith("a=_1_2_-") and strange != other
    assert len(long) < 140 and len({strange, other, long}) == 3
    assert combinations(["a=../../b"])[0].name.count("/") == 0
    assert combinations(["a=2,[1, 2]"])[1].name == strange, "whatever else is swept"


def test_what_sensors_read_is_in_the_table(sweep):
    Path("sensed.toml").write_text(TINY_SCENE + '[[sensor]]\nkind = "wall_force"\nname = "walls"\n')
    options = ("--set", "phase.0.viscosity=10,5", "--steps", "3", "--no-pictures", "--out", "sensed")
    assert sweep("sensed.toml", *options)[0] == 0
    for row in rows("sensed"):
        read = from_csv(Path("sensed") / row["folder"] / "sensors.csv")["walls"]
        found = {what: float(row[f"sensors.walls.force_y.{what}"]) for what in ("last", "mean", "greatest")}
        assert found["last"] == read["force_y"][-1] and abs(found["greatest"]) == np.abs(read["force_y"]).max() > 0.0
        assert found["mean"] == np.trapezoid(read["force_y"], read.times) / np.ptp(read.times)


def test_the_table_keeps_the_order_whatever_has_ended(tmp_path):
    done = {"loss": 0.5, "error": {"g": 0.25}, "x": [1.0, 2.0], "many": [0.0] * 50, "failures": []}
    failed = {"steps": 3, "failures": ["It fell, and broke.", "Twice."]}
    write_table(tmp_path, combinations(["a=1,2,3"]), {2: done, 0: failed})
    first, second = rows(tmp_path)
    assert (first["folder"], first["a"], first["status"], first["steps"]) == ("a=1", "1", "failed", "3")
    assert first["failures"] == "It fell, and broke. Twice." and first["loss"] == ""
    assert (second["status"], second["loss"], second["error.g"], second["x"]) == ("done", "0.5", "0.25", "[1.0, 2.0]")
    assert "many" not in second and list(second)[-1] == "failures"


def test_a_task_is_optimised_with_every_combination(alone, folder):
    found = rows(alone)
    chosen = [(row["optimise.learning_rate"], row["problem.steps"]) for row in found]
    assert chosen == [("0.5", "4"), ("0.5", "5"), ("0.25", "4"), ("0.25", "5")]
    assert {row["status"] for row in found} == {"done"} and all(float(row["loss"]) < 1e-7 for row in found)
    first = ["--set", "optimise.learning_rate=0.5", "--set", "problem.steps=4"]
    main(["optimise", "task.toml", "--no-pictures", *first, "--out", "one"])
    member = alone / found[0]["folder"]
    for name in ("metrics.jsonl", "result.json", "checkpoint/replay.log"):
        assert (member / name).read_bytes() == (folder / "one" / name).read_bytes(), name
    noted = json.loads((member / "environment.json").read_text())
    assert noted["command"][:2] == ["cortado", "optimise"] and "problem.steps=4" in noted["command"]


def test_a_scene_is_run_and_what_diverges_is_in_the_table(sweep, folder):
    code, out, err = sweep("scene.toml", "--set", "solver.time_step=0.001,0.2", "--steps", 6, "--out", "runs")
    assert (code, out) == (1, "")
    warning, sentence = err.splitlines()
    assert warning.startswith("Warning: solver.time_step=0.2: solver.time_step is 0.2 s, but the limit")
    assert sentence.startswith("Of 2 combinations 1 failed, the first of them solver.time_step=0.2: The simulation div")
    assert sentence.endswith(f" The table is {folder / 'runs' / 'sweep.csv'}, beside a folder for each.")
    good, bad = rows("runs")
    assert (good["status"], good["steps"], good["particles"], good["mean.iterations"]) == ("done", "6", "64", "3.0")
    assert bad["status"] == "failed" and bad["failures"].startswith("The simulation diverged in step 1: ")
    assert (folder / "runs" / "solver.time_step=0.2" / "report.html").exists()
    code, out, err = sweep("scene.toml", "--set", "solver.time_step=0.2,0.001,0.002", "--steps", 6, "--out", "runs")
    assert (code, out) == (1, "")
    assert err.startswith("Of 3 combinations, 2 of them there already, 1 failed, the first of them ")
    assert [row["status"] for row in rows("runs")] == ["failed", "done", "done"]


def test_an_interrupted_sweep_goes_on(sweep, folder, monkeypatch):
    optimise_task, begun = cortado.cli.sweep.optimise_task, []

    def stopped(*arguments):
        begun.append(arguments)
        if len(begun) == 2:
            raise Interrupted(signal.SIGINT, "the evaluations so far are somewhere; --resume goes on with them")
        return optimise_task(*arguments)

    monkeypatch.setattr(cortado.cli.sweep, "optimise_task", stopped)
    code, out, err = sweep("task.toml", *RATES, "--out", "all")
    wanted = f"Interrupted; 1 of 2 are finished, in {folder / 'all'}; the same command goes on with the rest.\n"
    assert (code, out, err) == (130, "", wanted)
    assert [row["folder"] for row in rows("all")] == ["optimise.learning_rate=0.5"]
    code, out, err = sweep("task.toml", *RATES, "--out", "all")
    assert (code, err) == (0, "") and out.startswith("Of 2 combinations, 1 of them there already, none failed; ")
    assert len(begun) == 3 and len(rows("all")) == 2


def test_another_task_is_not_gone_on_with(sweep, folder):
    assert sweep("task.toml", "--set", "optimise.learning_rate=0.5", "--out", "all")[0] == 0
    (folder / "task.toml").write_text(GOOD_TASK.replace("[0.0, -7.0]", "[0.0, -8.0]"))
    code, out, err = sweep("task.toml", *RATES, "--out", "all")
    assert (code, out) == (2, "") and "was begun with optimise.start.gravity = [0.0, -7.0]" in err
    assert not (folder / "all" / "optimise.learning_rate=0.25").exists()


def test_a_worker_that_does_not_see_the_folder_says_so(folder):
    asked = cortado.cli.sweep.RunRequest(folder / "elsewhere")
    member = cortado.cli.sweep.Member(folder / "task.toml", None, asked, ALL_FRAMES)
    with pytest.raises(InputError, match=r"^A worker does not see \S+elsewhere, but the task and the folder"):
        member(combinations(["problem.steps=4"])[0])


SIZE = "scene.toml --set solver.time_step=0.001"
RATED = f"task.toml {' '.join(RATES)}"


@pytest.mark.parametrize(
    "arguments, words",
    [
        (f"{RATED} --steps 5", "--steps is given, but must be left out"),
        ("task.toml --set optimise.learning_rate=0.5,-1", "optimise.learning_rate is -1"),
        (f"{RATED} --workers 2 --scheduler tcp://127.0.0.1:1", "--scheduler and --workers"),
        (f"{RATED} --scheduler tcp://127.0.0.1:1", "There is no scheduler at 'tcp://127.0.0.1:1'"),
        (f"{SIZE} --time 0", "--time is 0, but must be a number of sec"),
        (f"{RATED} --time 0.1", "--time is given, but must be left out, as the task says"),
        (f"{RATED} --fps 10", "--fps is given, but must be left out of a sweep of a task."),
        (f"{SIZE} --fps -1", "--fps is -1, but must be a number of frames"),
    ],
)
def test_wrong_arguments_are_refused(sweep, folder, monkeypatch, arguments, words):
    monkeypatch.setattr(of_dask, "REACHED", 0.2)
    assert_refused(sweep(*arguments.split(), "--out", "all"), words)
    assert not (folder / "all").exists()


def test_a_sweep_on_workers_has_the_same_bits(alone, sweep, folder):
    with scheduler(folder, workers=1) as processes:
        for out, where in (("far", ("--scheduler", processes.address)), ("near", ("--workers", 2))):
            assert sweep("task.toml", *FOUR, "--out", out, *where)[0] == 0
            assert (folder / out / "sweep.csv").read_bytes() == (alone / "sweep.csv").read_bytes()
            logs = sorted(path.relative_to(alone) for path in alone.glob("*/checkpoint/replay.log"))
            assert len(logs) == 4 and all(
                (folder / out / log).read_bytes() == (alone / log).read_bytes() for log in logs
            )


def ends(folder):
    return {path.parent.name: float(Trajectory.load(path).times[-1]) for path in Path(folder).glob("*/*.vtkhdf")}


def test_runs_of_several_time_steps_end_at_the_same_time(sweep):
    """So many steps of the smallest one, which is not the first."""
    code, _, err = sweep("scene.toml", "--set", "solver.time_step=0.001,0.002,0.0005", "--steps", 8, "--out", "runs")
    assert (code, err) == (0, "")
    assert sorted(int(row["steps"]) for row in rows("runs")) == [2, 4, 8]
    assert list(ends("runs").values()) == pytest.approx([0.004] * 3)


def test_runs_of_a_sweep_have_the_frames_that_are_asked_for(sweep):
    """And a sweep that asks for others is another one."""
    asked = ["scene.toml", "--set", "solver.time_step=0.001,0.002", "--time", 0.012, "--out", "runs", "--no-pictures"]
    assert sweep(*asked, "--fps", 250)[0] == 0
    for path in Path("runs").glob("*/*.vtkhdf"):
        assert Trajectory.load(path).times == pytest.approx([0.0, 0.004, 0.008, 0.012])
    code, _, err = sweep(*asked, "--record-every", 3)
    assert code == 2 and "fps" in err
    assert sweep(*asked[:-2], "others", "--record-every", 3, "--no-pictures")[0] == 0
    assert {len(Trajectory.load(path)) for path in Path("others").glob("*/*.vtkhdf")} == {5, 3}


def test_times_that_cannot_be_the_same_are_said(sweep):
    code, _, err = sweep("scene.toml", "--set", "solver.time_step=0.001,0.0015", "--steps", 4, "--out", "runs")
    assert code == 0
    assert err.startswith("Warning: not all combinations end at 0.004 s") and "0.0015 ends at 0.0045 s" in err
