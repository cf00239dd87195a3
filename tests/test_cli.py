"""The command line: files, exit codes, sentences; kills and resumes."""

import errno
import json
import os
import re
from contextlib import contextmanager
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest

import cortado.cli.optimise
import cortado.cli.run
from bad_scenes import assert_one_sentence, assert_refused
from bad_tasks import GOOD_TASK, PARTICLES, PLANE_PICTURE, TINY_LATTE, TINY_SCENE
from cortado import Problem, Scene, Trajectory
from cortado.files.disk import locked
from cortado.files.vtkhdf import TrajectoryWriter
from cortado.optimisation.solved_task import TaskFigures
from cortado.optimisation.task_files import load_task
from cortado.optimisation.transforms import TimeInterpolation
from cortado.runs.run_folder import FIGURES
from full_disk import largest_file

ALWAYS = {"scene.json", "environment.json", "metrics.jsonl", "figures", "report.html", "result.json"}
RUN_FILES, OPTIMISE_FILES = {*ALWAYS, "trajectory.vtkhdf"}, {*ALWAYS, "checkpoint"}
BOTH = [["run", "scene.toml"], ["optimise", "task.toml"]]
COMMANDS = pytest.mark.parametrize("command", BOTH, ids=["run", "optimise"])


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, unrendered):
    (tmp_path / "scene.toml").write_text(TINY_SCENE)
    (tmp_path / "task.toml").write_text(GOOD_TASK)
    monkeypatch.chdir(tmp_path)
    # tests/test_shading.py draws them
    monkeypatch.setattr("cortado.cli.run_report.run_pictures", lambda *_: [])
    monkeypatch.setattr("cortado.optimisation.solved_task.shaded_figures", lambda *_: TaskFigures())
    return tmp_path


@pytest.fixture
def run(cortado_command):
    return lambda *more, out="dam": cortado_command("run", "scene.toml", "--out", out, *more)


@pytest.fixture
def optimise(cortado_command):
    return lambda *more, out="found": cortado_command("optimise", "task.toml", "--out", out, *more)


def sets(*overrides, prefix=""):
    return [word for override in overrides for word in ("--set", prefix + override)]


def assert_nothing_made(folder):
    assert {path.name for path in folder.iterdir()} == {"scene.toml", "task.toml"}


def result_of(run):
    return json.loads((Path(run) / "result.json").read_text())


def stopped(*_, **__):
    raise KeyboardInterrupt


def metrics(run):
    return [json.loads(line) for line in (Path(run) / "metrics.jsonl").read_text().splitlines()]


@pytest.mark.usefixtures("rendered")
def test_run_writes_its_folder(run, folder):
    code, out, err = run("--steps", 4)
    assert (code, err) == (0, "")
    assert {path.name for path in Path("dam").iterdir()} == RUN_FILES
    assert out.splitlines()[-1].startswith(f"The results are in {folder / 'dam'}")
    trajectory = Trajectory.load("dam/trajectory.vtkhdf")
    assert trajectory.positions.shape == (5, PARTICLES, 2) and trajectory.positions.dtype == np.float32
    assert [row["step"] for row in metrics("dam")] == [1, 2, 3, 4]
    assert json.loads(Path("dam/environment.json").read_text())["device"] == "cpu"
    report = Path("dam/report.html").read_text()
    assert report.count("<img") == 2 and "third axis" not in report


def test_options_of_run_and_the_scene_of_a_folder_give_the_same_run(run):
    overrides = sets("solver.time_step=0.002", "forces.gravity=[0,-5]")
    code, _, _ = run("--steps", 5, "--record-every", 2, "--precision", "float64", *overrides)
    scene = Scene.from_json(Path("dam/scene.json").read_text())
    assert code == 0 and (scene.solver.time_step, scene.forces.gravity) == (0.002, (0.0, -5.0))
    trajectory = Trajectory.load("dam/trajectory.vtkhdf")
    np.testing.assert_array_equal(trajectory.steps, [0, 2, 4, 5])
    np.testing.assert_allclose(trajectory.times, [0.0, 0.004, 0.008, 0.01])
    assert len(trajectory.iterations) == len(metrics("dam")) == 5
    again = cortado.Simulation(scene, precision="float64").run(5)
    np.testing.assert_array_equal(again.positions[[0, 2, 4, 5]], trajectory.positions)


