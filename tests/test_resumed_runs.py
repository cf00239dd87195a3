"""``cortado run`` that goes on: after a kill, at any moment, from a state of another run; and frames by time."""

import json
from pathlib import Path

import numpy as np
import pytest

import cortado.cli.commands.run as run_recording
from bad_scenes import assert_one_sentence
from cortado import InputError, Simulation, Trajectory, load_scene
from cortado.runs.frame_file import Marks

SCENE = """
name = "gauged dam"
dimension = 2
[discretisation]
spacing = 0.1
[[phase]]
name = "water"
rest_density = 1000.0
viscosity = 0.05
[[fluid]]
shape = "box"
lower = [0.0, 0.0]
upper = [0.5, 0.8]
phase = "water"
[container]
shape = "box"
lower = [0.0, 0.0]
upper = [1.2, 1.0]
[[sensor]]
name = "gauge"
kind = "wave_gauge"
position = [0.25, 0.0]
[solver]
kind = "projection"
time_step = 0.004
[schedule.gravity]
times = [0.0, 0.2]
values = [[0.0, -9.81], [3.0, -9.81]]
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    (tmp_path / "scene.toml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cortado.cli.commands.run.write_run_report", lambda *_: None)
    return tmp_path


def files(run):
    """What a run left, but for where and how fast it ran."""
    found = Trajectory.load(Path(run) / "trajectory.vtkhdf")
    arrays = {name: getattr(found, name) for name in ("times", "steps", "positions", "velocities")}
    arrays |= {**found.diagnostics, **found.others, **found.constants, **found.quantities}
    texts = [(Path(run) / name).read_text() for name in ("metrics.jsonl", "sensors.csv", "result.json")]
    return arrays, texts


def assert_same_files(one, other):
    (arrays, texts), (others, other_texts) = files(one), files(other)
    assert arrays.keys() == others.keys() and texts == other_texts
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, others[name], err_msg=name)


class Killed(BaseException):
    """A process that is gone: nothing is written any more."""


def killed_after(step, monkeypatch, every=0.0):
    """End the next run after a step, with notes at every step or, as in a short run, none."""
    whole = run_recording.Notes.now_and_then

    def now_and_then(notes, number):
        whole(notes, number)
        if number == step:
            monkeypatch.setattr(run_recording.Notes, "write", lambda _: None)
            monkeypatch.setattr("cortado.runs.run_folder.RunFolder.write_metrics", lambda *_: None)
            raise Killed

    monkeypatch.setattr(run_recording, "OFTEN", every)
    monkeypatch.setattr(run_recording, "SHARE", 0.0)
    monkeypatch.setattr(run_recording.Notes, "now_and_then", now_and_then)


@pytest.mark.parametrize(
    ("options", "begins"),
    [
        (["--steps", 23], "It goes on after step 12."),
        (["--steps", 23, "--record-every", 5, "--record", "pressure"], "It goes on after step 10."),
        (["--time", 0.4, "--set", "solver.time_step=auto"], "It goes on after step 12."),
        (["--steps", 23, "--set", "solver.time_step=auto", "--fps", 60, "--precision", "float64"], None),
        (["--steps", 23, "--set", "solver.kind=pcisph"], "It goes on after step 12."),
    ],
    ids=["each step", "some steps", "a time", "fps", "pcisph"],
)
def test_a_killed_run_goes_on_bit_for_bit(cortado_command, options, begins):
    assert cortado_command("run", "scene.toml", "--out", "whole", *options)[0] == 0
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
        killed_after(12, patch)
        cortado_command("run", "scene.toml", "--out", "dam", *options)
    assert len(Trajectory.load("dam/trajectory.vtkhdf")) < len(Trajectory.load("whole/trajectory.vtkhdf"))
    code, out, err = cortado_command("run", "scene.toml", "--out", "dam", *options, "--resume")
    assert (code, err) == (0, "") and "the last " in out
    assert begins is None or out.splitlines()[0] == begins
    assert_same_files("whole", "dam")


def test_what_was_not_noted_is_computed_again(cortado_command):
    """The frames of a run that was killed are there, but not what its sensors read: it begins anew."""
    options = ["--steps", 8]
    cortado_command("run", "scene.toml", "--out", "whole", *options)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
        killed_after(5, patch, every=1e9)
        cortado_command("run", "scene.toml", "--out", "dam", *options)
    code, out, _ = cortado_command("run", "scene.toml", "--out", "dam", *options, "--resume")
    assert code == 0 and out.splitlines()[0] == "No step of it is known: it begins anew."
    assert_same_files("whole", "dam")


def test_a_run_that_has_ended_goes_on_to_its_pictures(cortado_command):
    cortado_command("run", "scene.toml", "--out", "whole", "--steps", 6)
    cortado_command("run", "scene.toml", "--out", "dam", "--steps", 6)
    code, out, err = cortado_command("run", "scene.toml", "--out", "dam", "--steps", 6, "--resume")
    assert (code, err) == (0, "") and out.splitlines()[0] == "It goes on after step 6."
    assert_same_files("whole", "dam")


@pytest.mark.parametrize("place", ["first", "first/trajectory.vtkhdf"])
def test_a_run_begins_at_the_end_of_another(cortado_command, place):
    cortado_command("run", "scene.toml", "--out", "whole", "--steps", 10)
    cortado_command("run", "scene.toml", "--out", "first", "--steps", 6)
    code, _, err = cortado_command("run", "scene.toml", "--out", "rest", "--steps", 4, "--state", place)
    assert (code, err) == (0, "")
    whole, rest = (Trajectory.load(f"{run}/trajectory.vtkhdf") for run in ("whole", "rest"))
    np.testing.assert_array_equal(rest.positions, whole.positions[6:])
    np.testing.assert_array_equal(rest.times, whole.times[6:])
    np.testing.assert_array_equal(rest.steps, whole.steps[6:])
    again = ["--out", "rest", "--steps", 4, "--resume", "--state"]
    assert cortado_command("run", "scene.toml", *again, place)[0] == 0
    code, _, err = cortado_command("run", "scene.toml", *again, "whole")
    assert code == 2 and "state" in err


def test_frames_come_at_a_rate(cortado_command):
    code, _, _ = cortado_command("run", "scene.toml", "--time", 0.2, "--fps", 50, "--out", "dam")
    times = Trajectory.load("dam/trajectory.vtkhdf").times
    assert code == 0 and len(times) == 11
    assert ((times - np.arange(11) / 50 >= -1e-9) & (times - np.arange(11) / 50 < 0.004)).all()
    assert json.loads(Path("dam/environment.json").read_text())["settings"]["fps"] == 50


def test_a_rate_is_kept_and_counts_from_where_a_run_begins(cortado_command):
    cortado_command("run", "scene.toml", "--steps", 5, "--fps", 29.97, "--out", "first")
    code, _, _ = cortado_command("run", "scene.toml", "--time", 0.1, "--fps", 50, "--out", "rest", "--state", "first")
    first, rest = (Trajectory.load(f"{run}/trajectory.vtkhdf") for run in ("first", "rest"))
    assert code == 0 and first.marks == Marks(0.0, 29.97) and rest.marks == Marks(first.times[-1], 50.0)
    late = rest.times - rest.marks.at(np.arange(6))
    assert (late >= -1e-9).all() and (late < 0.004).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--resume"], ["There is no run in"]),
        (["--resume", "--overwrite"], ["--resume", "--overwrite"]),
        (["--fps", "0"], ["--fps is 0, but must be"]),
        (["--fps", "nan"], ["--fps is nan, but must be"]),
        (["--fps", "30", "--record-every", "2"], ["--fps", "--record-every"]),
        (["--state", "nowhere"], ["There is no trajectory file nowhere"]),
        (["--state", "scene.toml"], ["cannot be read as a VTKHDF trajectory"]),
        (["--state", "."], ["There is no run in", "--state must be the folder of one"]),
    ],
)
def test_wrong_arguments_are_sentences(cortado_command, options, words):
    code, out, err = cortado_command("run", "scene.toml", "--steps", 2, "--out", "dam", *options)
    assert (code, out) == (2, "") and all(word in err for word in words), err
    assert_one_sentence(err.removesuffix("\n"))


def test_another_run_is_not_gone_on_with(cortado_command):
    cortado_command("run", "scene.toml", "--out", "dam", "--steps", 3)
    code, _, err = cortado_command("run", "scene.toml", "--out", "dam", "--steps", 4, "--resume")
    assert code == 2 and "steps" in err
    code, _, err = cortado_command("run", "scene.toml", "--out", "dam", "--steps", 3)
    assert code == 2 and "--resume" in err


def test_the_middle_of_a_run_has_no_backward_pass():
    rollout = Simulation(load_scene("scene.toml")).rollout(3)
    rollout.progress = run_recording.Progress(1, rollout.initial)
    with pytest.raises(InputError, match="keep is True"):
        rollout.forward(keep=True)
