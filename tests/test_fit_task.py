"""Tasks with measured data: their files, their command, and mistakes in them."""

import errno
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest

from bad_scenes import assert_one_sentence, one_sentence
from cortado.errors import CortadoError, CortadoWarning, InputError
from cortado.files.disk import read_columns
from cortado.files.image_encoding import write_video
from cortado.optimisation.inverse.fit_task import load_fit
from cortado.optimisation.inverse.task import load_task
from cortado.pictures.image_files import read_frames, write_picture

RED, GREEN, BLUE, WHITE = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 1.0]
EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def task(tmp_path):
    """The example, with fewer particles."""
    for path in EXAMPLES.glob("fit_heights_*.csv"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    file = tmp_path / "task.toml"
    file.write_text((EXAMPLES / "fit_heights.toml").read_text("utf-8").replace("spacing = 0.02 ", "spacing = 0.026 "))
    return file


def test_a_fit_writes_its_numbers_and_its_report(task, tmp_path, cortado_command, unrendered):
    code, out, err = cortado_command("fit", task, "--out", tmp_path / "run", "--set", "fit.profiles=0")
    assert (code, err) == (0, "") and "viscosity " in out and "± " in out and "Pa s" in out
    found = json.loads((tmp_path / "run/result.json").read_text())
    assert found["lower_95"]["viscosity"] < found["parameters"]["viscosity"] < found["upper_95"]["viscosity"]
    report = (tmp_path / "run/report.html").read_text()
    assert "Residuals" in report and "standard error" in report and "left gauge" in report


@pytest.mark.parametrize("full", ["scene.json", "result.json", "residuals.png"])
def test_on_a_full_disk_a_fit_says_so(full, task, tmp_path, cortado_command, monkeypatch):
    replace = os.replace

    def refuse(old, new, **options):
        if Path(new).name == full:
            raise OSError(errno.ENOSPC, "No space left on device")
        return replace(old, new, **options)

    monkeypatch.setattr(os, "replace", refuse)
    code, _, err = cortado_command("fit", task, "--out", tmp_path / "run", "--set", "fit.profiles=0")
    assert code == 1, err
    assert_one_sentence(err.removesuffix("\n").splitlines()[-1])
    assert "No space left on device" in err
    assert not list((tmp_path / "run").rglob(".*"))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[fit]", "[optimise]", "fit is missing"),
        ('sensor = "left"', 'sensor = "middle"', "sensor is 'middle'"),
        ('file = "fit_heights_left.csv"', 'file = "none.csv"', "none.csv cannot be read"),
        ('name = "right gauge"', 'name = "left gauge"', "measured[1].name"),
        ("[problem]\n", '[problem]\nloss = "image"\n', "problem.loss is given"),
        ("start.viscosity = 1.0", "start.honey = 1.0", "fit.start.honey"),
        ('kind = "sensor"', 'kind = "scent"', "problem.measured[0].kind"),
    ],
)
def test_a_mistake_in_a_task_is_a_sentence(task, old, new, words):
    task.write_text(task.read_text().replace(old, new, 1))
    with one_sentence(error=CortadoError) as error:
        for one in load_fit(task).experiments:
            one.experiment("cpu", "float32")
    assert words in str(error.value)


def test_each_command_names_the_other(task):
    with pytest.raises(CortadoError, match="cortado fit"):
        load_task(task)
    with pytest.raises(CortadoError, match="cortado optimise"):
        load_fit(EXAMPLES / "identify.toml")


def test_the_film_of_another_program_shows_what_its_scene_begins_with():
    (one,) = load_fit(EXAMPLES / "fit_video.toml").experiments
    experiment = one.experiment("cpu", "float32")
    camera, simulation = experiment.observations["camera"], experiment.simulation
    assert camera.times == pytest.approx(np.arange(13) / 60.0, abs=1e-3)
    drawn, seen = simulation.renderer().render(simulation.positions), camera.measured[0].reshape(32, 64, 3)
    assert np.sqrt(np.mean((drawn - seen) ** 2)) < 0.04
    assert np.sqrt(np.mean((drawn[::-1] - seen) ** 2)) > 0.1  # upside down


def test_frames_of_a_folder_are_read(tmp_path):
    for k in range(4):
        write_picture(tmp_path / f"{k:02}.png", np.full((32, 48, 3), 0.2 + 0.1 * k))
    times, frames = read_frames(tmp_path, (24, 16), frame_rate=50.0)
    assert times == pytest.approx([0.0, 0.02, 0.04, 0.06]) and frames.shape == (4, 16, 24, 3)
    assert frames[:, 0, -1, 0] == pytest.approx([0.2, 0.3, 0.4, 0.5], abs=0.01)
    cropped = read_frames(tmp_path, (8, 8), crop=(24, 0, 48, 24), frame_rate=50.0, every=2)[1]
    assert len(cropped) == 2 and cropped[1] == pytest.approx(np.full((8, 8, 3), 0.4), abs=0.01)
    with pytest.raises(InputError, match="frame_rate is missing"):
        read_frames(tmp_path, (24, 16))
    with pytest.raises(InputError, match="must lie within the frames"):
        read_frames(tmp_path, (24, 16), crop=(0, 0, 49, 10), frame_rate=50.0)