def test_an_earlier_run_is_kept_unless_overwritten_and_other_files_are_never(run, folder):
    run("--steps", 2)
    assert_refused(run("--steps", 3), "already holds a run", "--overwrite")
    assert len(metrics("dam")) == 2
    assert run("--steps", 3, "--overwrite")[0] == 0
    assert len(metrics("dam")) == 3 and len(Trajectory.load("dam/trajectory.vtkhdf").times) == 4
    (folder / "figures").mkdir()
    assert_refused(run("--overwrite", out="."), "no run of Cortado")
    assert_refused(run(out="task.toml"), "cannot be written")
    assert Path("task.toml").read_text() == GOOD_TASK


@pytest.mark.usefixtures("rendered")
def test_a_run_that_diverges_says_where_and_keeps_its_frames(run):
    code, out, err = run("--steps", 20, *sets("fluid.0.velocity=[10,25]"))
    warning, sentence = err.splitlines()
    assert (code, out) == (1, "") and "limit of stability" in warning
    assert_one_sentence(sentence)
    frames = Trajectory.load("dam/trajectory.vtkhdf")
    lost = len(frames.times)
    assert 2 <= lost < 20 and np.isfinite(frames.positions).all()
    assert f"diverged in step {lost}: particle " in sentence and "left the container and was at (" in sentence
    assert "limits the time step to about" in sentence and sentence.endswith("dam.")
    assert {path.name for path in Path("dam").iterdir()} == RUN_FILES and len(metrics("dam")) == lost
    assert f'<p class="failed">The simulation diverged in step {lost}' in Path("dam/report.html").read_text()


def interrupting(after):
    """A progress bar under which Ctrl-C is pressed after so many steps, at once if there are fewer than 0."""

    @contextmanager
    def track(*arguments, **options):
        if after < 0:
            raise KeyboardInterrupt
        calls = iter(range(after))

        def advance(n=1, **fields):
            if next(calls, None) is None:
                raise KeyboardInterrupt

        yield advance

    return track


def test_an_interrupted_run_keeps_its_frames(run, monkeypatch):
    monkeypatch.setattr(cortado.cli.run, "track", interrupting(after=3))
    code, out, err = run("--steps", 20)
    assert (code, out) == (130, "")
    assert_one_sentence(err.removesuffix("\n"))
    there = Path("dam/trajectory.vtkhdf").absolute()
    assert err == f"Interrupted; the frames so far are in {there}; --resume goes on with them.\n"
    assert len(Trajectory.load("dam/trajectory.vtkhdf").times) == 5


@pytest.mark.parametrize(
    ("drawn", "missing"), [("run_pictures", set()), ("particles", {"report.html"})], ids=["pictures", "plain figures"]
)
def test_an_interrupt_while_pictures_are_drawn_leaves_the_run_whole(run, monkeypatch, drawn, missing):
    monkeypatch.setattr("cortado.cli.run_report.lacking", lambda _: None)
    monkeypatch.setattr(f"cortado.cli.run_report.{drawn}", stopped)
    code, _, err = run("--steps", 5)
    there = Path("dam").absolute()
    sentence = f"Interrupted; the run is whole, and in {there}; cortado picture {there} --film films it."
    assert (code, err.splitlines()[-1]) == (130, sentence)
    assert {path.name for path in there.iterdir()} == RUN_FILES - missing


def test_how_far_a_run_is_that_ends_at_a_time_is_told_in_percent(run, monkeypatch):
    told = []

    @contextmanager
    def track(*whole):
        told.append(whole)
        yield lambda n: told.append(n)

    monkeypatch.setattr(cortado.cli.run, "track", track)
    assert run("--time", 0.02, *sets("solver.time_step=auto"), "--no-pictures")[0] == 0
    assert told[0] == (100, "run, % of its time") and sum(told[1:]) == 100 and min(told[1:]) >= 0


