"""The search of fits, on models that take no simulation; tasks with measured data, their command and mistakes."""

import errno
import json
import os
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from scipy.optimize import least_squares

import cortado
from bad_scenes import assert_one_sentence, one_sentence
from cortado.errors import CortadoError, CortadoWarning, DivergedError, InputError
from cortado.files.disk import read_columns
from cortado.measured import Experiment
from cortado.optimisation.fitting.gauss_newton import least, next_point, search
from cortado.optimisation.fitting.least_squares import Coordinates, LeastSquares, Weighting
from cortado.optimisation.solved_task import load_fit
from cortado.optimisation.task_files import load_task
from cortado.pictures.image_files import read_frames, write_picture
from cortado.pictures.video_files import write_video
from cortado.scene.parameters import Range

TIMES = np.linspace(0.0, 2.0, 40)
SIZE = 0.01
TRUE = {"size": np.array(2.0), "rate": np.array(1.5), "level": np.array(0.3)}


class Decay:
    """level + size exp(-rate t), in the place of an experiment."""

    start: ClassVar[dict[str, np.ndarray]] = {}

    def __init__(self, measured, greatest_rate=np.inf):
        self.observations = {"gauge": SimpleNamespace(times=TIMES, measured=measured, noise=SIZE)}
        self._greatest_rate = greatest_rate

    def predicted(self, values):
        if values["rate"] > self._greatest_rate:
            raise DivergedError(3, 0, "a slower rate")
        return {"gauge": (values["level"] + values["size"] * np.exp(-values["rate"] * TIMES))[:, None]}

    def linearised(self, values, directions):
        fade = np.exp(-values["rate"] * TIMES)
        slopes = {"size": fade, "rate": -values["size"] * TIMES * fade, "level": np.ones_like(TIMES)}
        columns = [sum(slopes[name] * change for name, change in one.items()) for one in directions]
        return self.predicted(values), {"gauge": np.stack(columns, axis=-1)[:, None, :]}


def problem(start, bounds=None, seed=0, wrong=0.0, **settings):
    noise = SIZE * np.random.default_rng(seed).standard_normal(len(TIMES)) + wrong * np.sin(9.0 * TIMES)
    experiment = Decay(Decay(noise).predicted(TRUE)["gauge"] + noise[:, None], **settings)
    return LeastSquares([experiment], Coordinates.of(start, ["size", "rate"], bounds))


def the_least(made):
    """Where SciPy's method of trust regions ends."""

    residuals = lambda u: (made.residuals(u)[0] / SIZE).ravel()  # noqa: E731
    return least_squares(residuals, made.coordinates.start, xtol=1e-14, ftol=1e-14, gtol=None).x


WEIGHTS = [Weighting(SIZE)]


@pytest.mark.parametrize("off", [1.3, 2.0, 10.0])
@pytest.mark.parametrize("wrong", [0.0, 0.5])
def test_it_ends_a_tenth_of_a_bar_from_the_least(off, wrong):
    made = problem({"size": 2.0 * off, "rate": 1.5 / off, "level": 0.1}, wrong=wrong)
    at, found = least(made, made.estimated(made.coordinates.start), WEIGHTS, 50)
    spent = made.runs + 2.3 * made.tangents
    J, _ = made.stacked(at, WEIGHTS)
    bars = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    assert found and (np.abs(at.u - the_least(made)) <= 0.1 * bars).all()
    assert spent == pytest.approx(18.2) if (off, wrong) == (1.3, 0.0) else spent <= 70.0
    assert at.residuals[0] == pytest.approx(made.residuals(at.u)[0], abs=0.03 * SIZE)


def test_bounds_are_kept():
    bounds = {"rate": (0.5, 1.2)}
    made = problem({"size": 1.0, "rate": 1.0, "level": 0.0}, bounds)
    at, found = least(made, made.estimated(made.coordinates.start), WEIGHTS, 50)
    assert found and made.coordinates.numbers(at.u)[1] == pytest.approx(1.2, rel=1e-12)
    lower, upper = made.coordinates.bounds
    point, gain = next_point(made, made.linearised(at.u), WEIGHTS)
    assert (lower <= point).all() and (point <= upper).all() and gain < 0.01


def test_a_step_to_where_the_run_diverges_is_made_shorter():
    made = problem({"size": 6.0, "rate": 0.2, "level": -3.0}, greatest_rate=1.7)
    at, found = least(made, made.estimated(made.coordinates.start), WEIGHTS, 50)
    assert found and made.coordinates.numbers(at.u) == pytest.approx([2.0, 1.5, 0.3], rel=0.1)


def test_a_search_holds_what_is_fixed_and_says_when_it_ran_out_of_trials():
    made = problem({"size": 4.0, "rate": 0.5, "level": 0.0})
    begun = made.estimated(made.coordinates.start)
    ended = search(made, begun, WEIGHTS, 30, 1e-6, fixed=[1])
    assert ended.converged and ended.next[1] == begun.u[1] and ended.next[0] != begun.u[0]
    assert not search(made, begun, WEIGHTS, 1, 1e-12).converged


