"""Run folders, their reports, and the progress lines that go with them."""

import base64
import io
import json
import os
import re
import shutil
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import cortado.runs.run_folder
from bad_tasks import TINY_SCENE
from cortado import InputError
from cortado.cli import main
from cortado.files.disk import unfinished
from cortado.files.terminal import track
from cortado.pictures.pages import Cloud, Section, particle_view, thinned, write_report, written
from cortado.runs.run_folder import RunFolder

SCENE = '{"name": "drop", "dimension": 2}'
COMMAND = ["cortado", "run", "drop.toml"]


def new_run(path, **options) -> RunFolder:
    return RunFolder.create(path, SCENE, COMMAND, **options)


def test_new_folder_says_what_ran_where(tmp_path):
    folder = new_run(tmp_path / "runs" / "drop", device="a small computer")
    environment = json.loads(folder.environment.read_text())
    assert json.loads(folder.scene.read_text())["name"] == "drop"
    assert environment["command"] == COMMAND and environment["device"] == "a small computer"
    assert environment["packages"]["numpy"] == np.__version__
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", environment["started"])
    assert sorted(os.listdir(folder.path)) == ["environment.json", "figures", "scene.json"]
    assert RunFolder.open(folder.path) == folder


def test_metrics_come_back_and_a_torn_line_is_left_out(tmp_path):
    folder = new_run(tmp_path / "a")
    assert folder.read_metrics() == []
    folder.append_metrics(step=1, loss=np.float32(0.5), gravity=np.array([0.0, -9.5]))
    folder.append_metrics(step=2, loss=float("nan"))
    with open(folder.metrics, "a") as file:
        file.write('{"step": 3, "lo')
    lines = folder.read_metrics()
    assert lines[0] == {"step": 1, "loss": 0.5, "gravity": [0.0, -9.5]}
    assert [line["step"] for line in lines] == [1, 2] and np.isnan(lines[1]["loss"])

    RunFolder.resume(folder.path, SCENE, COMMAND).append_metrics(step=3)
    assert [line["step"] for line in folder.read_metrics()] == [1, 2, 3]

    folder.metrics.write_text("torn{\n{}\n")
    with pytest.raises(InputError, match="not JSON"):
        folder.read_metrics()


def test_a_folder_with_a_run_is_refused_unless_overwritten(tmp_path):
    folder = new_run(tmp_path / "a")
    folder.append_metrics(step=1)
    (folder.path / "notes.txt").write_text("mine")
    (folder.figures / "holiday.png").write_text("mine")
    (folder.figures / "loss.png").write_text("")
    (folder.checkpoint / "1").mkdir(parents=True)
    for place in (folder.checkpoint, folder.checkpoint / "1"):
        (place / "replay.log").write_text("")
    with pytest.raises(InputError, match=r"--out, or replace the run with --overwrite, or .* --resume\.$"):
        new_run(folder.path)
    with pytest.raises(InputError, match=r"--overwrite\.$"):
        new_run(folder.path, kind="optimise")
    new_run(tmp_path / "b", kind="optimise")
    for kind, words in (("optimise", "--resume"), ("run", r"--overwrite\.$")):
        with pytest.raises(InputError, match=words):
            new_run(tmp_path / "b", kind=kind)
    assert folder.read_metrics() == [{"step": 1}]
    new_run(folder.path, overwrite=True)
    assert folder.read_metrics() == [] and not folder.checkpoint.exists()
    assert os.listdir(folder.figures) == ["holiday.png"]
    assert (folder.figures / "holiday.png").read_text() == "mine"
    assert (folder.path / "notes.txt").read_text() == "mine"


def test_files_of_somebody_else_are_never_overwritten(tmp_path):
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "holiday.png").write_text("")
    with pytest.raises(InputError, match="no run of Cortado"):
        new_run(tmp_path, overwrite=True)
    assert os.listdir(tmp_path / "figures") == ["holiday.png"]
    for place in ("holiday.png", "holiday.png/below"):
        with pytest.raises(InputError, match="cannot be written"):
            new_run(tmp_path / "figures" / place)