@COMMANDS
def test_an_interrupt_before_anything_is_there_promises_nothing(cortado_command, monkeypatch, command):
    for module in (cortado.cli.run, cortado.cli.optimise):
        monkeypatch.setattr(module, "track", interrupting(after=-1))
    monkeypatch.setattr(cortado.cli.run, "frame_writer", interrupting(after=-1))
    assert cortado_command(*command, "--out", "dam") == (130, "", "Interrupted.\n")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("--steps 3", "--steps is "),
        ("walk", "walk is unknown, but must be one of gradients, new, "),
        ("rnu scene.toml", "rnu is unknown; run may be meant"),
        ("run secne.toml", "secne.toml: the scene cannot be read: No such file or directory; did you mean scene.toml?"),
        ("gradients", "a command is missing, one of check; see cortado gradients --help."),
        ("run scene.toml --steps 0", "steps is 0"),
        ("run scene.toml --record-every 0", "--record-every is 0"),
        ("run scene.toml --device cuda:99", "device is 'cuda:99'"),
        (f"run scene.toml --device {5000 * 'a'}", "aaa..., but must be one of"),
        ("run scene.toml --precision float16", "precision is 'float16'"),
        ("run scene.toml --set solver.timestep=0.1", "did you mean time_step?"),
        ("run .", "cannot be read"),
        ("run scene.toml --set phase.0.rest_density=0", "phase[0].rest_density"),
        ("optimise task.toml --set problem.steps=-1", "problem.steps"),
        ("run scene.toml --time -1", "--time is -1, but must be a number of seconds greater than 0."),
        ("run scene.toml --time 1 --steps 3", "--time is given, but must be left out, as --steps says how long"),
        ("run scene.toml --steps", "--steps is given without a value"),
        ("run scene.toml --seed 3", "--seed is no option here; see cortado run --help."),
        ("gradients check scene.toml --perturbation x", "--perturbation is 'x', but must be a number"),
        ("run scene.toml --set name=\udcff", "must be text in UTF-8"),
        ("optimise task.toml --resume --overwrite --out found", "exclude each other"),
        ("gradients check scene.toml --loss sum", "--loss is 'sum', but must be one of positions, "),
        ("picture run --film --frame 1", "--frame is given, but must be left out"),
        ("run scene.toml --set optimise.iterations=5", "optimise.iterations is given, but must be left out"),
    ],
)
def test_wrong_usage_is_refused(cortado_command, folder, line, words):
    assert_refused(cortado_command(*line.split(" ")), words)
    assert_nothing_made(folder)


@pytest.mark.usefixtures("rendered")
def test_optimise_writes_its_folder(optimise, folder):
    code, out, err = optimise()
    assert (code, err) == (0, "")
    assert out.splitlines()[-1].endswith(f"The results are in {folder / 'found'}; open report.html.")
    assert {path.name for path in Path("found").iterdir()} == OPTIMISE_FILES
    assert {path.name for path in Path("found/figures").iterdir()} == {"loss.png", "gravity.png", "particles.png"}
    losses = [row["loss"] for row in metrics("found")]
    assert len(losses) == 7 and losses[-1] < 0.5 * losses[0]


FELL = r"The loss fell .* times, from .* m² to .* m² .*\.\n  gravity: \(.*\) m/s²; true \(1\.5, -9\.81\) m/s²\n"


@pytest.mark.parametrize(
    ("command", "drawing", "told"),
    [
        (["run", "scene.toml", "--steps", 2], "run.write_run_report", r"2 steps of .* kg/m3\.\n"),
        (["optimise", "task.toml"], "optimise.solved_task.task_figures", FELL),
    ],
    ids=["run", "optimise"],
)
def test_what_came_out_is_told_before_it_is_drawn(cortado_command, monkeypatch, command, drawing, told):
    monkeypatch.setattr(f"cortado.cli.{drawing}", stopped)
    code, out, err = cortado_command(*command, "--out", "found")
    assert code == 130 and re.fullmatch(told, out), out
    assert ("the search has ended" in err and "--resume draws its pictures" in err) == (command[0] == "optimise")
    quiet = cortado_command(*command, "--out", "found", "--overwrite", "--quiet")
    assert quiet[:2] == (130, "")