STEP = 1e-6
"""Of differences, in the place of tangents."""


class Formula(Experiment):
    """What is predicted is a function of the logarithm u of one number."""

    start: ClassVar[dict[str, np.ndarray]] = {}
    unseen: ClassVar[dict[str, np.ndarray]] = {}

    def __init__(self, function, true, noise=SIZE, seed=0):
        self.__dict__["function"] = function
        measured = function(np.log(true)) + SIZE * np.random.default_rng(seed).standard_normal(len(TIMES))
        gauge = SimpleNamespace(times=TIMES, measured=measured[:, None], noise=noise, unit="m", start={})
        known = {"viscosity": SimpleNamespace(range=Range.POSITIVE)}
        held = SimpleNamespace(container=None)
        told = {"known": known, "scene": held, "parameters": lambda: {"rest_density": np.ones(1)}}
        self.__dict__ |= {"observations": {"gauge": gauge}, "simulation": SimpleNamespace(**told)}

    def predicted(self, values):
        return {"gauge": self.function(np.log(values["viscosity"]))[:, None]}

    def linearised(self, values, directions):
        u = np.log(values["viscosity"])
        slope = (self.function(u + STEP) - self.function(u - STEP)) / (2.0 * STEP)
        columns = [slope * one.get("viscosity", 0.0) / values["viscosity"] for one in directions]
        return self.predicted(values), {"gauge": np.stack(columns, axis=-1)[:, None, :]}


def behind_a_wall(u):
    """From below, the sum of squares rises to a wall at 0.5."""
    return np.exp(-np.exp(u) * TIMES) + 2.0 * np.exp(-((u - np.log(0.5)) ** 2)) * np.cos(9.0 * TIMES)


def even(u):
    """As likely at v as at 1 / v."""
    return 0.3 * u**2 * TIMES


def rough(u):
    """Wiggles whose slope is that of the trend three times, and which are far narrower than a standard error."""
    return 0.03 * u * TIMES + 0.001 * np.sin(90.0 * u + 3.0 * TIMES)


def test_a_start_in_a_wrong_local_minimum_is_left_and_a_good_one_costs_no_more():
    made = Formula(behind_a_wall, 2.0)
    alone = cortado.fit(made, {"viscosity": 0.1}, starts=1)
    assert alone.in_doubt and alone.values["viscosity"] < 0.5 and "in doubt" in repr(alone)
    found = cortado.fit(made, {"viscosity": 0.1})
    assert not found.in_doubt and found.values["viscosity"] == pytest.approx(2.0, rel=0.05)
    assert len(found.tried) > 1 and found.tried[0].end == pytest.approx(alone.u) and found.runs > alone.runs
    near = cortado.fit(made, {"viscosity": 1.5})
    assert len(near.tried) == 1 and near.runs <= 8 and near.u == pytest.approx(found.u, abs=0.01)


def test_minima_that_are_as_deep_are_a_doubt():
    found = cortado.fit(Formula(even, 3.0), {"viscosity": 2.0}, starts=4)
    assert len(found.tried) == 4
    (doubt,) = found.doubts
    other = 1.0 / found.values["viscosity"]
    assert f"viscosity is {other:.3g}" in doubt and "hardly decide between" in doubt
    assert_one_sentence(doubt)
    assert not cortado.fit(Formula(even, 3.0), {"viscosity": 2.0}, {"viscosity": (1.0, 100.0)}, starts=4).doubts


def test_a_start_from_where_runs_diverge_is_none():
    def diverges(u):
        if u > np.log(5.0):
            raise DivergedError(3, 0, "less")
        return behind_a_wall(u)

    found = cortado.fit(Formula(diverges, 2.0), {"viscosity": 0.1})
    assert not found.in_doubt and found.values["viscosity"] == pytest.approx(2.0, rel=0.05)


def test_bars_of_a_rough_model_are_those_of_its_trend():
    """Its tangents alone would make them a third as long."""
    slope, made = 0.03 * TIMES, [Formula(rough, 3.0, seed=seed) for seed in range(8)]
    noise = np.array([one.observations["gauge"].measured[:, 0] - rough(np.log(3.0)) for one in made])
    of_trend = np.log(3.0) + noise @ slope / (slope @ slope)
    fits = [cortado.fit(one, {"viscosity": 1.0}) for one in made]
    bars = np.array([np.sqrt(one.coordinate_covariance[0, 0]) for one in fits])
    assert all(one.converged for one in fits)
    assert 0.7 < np.median(bars) / (SIZE / np.linalg.norm(slope)) < 1.7
    assert (np.abs([one.u[0] for one in fits] - of_trend) < 1.5 * bars).all()


def test_what_is_hardly_told_is_a_doubt():
    found = cortado.fit(Formula(lambda u: 1e-4 * u * TIMES, 3.0), {"viscosity": 1.0}, starts=1)
    assert any("hardly determine viscosity" in one for one in found.doubts)