@pytest.mark.parametrize(
    ("matrix", "shown"),
    [
        ((1, 0, 0, 1), [[RED, GREEN], [BLUE, WHITE]]),
        ((0, 1, -1, 0), [[BLUE, RED], [WHITE, GREEN]]),
        ((-1, 0, 0, -1), [[WHITE, BLUE], [GREEN, RED]]),
        ((0, -1, 1, 0), [[GREEN, WHITE], [RED, BLUE]]),
        ((-1, 0, 0, 1), [[GREEN, RED], [WHITE, BLUE]]),
    ],
)
def test_a_video_is_upright_as_players_show_it(tmp_path, matrix, shown):
    """As telephones turn what they film: a matrix in the box tkhd of ISO/IEC 14496-12."""
    path, picture = tmp_path / "a.mp4", np.repeat(np.repeat([[RED, GREEN], [BLUE, WHITE]], 16, 0), 24, 1)
    data = bytearray(write_video(path, [picture] * 2).read_bytes())
    begin = data.index(b"tkhd") + 44
    (a, b, c, d), one = matrix, 1 << 16
    data[begin : begin + 36] = struct.pack(">9i", a * one, b * one, 0, c * one, d * one, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    frames = read_frames(path, (24, 36) if b else (36, 24))[1]
    rows, columns = frames.shape[1:3]
    corners = frames[0][np.ix_([rows // 4, 3 * rows // 4], [columns // 4, 3 * columns // 4])]
    assert corners == pytest.approx(np.array(shown, dtype=float), abs=0.1)


def test_what_proportions_leave_out_is_said(tmp_path):
    for k in range(4):
        write_picture(tmp_path / f"{k}.png", np.full((20, 25, 3), 0.5))
    with pytest.warns(CortadoWarning, match=r"frames of .* have 25 x 20 pixels, but 16 x 16 .* 80% of it") as caught:
        read_frames(tmp_path, (16, 16), frame_rate=10.0)
    assert len(caught) == 1


TRACKS = "time,tracer,x,y\n0,1,0.1,0.1\n0,2,0.1,0.2\n0.04,1,0.1,0.1\n0.04,2,0.1,0.2\n"
SERIES = "time,height\n0.0,1\n0.04,2\n0.02,1\n0.06,1\n"


@pytest.mark.parametrize(
    ("kind", "text", "words"),
    [
        ("tracks", TRACKS + "0.04,2,0.3,0.2\n", "2 lines for tracer 2 at 0.04 s"),
        ("tracks", TRACKS + "0.040000000000001,2,0.3,0.2\n", "2 lines for tracer 2 at 0.04 s"),
        ("tracks", TRACKS + "0.08,,0.3,0.2\n", "line 6 has the tracer nan, but must have a number"),
        ("tracks", TRACKS + "nan,1,0.3,0.2\n", "line 6 has the time nan, but must have a number"),
        ("tracks", TRACKS.replace("tracer", "x", 1), "has 2 columns 'x'"),
        ("sensor", SERIES, "has the time 0.02 s after 0.04 s"),
        ("sensor", SERIES.replace("0.02", "0.04"), "has the time 0.04 s after 0.04 s"),
        ("sensor", SERIES.replace("time", "height"), "has 2 columns 'height'"),
        ("sensor", SERIES.replace("0.02", ""), "line 4 has the time nan"),
    ],
)
def test_a_table_that_says_two_things_is_a_sentence(task, kind, text, words):
    (task.parent / "table.csv").write_text(text)
    given = 'kind = "tracks"' if kind == "tracks" else 'kind = "sensor"\nsensor = "left"'
    scene, _ = task.read_text().split("[[problem.measured]]", 1)
    measured = f'[[problem.measured]]\nname = "mine"\n{given}\nfile = "table.csv"\n\n'
    task.write_text(f"{scene}{measured}[fit]\nstart.viscosity = 1.0\n")
    with one_sentence() as error:
        load_fit(task).experiments[0].experiment("cpu", "float32")
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [("", "must have a line"), ("time,x\n0,1,2\n", "3 entries"), ("time,x\n0,one\n", "line 2, x is 'one'")],
)
def test_a_table_that_is_none_is_a_sentence(tmp_path, text, words):
    (tmp_path / "table.csv").write_text(text)
    with one_sentence(words):
        read_columns(tmp_path / "table.csv")


def test_an_entry_may_be_left_out(tmp_path):
    (tmp_path / "table.csv").write_text("time, x\n0, 1\n1,\n")
    assert np.array_equal(read_columns(tmp_path / "table.csv")["x"], [1.0, np.nan], equal_nan=True)
