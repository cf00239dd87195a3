"""Paths of solids and gravity over time as tables: files with units, splines and ramps."""

import json
from pathlib import Path

import numpy as np
import pytest

from bad_scenes import one_sentence
from cortado import Scene, SceneError, Simulation, load_scene
from cortado.errors import InputError
from cortado.rollout.step_bounds import Travel
from cortado.runs.run_folder import RunFolder
from cortado.scene import courses as tables
from cortado.scene.courses import Knots
from cortado.scene.motions import courses
from cortado.scene.scene import files_named
from scenes import box, jet, plane, pool, pool_text, scene

COARSE = np.array([0.0, 0.7, 1.1, 1.3, 2.0])
"""Times of a table that is not sampled evenly [s]."""
EVENLY = np.linspace(0.0, 2.0, 4001)


def wave(times):
    """A displacement that is at rest at times 0, 1 and 2."""
    return np.stack([0.01 * (1.0 - np.cos(2.0 * np.pi * times)), 0.02 * np.sin(np.pi * times) ** 2], axis=-1)


def written(path, *columns, head):
    path.write_text(f"{head}\n" + "\n".join(",".join(map(repr, map(float, row))) for row in zip(*columns, strict=True)))
    return str(path)


def paddle(**keys):
    own = box([0.65, -0.2], [0.85, 0.9], **{"name": "paddle", "motion": "path", **keys})
    return pool([0.6, 0.3], [1.2, 0.9], solid=[own], discretisation={"spacing": 0.1})


# ---- splines and ramps -------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("interpolation", "order"), [("linear", 2), ("spline", 4)])
def test_a_path_of_a_sine_is_as_exact_as_its_interpolation(interpolation, order):
    errors = []
    for count in (40, 80, 160):
        times = np.linspace(0.0, 2.0, count + 1)
        errors.append(np.abs(Knots(times, wave(times), interpolation).at(EVENLY) - wave(EVENLY)).max())
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), order, atol=0.1)
    assert errors[0] < (1.3e-4 if order == 2 else 5e-7)


def test_a_spline_goes_through_its_values_with_a_smooth_velocity_and_rests_at_both_ends():
    knots, step = Knots(COARSE, wave(COARSE), "spline"), 1e-5
    np.testing.assert_allclose(knots.at(COARSE), wave(COARSE), atol=1e-15)
    np.testing.assert_array_equal(knots.rates(np.array([0.0, 2.0, 3.0])), 0.0)
    np.testing.assert_allclose(knots.at(np.array([5.0])), wave(COARSE[-1:]), atol=1e-16)
    inner = COARSE[1:-1]
    for before, after in ((inner - step, inner + step), (np.array([-step]), np.array([step]))):
        np.testing.assert_allclose(knots.rates(before), knots.rates(after), atol=1e-4)
    second = [(knots.rates(inner + side + step) - knots.rates(inner + side - step)) / step for side in (-0.001, 0.001)]
    np.testing.assert_allclose(*second, atol=0.02)
    assert np.abs(second[0]).max() > 0.5


@pytest.mark.parametrize("begun", [0.0, np.array([0.3, -0.1])], ids=["from 0", "from a place"])
@pytest.mark.parametrize("interpolation", ["linear", "spline"])
def test_a_ramp_multiplies_what_is_since_its_beginning_and_is_smooth_at_both_ends(interpolation, begun):
    values = np.array([0.3, -0.1]) + wave(COARSE)
    plain, ramped = (Knots(COARSE, values, interpolation, ramp, begun) for ramp in (0.0, 0.5))
    s = np.clip(EVENLY / 0.5, 0.0, 1.0)[:, None]
    wanted = begun + s**3 * (10.0 - 15.0 * s + 6.0 * s**2) * (plain.at(EVENLY) - begun)
    np.testing.assert_allclose(ramped.at(EVENLY), wanted, atol=1e-15)
    np.testing.assert_array_equal(ramped.at(EVENLY)[1000:], plain.at(EVENLY)[1000:])
    off = np.setdiff1d(EVENLY, COARSE)[1:-1] + 1e-4
    slope = (ramped.at(off + 1e-6) - ramped.at(off - 1e-6)) / 2e-6
    np.testing.assert_allclose(ramped.rates(off), slope, atol=1e-8)
    held = Knots(np.array([0.0]), np.array([1.0]), interpolation, 0.5)
    step = 1e-4  # the ramp itself: its first and second derivatives at its ends are 0
    for end in (0.0, 0.5):
        near = held.at(np.array([end - step, end, end + step]))
        assert np.abs(np.diff(near)).max() < 2e-9 and abs(near[0] - 2.0 * near[1] + near[2]) < 2e-9