def test_what_is_explained_to_the_last_bit_is_not_doubted():
    made = Formula(behind_a_wall, 2.0)
    made.observations["gauge"].measured = made.predicted({"viscosity": np.array(2.0)})["gauge"]
    made.observations["gauge"].noise = None
    for start in (2.0, 1.5):
        found = cortado.fit(made, {"viscosity": start}, starts=3)
        assert not found.in_doubt and found.values["viscosity"] == pytest.approx(2.0, rel=1e-4)


def test_wrong_starts_are_a_sentence():
    with one_sentence("starts is"):
        cortado.fit(Formula(even, 3.0), {"viscosity": 2.0}, starts=0)


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


def test_on_a_full_disk_a_fit_says_so(task, tmp_path, cortado_command, monkeypatch, unrendered):
    replace = os.replace

    def refuse(old, new, **options):
        if Path(new).name == "result.json":
            raise OSError(errno.ENOSPC, "No space left on device")
        return replace(old, new, **options)

    monkeypatch.setattr(os, "replace", refuse)
    keys = ("fit.profiles=0", "fit.starts=1", "fit.iterations=1", "container.slip=free")
    quick = [word for key in keys for word in ("--set", key)]
    code, _, err = cortado_command("fit", task, "--out", tmp_path / "run", *quick)
    assert code == 1, err
    assert_one_sentence(err.removesuffix("\n").splitlines()[-1])
    assert "No space left on device" in err
    assert not list((tmp_path / "run").rglob(".*"))


def test_a_mistake_in_a_task_is_a_sentence(task):
    text = task.read_text()
    for old, new, words in [
        ("[fit]", "[optimise]", "fit is missing"),
        ('sensor = "left"', 'sensor = "middle"', "sensor is 'middle'"),
        ('file = "fit_heights_left.csv"', 'file = "none.csv"', "none.csv cannot be read"),
        ('name = "right gauge"', 'name = "left gauge"', "measured[1].name"),
        ("[problem]\n", '[problem]\nloss = "image"\n', "problem.loss is given"),
        ("start.viscosity = 1.0", "start.honey = 1.0", "fit.start.honey"),
    ]:
        task.write_text(text.replace(old, new, 1))
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
    with pytest.warns(CortadoWarning, match=r"frames of .* have 25 x 20 pixels, but 16 x 16 .* 80% of") as caught:
        read_frames(tmp_path, (16, 16), frame_rate=10.0)
    assert len(caught) == 1


TRACKS = "time,tracer,x,y\n0,1,0.1,0.1\n0,2,0.1,0.2\n0.04,1,0.1,0.1\n0.04,2,0.1,0.2\n"
SERIES = "time,height\n0.0,1\n0.04,2\n0.02,1\n0.06,1\n"


def test_a_table_that_says_two_things_is_a_sentence(task):
    scene, _ = task.read_text().split("[[problem.measured]]", 1)
    for given, text, words in [
        ("tracks", TRACKS + "0.04,2,0.3,0.2\n", "2 lines for tracer 2 at 0.04 s"),
        ("tracks", TRACKS + "0.08,,0.3,0.2\n", "line 6 has the tracer nan, but must have a number"),
        ("sensor", SERIES, "has the time 0.02 s after 0.04 s"),
        ("sensor", SERIES.replace("time", "height"), "has 2 columns 'height'"),
        ("sensor", SERIES.replace("0.02", ""), "line 4 has the time nan"),
        ("sensor", SERIES.replace("time", "time [ms]"), "has time in ms, but time must be in s"),
    ]:
        (task.parent / "table.csv").write_text(text)
        kind = 'kind = "tracks"' if given == "tracks" else 'kind = "sensor"\nsensor = "left"'
        measured = f'[[problem.measured]]\nname = "mine"\n{kind}\nfile = "table.csv"\n\n'
        task.write_text(f"{scene}{measured}[fit]\nstart.viscosity = 1.0\n")
        with one_sentence() as error:
            load_fit(task).experiments[0].experiment("cpu", "float32")
        assert words in str(error.value)


def test_a_sensor_is_fitted_to_a_table_with_the_names_of_sensors_csv(task):
    (one,) = load_fit(task).experiments
    plain = one.experiment("cpu", "float32").observations["left gauge"].measured
    table = task.parent / "fit_heights_left.csv"
    head, *lines = table.read_text().splitlines()
    assert head == "time,height"
    mixed = "".join(f"\n{line},{k}" for k, line in enumerate(lines))
    table.write_text(f"time [s],left.height [m],right.height [m]{mixed}\n")
    assert np.array_equal(one.experiment("cpu", "float32").observations["left gauge"].measured, plain)


def test_a_table_that_is_none_is_a_sentence(tmp_path):
    for text, words in [
        ("", "must have a line"),
        ("time,x\n0,1,2\n", "3 entries"),
        ("time,x\n0,one\n", "line 2, x is 'one'"),
    ]:
        (tmp_path / "table.csv").write_text(text)
        with one_sentence(words):
            read_columns(tmp_path / "table.csv")


def test_an_entry_may_be_left_out(tmp_path):
    (tmp_path / "table.csv").write_text("time, x\n0, 1\n1,\n")
    assert np.array_equal(read_columns(tmp_path / "table.csv")["x"], [1.0, np.nan], equal_nan=True)