@pytest.mark.parametrize(
    ("change", "settings", "told"),
    [
        ({"misled": True}, [], "The gradient disagrees with what steps of the search did. Over 20 steps the exact"),
        ({"misled": True}, ["optimise.gradient.name=adjoint_viscosity"], "search did: set optimise.optimiser = "),
        (
            {"stays": True},
            [],
            "If the search is in a wrong local minimum, try another start, fewer steps, or set opt",
        ),
        ({}, [], None),
    ],
)
def test_a_search_that_cannot_be_trusted_says_what_to_try(optimise, monkeypatch, change, settings, told):
    own = cortado.cli.optimise.optimise
    monkeypatch.setattr("cortado.cli.optimise.optimise", lambda *a, **o: replace(own(*a, **o), **change))
    _, out, _ = optimise("--no-pictures", *sets(*settings, "problem.steps=20"))
    report, found = Path("found/report.html").read_text(), result_of("found")
    assert {name: found[name] for name in ("misled", "stays")} == {"misled": False, "stays": False, **change}
    if told:
        assert told in out and told in unescape(report) and 'optimise.optimiser = "line_search"' in out
    else:
        assert "line_search" not in out


@pytest.mark.parametrize(
    ("text", "hard", "words"),
    [
        (GOOD_TASK, ["loss_reduction=1e9", "parameter_error=1e-9"], "asks for 1e+09 times. The parameter gravity is "),
        (PLANE_PICTURE, ["psnr=80"], " dB, but the task asks for 80 dB. "),
    ],
    ids=["parameters", "images"],
)
def test_an_optimisation_that_falls_short_fails_and_keeps_its_files(optimise, text, hard, words):
    Path("task.toml").write_text(text)
    code, out, err = optimise(*sets(*hard, prefix="optimise.check."))
    assert (code, len(err.splitlines())) == (1, 1) and out.startswith("The loss fell ")
    assert words in err and err.endswith("found.\n")
    assert {path.name for path in Path("found").iterdir()} == OPTIMISE_FILES


def test_a_search_goes_on_past_runs_that_diverge_and_says_so(optimise):
    far = ["--no-pictures", *sets("optimise.learning_rate=1e4")]
    code, out, _ = optimise(*far)
    optimise(*far, *sets("optimise.iterations=1"), out="part")
    optimise(*far, "--resume", out="part")
    refused = result_of("found")["refused"]
    assert code == 1 and refused > 0  # as it did not find what the task asks for
    assert f" in 7 evaluations and {refused} more that were refused" in out
    assert "The loss hardly fell: try an optimise.learning_rate that is 10 times as small" in out
    assert [row["refused"] for row in metrics("found")] == [0, *[refused] * 6]
    told = f"It refused {refused} steps, as runs diverged or parameters were out of their range."
    assert told in Path("found/report.html").read_text()
    for file in ("metrics.jsonl", "result.json", "checkpoint/replay.log"):
        assert Path("part", file).read_bytes() == Path("found", file).read_bytes()


def test_a_bad_target_is_named(optimise, folder):
    result = optimise(*sets("problem.target.gravity=[0,-1e30]"))
    assert_refused(result, "problem.target: parameter gravity has a value of size 1e+30")
    code, out, err = optimise(*sets("problem.target.gravity=[0,-1e6]"))
    assert (code, out) == (1, "") and "problem.target" in err and "learning rate" not in err
    assert_one_sentence(err.splitlines()[-1])
    assert_nothing_made(folder)


LONG = sets("optimise.iterations=60", "problem.steps=20")


def assert_same_optimisation(one, other):
    for name in ("metrics.jsonl", "checkpoint/replay.log"):
        assert (Path(one) / name).read_bytes() == (Path(other) / name).read_bytes()


SMOOTHED = ["name=adjoint_viscosity", "coefficient=3.0", "samples=4", "spread.gravity=0.1", "position_noise=0.001"]