# ---- files -------------------------------------------------------------------------------------------------------
def test_a_file_has_any_units_and_sampling_and_only_differences_from_its_first_line_count(tmp_path):
    shift, turn = 1e3 * wave(COARSE), 30.0 * COARSE
    head = "rotation [deg],time [ms],x [mm],y [cm]"
    file = written(tmp_path / "p.csv", 7.0 + turn, 1e3 * COARSE, 5.0 + shift[:, 0], 0.1 * shift[:, 1], head=head)
    own = paddle(path=file).solid[0]
    told = paddle(times=COARSE.tolist(), positions=own.middle() + wave(COARSE), rotations=np.radians(turn)).solid[0]
    for one, other in zip(courses(own), courses(told), strict=True):
        np.testing.assert_allclose(one.at(EVENLY), other.at(EVENLY), atol=1e-14)
    alone = written(tmp_path / "y.csv", COARSE / 60.0, 1e6 * wave(COARSE)[:, 1], head="time [min],y [um]")
    shifts, turns = courses(paddle(path=alone).solid[0])
    np.testing.assert_allclose(shifts.values, [[0.0, y] for y in wave(COARSE)[:, 1]], atol=1e-15)
    assert turns.greatest() == 0.0


def test_a_path_in_space_has_three_components_of_each(tmp_path):
    head = "time [s],z [mm],rotation_x [deg],rotation_z [rad]"
    file = written(tmp_path / "p.csv", [0.5, 1.0], [1.0, 3.0], [0.0, 90.0], [0.0, 0.5], head=head)
    own = {"name": "lid", "shape": "box", "lower": [0.2, 0.5, 0.2], "upper": [0.4, 0.6, 0.4], "motion": "path"}
    made = scene(solid=[{**own, "path": file}])
    shifts, turns = courses(made.solid[0])
    np.testing.assert_allclose(
        shifts.at(np.array([0.2, 0.75, 4.0])), [[0, 0, 0], [0, 0, 1e-3], [0, 0, 2e-3]], atol=1e-15
    )
    np.testing.assert_allclose(turns.values[-1], [np.pi / 2.0, 0.0, 0.5])
    (tmp_path / "p.csv").write_text(f"{head}\n0,0,1,1\n1,0,0,0\n")
    with pytest.raises(SceneError, match=r"begins with a rotation of \[0\.017.* but must begin with 0"):
        scene(solid=[{**own, "path": file}])


HEAD = "time [s],x [mm]"
BAD = {
    "": "must have a line of different names",
    f"{HEAD}\n0,1": "has one line of numbers, but must have times from 0 on",
    f"{HEAD}\n0,1\n1,2\n1,3": "has the time 1 s in line 4, but must have times from 0 on, each greater than the one b",
    f"{HEAD}\n-1,0\n1,5": "has the time -1 s in line 2",
    f"{HEAD}\n0,1\n1,nan": "has no number of finite size in column 'x [mm]', line 3",
    f"{HEAD}\n0,abc\n1,0": "line 2, x [mm] is 'abc', but must be a number",
    f"{HEAD}\n0,0,1,5\n1,2": "line 2 has 4 entries, but must have 2",
    "time [s],x\n0,1\n1,2": "has the column 'x' without a unit in brackets, but must have it in one of",
    "time [s],x [in]\n0,1\n1,2": "has the column 'x' in in, but must have it in one of m, cm, mm, um",
    "time [s],z [m]\n0,1\n1,2": "has the column 'z [m]', but its columns must be among time [s], x [m], y [m], ",
    "x [m],y [m]\n0,1\n1,2": "has no column 'time', but must have time [s] and one or more of x [m], y [m], rotation",
    "time [s],x [mm],x [m]\n0,1,2\n1,5,3": "has two columns 'x', but must have each of them once",
    "time [s];x [mm]\n0;0,1\n1;2": "has semicolons between its columns",
    "\udcff": "cannot be read: 'utf-8' codec can't decode",
}