def test_a_folder_of_several_runs_or_of_the_user_is_refused(tmp_path, monkeypatch):
    new_run(tmp_path / "runs" / "a")
    with pytest.raises(InputError, match="contains other runs, such as a; choose another --out"):
        new_run(tmp_path / "runs", overwrite=True)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    for path in (".", "", "..", tmp_path):
        with pytest.raises(InputError, match="is or contains the current folder; choose another --out"):
            new_run(path)
    assert sorted(os.listdir(tmp_path)) == ["runs", "work"] and not os.listdir(tmp_path / "work")


def test_resume_needs_the_same_scene_and_is_noted(tmp_path):
    folder = new_run(tmp_path / "a")
    with pytest.raises(InputError, match="begun with dimension = 2 and is now given dimension = 3; "):
        RunFolder.resume(folder.path, '{"name": "drop", "dimension": 3}', COMMAND)
    RunFolder.resume(folder.path, '{"dimension": 2, "name": "drop"}', [*COMMAND, "--resume"])
    environment = json.loads(folder.environment.read_text())
    assert environment["command"] == COMMAND
    assert [session["command"] for session in environment["resumed"]] == [[*COMMAND, "--resume"]]
    with pytest.raises(InputError, match="no run in"):
        RunFolder.resume(tmp_path / "b", SCENE, COMMAND)


DAMAGE = {
    "deep": lambda path: path.write_text("[" * 100_000 + "\n"),
    "pipe": os.mkfifo,
    "huge": lambda path: (path.write_bytes(b"{}\n"), os.truncate(path, 2**40)),
}


@pytest.mark.parametrize("name", ["scene.json", "environment.json", "metrics.jsonl"])
@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_folder_is_a_sentence(tmp_path, name, damage):
    folder = new_run(tmp_path / "a")
    path = folder.path / name
    path.unlink(missing_ok=True)
    DAMAGE[damage](path)
    with pytest.raises(InputError, match=r"cannot be|no run in|not JSON"):
        RunFolder.resume(folder.path, SCENE, COMMAND).read_metrics()


def test_a_refused_resume_names_the_setting(tmp_path):
    target = {"gravity": np.array([0.0, -9.5])}
    settings = {"problem": {"steps": 20, "target": target}, "extinction_schedule": (0.5, 1.0)}
    folder = new_run(tmp_path / "a", kind="optimise", settings=settings)
    RunFolder.resume(folder.path, SCENE, COMMAND, kind="optimise", settings=settings)
    settings["problem"]["target"] = {"gravity": np.array([0.0, -9.8])}
    words = r"problem\.target\.gravity = \[0\.0, -9\.5\] and is now given problem\.target\.gravity = \[0\.0, -9\.8\]"
    with pytest.raises(InputError, match=words):
        RunFolder.resume(folder.path, SCENE, COMMAND, kind="optimise", settings=settings)
    with pytest.raises(InputError, match=r"a run of `cortado optimise`, which `cortado run` cannot resume"):
        RunFolder.resume(folder.path, SCENE, COMMAND, kind="run")


class Killed(BaseException):
    """In place of a SIGKILL."""


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_kill_while_a_folder_is_made_leaves_one_to_overwrite_or_resume(tmp_path, monkeypatch, overwrite):
    """Killed at every file that is written, made or removed; what it left unfinished is removed."""
    events = [(Path, "unlink"), (Path, "mkdir"), (Path, "rmdir"), (cortado.runs.run_folder, "write_atomically")]

    def killing(function, left):
        def until_killed(*arguments, **options):
            if next(left, None) is None:
                raise Killed
            return function(*arguments, **options)

        return until_killed

    for moment in range(200):
        path = tmp_path / str(moment)
        if overwrite:
            old = new_run(path)
            old.append_metrics(step=1)
            (old.figures / "loss.png").write_text("")
        left = iter(range(moment))
        with monkeypatch.context() as patch:
            for owner, name in events:
                patch.setattr(owner, name, killing(getattr(owner, name), left))
            with suppress(Killed):
                new_run(path, overwrite=overwrite)
        finished = next(left, None) is not None
        if (path / "environment.json").exists():
            unfinished(path / "file").write_text("")
            assert RunFolder.resume(path, SCENE, COMMAND).figures.is_dir() and (path / "scene.json").exists()
            assert not [name for name in os.listdir(path) if name.endswith(".tmp")]
            unfinished(path / "figures" / "file").write_text("")
        else:
            assert not path.exists() or os.listdir(path) == []
        again = new_run(path, overwrite=True)
        assert again.read_metrics() == [] and os.listdir(again.figures) == []
        if finished:
            return
    raise AssertionError("Two hundred kills were not enough.")