@pytest.mark.parametrize(
    "text, estimator", [(GOOD_TASK, []), (GOOD_TASK, SMOOTHED), (TINY_LATTE, [])], ids=["exact", "averaged", "images"]
)
def test_an_interrupted_optimisation_resumes_bit_for_bit(optimise, monkeypatch, text, estimator):
    Path("task.toml").write_text(text)
    options = sets("check={}", *(f"gradient.{one}" for one in estimator), prefix="optimise.")
    with monkeypatch.context() as patch:
        patch.setattr(cortado.cli.optimise, "track", interrupting(after=1))
        assert optimise(*options, out="stopped")[0] == 130
    assert len(metrics("stopped")) == 2
    assert_refused(optimise(*options, out="stopped"), "--resume")
    code, resumed, _ = optimise(*options, "--resume", out="stopped")
    first, *found, _ = resumed.splitlines()
    _, whole, _ = optimise(*options, out="whole")
    assert code == 0 and first.startswith("The search goes on from iteration ") and found == whole.splitlines()[:-1]
    assert_same_optimisation("stopped", "whole")
    assert len(json.loads(Path("stopped/environment.json").read_text())["resumed"]) == 1


@pytest.mark.parametrize(
    ("text", "override", "words"),
    [
        (GOOD_TASK, "solver.time_step=0.002", "is now given solver.time_step = 0.002"),
        (GOOD_TASK, "optimise.start.gravity=[0,-6]", "is now given optimise.start.gravity = [0.0, -6.0]"),
        (PLANE_PICTURE, "problem.picture=rosetta", "is now given problem.picture = "),
        (TINY_LATTE, "optimise.knots=2", "is now given optimise.knots = "),
    ],
    ids=["step", "start", "picture", "knots"],
)
def test_a_changed_task_is_not_resumed(optimise, text, override, words):
    Path("task.toml").write_text(text)
    optimise(*sets("optimise.iterations=1"))
    before = metrics("found")
    code, out, err = optimise("--resume", *sets(override))
    assert (code, out, len(err.splitlines())) == (2, "", 1) and words in err
    assert len(before) == 2 and metrics("found") == before


def test_another_precision_is_not_resumed(optimise):
    optimise(*sets("optimise.iterations=1"))
    again = optimise("--resume", "--precision", "float64")
    assert_refused(again, "precision = 'float32' and is now given precision = 'float64'")


def test_run_and_optimise_do_not_go_on_with_each_other(run, optimise):
    run("--steps", 1)
    assert_refused(optimise("--resume", out="dam"), "a run of `cortado run`", "`cortado optimise` cannot resume")
    _, _, err = optimise(out="dam")
    assert "--overwrite" in err and "--resume" not in err


@COMMANDS
def test_a_folder_that_is_being_written_is_refused(cortado_command, command):
    with locked(Path("busy")):
        result = cortado_command(*command, "--out", "busy")
        assert_refused(result, "busy is being written by process", "--out")
        assert os.listdir("busy") == [".lock"]
    assert_refused(cortado_command(*command, "--out", "scene.toml"), "cannot be written")


@pytest.mark.parametrize("full", ["trajectory.vtkhdf", "metrics.jsonl", "run.mp4", "report.html"])
def test_frames_stay_when_a_disk_fills_up(run, monkeypatch, full):
    Path("scene.toml").write_text(TINY_LATTE.partition("[problem]")[0])
    replace, write = os.replace, TrajectoryWriter._write

    def until_full(writer, *arguments):
        return refuse() if writer.frames_written == 2 else write(writer, *arguments)

    if full == "trajectory.vtkhdf":
        monkeypatch.setattr(TrajectoryWriter, "_write", until_full)
    else:
        monkeypatch.setattr(os, "replace", lambda old, new: refuse() if Path(new).name == full else replace(old, new))
    code, out, err = run("--steps", 8)
    assert code == 1, err
    ended = full not in ("trajectory.vtkhdf", "metrics.jsonl")  # such a run is told before it is drawn
    assert out.startswith("8 steps of ") if ended else out == ""
    assert_one_sentence(err.removesuffix("\n"))
    assert "No space left on device" in err
    assert len(Trajectory.load("dam/trajectory.vtkhdf").times) == (2 if full == "trajectory.vtkhdf" else 9)
    assert not list(Path("dam").rglob(".*"))