def test_a_file_that_cannot_be_used_is_a_sentence(tmp_path):
    for text in BAD:
        (tmp_path / "p.csv").write_text(text, errors="surrogateescape")
        with one_sentence(error=SceneError) as error:
            paddle(path=str(tmp_path / "p.csv"))
        assert str(error.value).startswith(f"solid[0].path cannot be used: {tmp_path / 'p.csv'}") and BAD[text] in str(
            error.value
        )


def test_marks_of_order_and_ends_of_lines_of_other_systems_are_read_and_files_too_large_are_not(tmp_path):
    (tmp_path / "p.csv").write_bytes(b"\xef\xbb\xbftime [s],x [mm]\r\n0,0\r\n\r\n1,5\r\n")
    assert courses(paddle(path=str(tmp_path / "p.csv")).solid[0])[0].values[-1].tolist() == [0.005, 0.0]
    with open(tmp_path / "large.csv", "wb") as large:
        large.truncate(tables.MOST_BYTES + 1)
    for file, words in (
        ("large.csv", "it has 33,554,433 bytes, but must have at most 33,554,432"),
        ("none.csv", "No such file"),
        ("", "a dir"),
    ):
        with pytest.raises(SceneError, match=words):
            paddle(path=str(tmp_path / file))


STEADY = {"velocity": [0.1, 0.0]}
TOLD = {"times": [0.0, 1.0], "positions": [[0.75, 0.35], [0.8, 0.35]]}
KEYS = {
    "times is given, but must be left out, as the file of its path": {"path": "p.csv", **TOLD},
    "velocity is given, but must be left out, as the file of its path": {"path": "p.csv", **STEADY},
    "path is given, but must be left out, as motion is \"fixed\"": {"path": "p.csv", "motion": "fixed"},
    "path is given, but must be left out, as motion is \"free\"": {"path": "p.csv", "motion": "free", "density": 1.0},
    "ramp is given, but must be left out, as there are no times": {"ramp": 1.0, **STEADY},
    "interpolation is given, but must be left out, as there are no times": {"interpolation": "spline", **STEADY},
    "interpolation is given, but must be left out, as motion": {"interpolation": "spline", "motion": "fixed"},
    "velocity is missing, but must be given, or times": {"ramp": 1.0},
    "ramp is 0.0, but must be greater than 0 s": {"ramp": 0.0, **TOLD},
    "interpolation is 'cubic', but must be \"linear\" or \"spline\"": {"interpolation": "cubic", **TOLD},
}  # fmt: skip


def test_keys_of_a_motion_that_do_not_fit_are_a_sentence(tmp_path, monkeypatch):
    for words in KEYS:
        monkeypatch.chdir(tmp_path)
        written(tmp_path / "p.csv", [0.0, 1.0], [0.0, 1.0], head=HEAD)
        with one_sentence(error=SceneError) as error:
            paddle(**KEYS[words])
        assert str(error.value).startswith(f"solid[0].{words}")


GRAVITY = "time [s],x [m/s^2],y [g]"