def test_report_is_one_self_contained_escaped_page(tmp_path):
    folder = new_run(tmp_path / "a")
    picture = folder.figures / "loss.png"
    picture.write_bytes(b"\x89PNG pixels")
    table = Section("Numbers", head=("", "value"), rows=[("loss & more", 0.25), ("x", "<script>")])
    path = write_report(folder, "a < b", [table, Section("P", figures=[("the <loss>", picture)]), Section("Nothing")])
    page = path.read_text()
    assert path == folder.report and "Nothing" not in page
    assert "<h1>a &lt; b</h1>" in page and '<th scope="row">loss &amp; more</th><td>0.25</td>' in page
    assert "<pre>cortado run drop.toml</pre>" in page
    assert "<script" not in page and "http" not in page
    assert "data:image/png;base64,iVBORyBwaXhlbHM=" in page and "the &lt;loss&gt;" in page
    assert "&quot;drop&quot;" in page
    with pytest.raises(InputError, match=r"absent\.png"):
        write_report(folder, "t", [Section("P", figures=[("c", folder.figures / "absent.png")])])


def test_a_view_in_a_report_holds_its_particles_and_no_network(tmp_path):
    random = np.random.default_rng(0)
    positions = random.uniform(size=(300, 200, 3))
    speeds = random.uniform(size=(300, 200))
    chosen, stride = thinned(300, 200, numbers=14, most_bytes=100_000)
    clouds = [Cloud(name, positions[chosen], speeds[chosen]) for name in ("found", "</script>")]
    view = particle_view(clouds, chosen * 0.01, 0.1, lines=[[[0, 0, 0], [2, 1, 1]]], stride=stride)
    assert len(view) < 150_000 and view.count("</script>") == 1
    few, every = thinned(30, 5000, numbers=5, most_bytes=100_000)
    some = np.zeros((30, 5000, 2))[few, ::every]
    small = particle_view([Cloud("a", some, some[..., 0])], few, 0.1, stride=every)
    assert len(small) < 160_000 and "One particle in 6 is shown." in small
    data = json.loads(view.partition('"application/json">')[2].partition("</script>")[0])
    assert data["particles"] == 200 and data["times"][-1] == 2.99 and data["half"] == [1.0, 0.5, 0.5]
    frames = len(data["times"])
    stored = np.frombuffer(base64.b64decode(data["clouds"][0]["positions"]), "<i2").reshape(frames, 200, 3)
    np.testing.assert_allclose(stored[-1] / 32767 * data["half"] + [1.0, 0.5, 0.5], positions[-1], atol=1e-4)
    page = write_report(new_run(tmp_path / "a"), "t", [Section("V", view=view)]).read_text()
    assert "http" not in page and page.count("function show(element)") == 1


def test_numbers_are_written_out_or_counted():
    long = np.linspace(0.0, 1.0, 400).reshape(200, 2)
    assert [written(value) for value in (0.123456789, 7, "word")] == ["0.123457", "7", "word"]
    assert [written(value) for value in ([1.5, -9.81], [[1.0, 2.0], [3.0, 4.0]])] == ["(1.5, -9.81)", "(1, 2); (3, 4)"]
    assert written(long) == "200 × 2 numbers from 0 to 1, in result.json"


def test_progress_on_a_file_is_a_line_now_and_then():
    quiet, chatty = io.StringIO(), io.StringIO()
    with track(50, "run", stream=quiet) as advance:
        for _ in range(50):
            advance(loss=1.0)
    with track(4, "run", stream=chatty, interval=0.0) as advance:
        advance(loss=0.123456)
        advance(3)
    assert quiet.getvalue() == ""
    assert chatty.getvalue() == "run 1/4, loss 0.1235\nrun 4/4, 0:00:00 left\n"