def refuse():
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("size", [400, 3500])
def test_a_search_on_a_full_disk_says_so_and_goes_on(optimise, size):
    with largest_file(size):
        code, out, err = optimise(*LONG, out="full")
    assert (code, out) == (1, ""), err
    assert_one_sentence(err.removesuffix("\n"))
    assert "cannot be written" in err and "File too large" in err
    if not Path("full/environment.json").exists():
        assert os.listdir("full") == []
        return
    assert optimise(*LONG, "--resume", out="full")[0] == 0
    optimise(*LONG, out="whole")
    assert_same_optimisation("full", "whole")


def figures(run):
    """Names of the pictures, each of them one that is removed when the run is overwritten."""
    names = {path.name for path in (Path(run) / "figures").iterdir()}
    assert names <= set(FIGURES)
    return names


@pytest.mark.usefixtures("rendered")
def test_a_cup_is_swung_until_it_looks_as_it_should(optimise):
    Path("task.toml").write_text(TINY_LATTE)
    code, out, err = optimise()
    assert (code, err) == (0, "")
    assert "gravity is found with an error of " in out and "the image is matched to " in out
    found = result_of("found")
    knots, rows = found["knots"]["gravity"], np.array(found["parameters"]["gravity"])
    task = load_task("task.toml")
    ends = (0.5 * task.scene.solver.time_step, (task.problem.steps - 0.5) * task.scene.solver.time_step)
    np.testing.assert_allclose(knots["times"], np.linspace(*ends, 3))
    for values, course in ((knots["estimate"], rows), (knots["true"], task.true_parameters["gravity"])):
        np.testing.assert_allclose(TimeInterpolation(len(course), 3).parameter(np.array(values)), course, rtol=1e-9)
    assert [f"  gravity at {time:.4g} s: " in out for time in knots["times"]] == [True] * 3
    assert figures("found") == {"loss.png", "images.png", "progress.png", "gravity.png"} and len(metrics("found")) == 4
    page = Path("found/report.html").read_text()
    assert page.count("gravity at ") == 3 and page.count("<img") == 4 and "<video" not in page


def test_a_right_gradient_passes_the_check_in_words_and_in_json(cortado_command):
    code, out, err = cortado_command("gradients", "check", "scene.toml", "--steps", 3)
    assert (code, err) == (0, "") and "64 particles, 3 steps" in out and "WRONG" not in out
    assert sum(line.rstrip(" │").endswith("right") for line in out.splitlines()) == 6
    assert "The adjoint is right: reverse and forward mode agree to 1" in out
    assert out.endswith("For 3 steps use gradients.Exact().\n")
    code, out, _ = cortado_command("gradients", "check", "scene.toml", "--steps", 3, "--json")
    certificate = json.loads(out)
    assert code == 0 and certificate["right"] is True and certificate["wrong"] == []
    assert certificate["loss_changes"].keys() >= {"gravity", "initial_positions", "viscosity"}
    assert certificate["horizon"] == 3 and certificate["estimator"] == "Exact()"


@pytest.mark.usefixtures("rendered")
def test_the_check_writes_a_figure(cortado_command, folder):
    own = ("--loss", "image", "--out", "a/b", "--parameters", "gravity", "initial_velocities")
    code, out, err = cortado_command("gradients", "check", "scene.toml", "--steps", 2, *own)
    assert (code, err) == (0, "") and out.splitlines()[-1] == f"The results are in {folder / 'a' / 'b'}"
    assert {path.name for path in Path("a/b").iterdir()} == {"certificate.png", "certificate.json"}
    assert json.loads(Path("a/b/certificate.json").read_text())["right"] is True


@pytest.mark.usefixtures("rendered")
def test_a_planted_error_fails_the_check(cortado_command, monkeypatch):
    right = Problem.estimate

    def wrong(self, *arguments, **options):
        found = right(self, *arguments, **options)
        if "initial_velocities" in found.gradient:
            found.gradient["initial_velocities"][0, 1] *= -1.0
        return found

    monkeypatch.setattr(Problem, "estimate", wrong)
    code, out, err = cortado_command("gradients", "check", "scene.toml", "--steps", 3, "--out", "wrong")
    assert Path("wrong/certificate.png").exists()
    assert (code, err) == (1, "The adjoint is wrong for: initial_velocities.\n")
    assert json.loads(Path("wrong/certificate.json").read_text())["right"] is False and out.count("WRONG") == 2