def test_gravity_over_time_may_be_in_a_file_and_begin_with_a_ramp(tmp_path):
    file = written(tmp_path / "g.csv", [0.0, 0.2, 0.3], [0.0, 3.0, -1.0], [-1.0, -1.0, -1.0], head=GRAVITY)
    rows = [[0.0, -9.80665], [3.0, -9.80665], [-1.0, -9.80665]]
    of_file, told = ({"file": file}, {"times": [0.0, 0.2, 0.3], "values": rows})
    for more in ({}, {"interpolation": "spline"}, {"ramp": 0.1}):
        made = [plane(schedule={"gravity": {**one, **more}}) for one in (of_file, told)]
        values = [one.schedule.courses["gravity"].at(EVENLY) for one in made]
        np.testing.assert_allclose(*values, rtol=1e-15)
        assert (values[0][0] == (0.0 if "ramp" in more else rows[0])).all()
        assert Scene.from_json(made[0].to_json()) == made[0]
    for head, words in [
        ("time [s],x [m/s^2]", "has no column 'y', but must have all of"),
        ("time [s],x [m],y [m]", "m/s"),
    ]:
        columns = [[0.0, 1.0]] * len(head.split(","))
        with pytest.raises(SceneError, match=f"schedule.gravity.file cannot be used: .*{words}"):
            plane(schedule={"gravity": {"file": written(tmp_path / "b.csv", *columns, head=head)}})
    for table, words in [({"file": file, "times": [0.0]}, "times is given, but must be left out, as there is a file"),
                         ({"times": [0.0]}, "values is missing, but must be a list, or a file")]:  # fmt: skip
        with pytest.raises(SceneError, match=words):
            plane(schedule={"gravity": table})


def test_tilts_and_nozzles_have_their_columns_and_a_ramp_begins_at_the_outlet(tmp_path):
    lean = written(tmp_path / "t.csv", [0.0, 1.0], [0.0, np.pi / 6.0], head="time [s],tilt [rad]")
    assert plane(schedule={"tilt": {"file": lean}}).schedule.courses["tilt"].values[-1] == pytest.approx(30.0)
    both = written(tmp_path / "s.csv", [0.0, 1.0], [0.0, 9.0], [0.0, 4.0], head="time [s],tilt_z [deg],tilt_x [deg]")
    assert scene(schedule={"tilt": {"file": both}}).schedule.courses["tilt"].values[-1].tolist() == [4.0, 9.0]
    outlet = np.array(jet().emitter[0].outlet)
    places = outlet + np.array([[0.0, 0.0], [0.05, 0.0]])
    file = written(tmp_path / "n.csv", [0.0, 0.1], *1e3 * places.T, head="time [s],x [mm],y [mm]")
    course = jet(path={"file": file, "ramp": 0.1}).emitter[0].path.knots
    np.testing.assert_allclose(course.at(np.array([0.0, 0.05, 0.1])), [outlet, outlet + [0.0125, 0.0], places[1]])


def test_a_spline_that_leaves_the_container_between_its_times_is_refused():
    outlet = np.array(jet().emitter[0].outlet)
    values = [outlet, outlet + [0.22, 0.0], outlet + [0.22, 0.0], outlet]
    table = {"times": [0.0, 0.2, 0.4, 0.6], "values": np.array(values).tolist()}
    jet(path=table)
    with pytest.raises(SceneError, match="where all of the opening is inside the container"):
        jet(path={**table, "interpolation": "spline"})


# ---- runs --------------------------------------------------------------------------------------------------------
def test_a_run_of_a_file_is_that_of_its_lists_and_rests_where_the_file_ends(tmp_path):
    times, shift = np.array([0.0, 0.003, 0.007]), np.array([0.0, -0.002, 0.003])
    file = written(tmp_path / "p.csv", times, shift, np.zeros(3), head="time [s],x [m],y [m]")
    middle = paddle(**STEADY).solid[0].middle()
    positions = middle + np.stack([shift, np.zeros(3)], axis=1)
    runs = [Simulation(paddle(**one), precision="float64").run(12) for one in (
        {"path": file}, {"times": times.tolist(), "positions": positions.tolist()})]  # fmt: skip
    np.testing.assert_allclose(*[run.positions for run in runs], rtol=0.0, atol=1e-13)
    places = runs[0].solids["paddle"].positions - middle
    np.testing.assert_allclose(places[:, 0], np.interp(runs[0].times, times, shift), atol=1e-15)
    assert np.ptp(places[7:], axis=0).max() < 1e-15 and np.abs(places).max() > 1e-3