@pytest.mark.parametrize(
    ("times", "number", "lines"),
    [
        (range(0, 120, 30), 2, ["run 1/2", "run 2/2, 0:00:00 left", "run 3"]),
        ([0.0, 60.0, 61.0, 62.0], 10, ["run 1/10", "run 2/10, 0:00:08 left", "run 3/10, 0:00:07 left"]),
    ],
)
def test_the_time_left_is_that_of_what_is_left(monkeypatch, times, number, lines):
    """None after more than was expected, as of an optimiser that evaluates more than once an iteration; and compiling,
    which the first step waits for, is not counted."""
    seconds, chatty = iter(times), io.StringIO()
    monkeypatch.setattr("time.monotonic", lambda: float(next(seconds)))
    with track(number, "run", stream=chatty, interval=0.0) as advance:
        for _ in range(3):
            advance()
    assert chatty.getvalue().splitlines() == lines


def test_progress_on_a_terminal_is_a_bar_with_fields(monkeypatch):
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "120")
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    with track(4, "optimise", stream=terminal) as advance:
        advance(4, loss=0.123456)
    assert "optimise" in terminal.getvalue() and "4/4" in terminal.getvalue()
    assert "loss 0.1235" in terminal.getvalue()


NO_SCENES = {
    "pipe": (lambda path: (path.unlink(), os.mkfifo(path)), "it is a pipe, but must be a regular file"),
    "missing": (Path.unlink, "No such file"),
    "huge": (DAMAGE["huge"], "but must have at most"),
    "bytes": (lambda path: path.write_bytes(b"\xff\xfe{"), "is not valid JSON"),
    "list": (lambda path: path.write_text("[]"), "must be"),
    "field": (lambda path: path.write_text(path.read_text().replace('"dimension": 2', '"dimension": 7')), "dimension"),
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a run."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "scene.toml").write_text(TINY_SCENE)
    main(["run", str(folder / "scene.toml"), "--steps", "1", "--out", str(folder / "a"), "--no-pictures"])
    return folder / "a"


@pytest.fixture
def run(tmp_path, monkeypatch, finished):
    """The scene of a run that is there."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(finished, "a")
    return tmp_path / "a" / "scene.json"


@pytest.mark.parametrize("damage", NO_SCENES)
def test_a_run_whose_scene_cannot_be_read_is_a_sentence(run, cortado_command, damage):
    make, words = NO_SCENES[damage]
    make(run)
    for command in ("picture", "view"):
        code, out, err = cortado_command(command, "a")
        assert (code, out) == (2, "") and len(err.splitlines()) == 1
        assert str(run) in err and words in err


def test_a_run_that_is_there_is_not_warned_of_again(run, cortado_command):
    text = run.with_name("scene.json").read_text()
    run.write_text(text.replace('"time_step": 0.0021', '"time_step": 0.05'))
    with pytest.warns(cortado.CortadoWarning, match="limit of stability"):
        cortado.Scene.from_json(run.read_text())
    with warnings.catch_warnings():
        warnings.simplefilter("error", cortado.CortadoWarning)
        scene = RunFolder.open(run.parent).read_scene(["picture.width=100"])
    assert scene.solver.time_step == 0.05 and scene.picture.width == 100
    code, _, err = cortado_command("picture", "a", "--set", "picture.width=96")
    assert code == 0 and "Warning" not in err


def test_a_mesh_that_has_changed_since_is_told_of(tmp_path):
    """Pictures would show another solid than the fluid went around."""
    mesh = tmp_path / "ball.stl"
    mesh.write_bytes(b"a ball")
    made = json.dumps({**json.loads(SCENE), "solid": [{"name": "ball", "shape": "mesh", "file": str(mesh)}]})
    folder = RunFolder.create(tmp_path / "run", made, COMMAND)
    folder.require_files()
    mesh.write_bytes(b"a cube")
    with pytest.raises(InputError, match=r"ball.stl has changed since the run in .* restore the former file"):
        folder.require_files()
    with pytest.raises(InputError, match="has changed"):
        RunFolder.resume(folder.path, made, COMMAND)
    mesh.unlink()
    with pytest.raises(InputError, match=r"ball.stl is missing, but the run in"):
        folder.require_files()