def test_a_spline_with_a_ramp_moves_a_solid_as_it_says(tmp_path):
    times, shift = np.linspace(0.0, 0.02, 5), np.array([0.0, -2.0, 3.0, -1.0, 1.0])
    file = written(tmp_path / "p.csv", times, shift, head=HEAD)
    made = paddle(path=file, interpolation="spline", ramp=0.008)
    run = Simulation(made, precision="float64").run(12)
    wanted = courses(made.solid[0])[0].at(run.times)
    np.testing.assert_allclose(run.solids["paddle"].positions - made.solid[0].middle(), wanted, atol=1e-15)
    assert np.abs(wanted[1]).max() < 1e-5 < np.abs(wanted[8]).max()


def test_chosen_steps_are_short_where_a_spline_is_fast():
    times = [0.0, 0.1, 0.2, 0.3]
    positions = [[0.75, 0.35], [0.75, 0.35], [0.85, 0.35], [0.85, 0.35]]
    own = {"times": times, "positions": positions, "interpolation": "spline"}
    made = paddle(**own).replaced('solver.time_step="auto"')
    travel = Travel.of(made, {}, [[(1.0, courses(made.solid[0])[0])]])
    longest = [travel.longest(t) for t in (0.001, 0.145, 0.35)]
    assert longest[1] < longest[0] and longest[2] == np.inf
    knots = courses(made.solid[0])[0]
    begins = np.linspace(0.0, 0.29, 200)
    ways = [np.ptp(knots.at(np.linspace(t, t + min(travel.longest(t), 1.0), 20))[:, 0]) for t in begins]
    assert max(ways) <= 1.001 * travel.furthest


def test_saved_runs_know_their_files_again(tmp_path):
    file = written(tmp_path / "p.csv", [0.0, 1.0], [0.0, 1.0], head=HEAD)
    sway = written(tmp_path / "g.csv", [0.0, 1.0], [0.0, 1.0], [-1.0, -1.0], head=GRAVITY)
    made = paddle(path=file).replaced(f'schedule.gravity={{file="{sway}"}}')
    assert Scene.from_json(made.to_json()) == made
    tables_named = files_named(json.loads(made.to_json()))
    assert {table[key] for table, key in tables_named} == {file, sway}
    for changed in (file, sway):
        folder = RunFolder.create(tmp_path / f"run of {changed[-5]}", made.to_json(), ["cortado", "run"])
        folder.require_files()
        with open(changed, "a") as more:
            more.write("\n2,2,-1" if changed == sway else "\n2,2")
        with pytest.raises(InputError, match=r"\.csv has changed since the run in .* restore the former file"):
            folder.require_files()


def test_a_scene_file_finds_its_tables_beside_it(tmp_path):
    written(tmp_path / "p.csv", [0.0, 1.0], [0.0, 1.0], head=HEAD)
    text = pool_text([0.5, 0.3], [1.2, 0.9], 'kind = "projection"\ntime_step = 0.001')
    solid = 'name = "paddle"\nshape = "box"\nlower = [0.7, -0.1]\nupper = [0.9, 0.9]\nmotion = "path"\npath = "p.csv"\n'
    (tmp_path / "scene.toml").write_text(f"{text}[[solid]]\n{solid}")
    assert load_scene(tmp_path / "scene.toml").solid[0].path == str(tmp_path / "p.csv")


def test_a_measured_flap_is_read_as_it_was_recorded(tmp_path):
    """The record of `examples/wave_flume` at its 50 Hz, on half of the samples and a spline between them."""
    flume = Path(__file__).parents[1] / "examples" / "wave_flume"
    record = np.genfromtxt(flume / "1062.csv", delimiter=",", names=True)
    times, stroke = record["time_s"], record["wavemaker_m"]
    file = written(tmp_path / "half.csv", times[::2], 1e3 * stroke[::2], head=HEAD)
    own = {"path": file, "interpolation": "spline", "ramp": 0.5}
    shifts = courses(paddle(**own).solid[0])[0]
    found = shifts.at(times)[:, 0]
    late = (times > 0.5) & (times < times[-1] - 0.5)  # the record ends while the flap moves
    assert np.abs(found - (stroke - stroke[0]))[late].max() < 1e-4 < 0.01 < np.ptp(stroke)
