"""Several runs side by side: one clock, one camera, one scale of colours, and labels that tell them apart."""

import json

import numpy as np
import pytest

import cortado
from bad_scenes import assert_one_sentence, one_sentence
from bad_tasks import TINY_SCENE
from cortado.errors import InputError, SceneError
from cortado.pictures import Orbit
from cortado.pictures.film import ALONE, Page, ShownRun, coloured_by, framed_together, in_a_row
from cortado.pictures.painter import labelled
from cortado.pictures.run_pictures import shown_as
from cortado.pictures.several_runs import ShownFrames, common_times, labels, runs_page
from cortado.pictures.stage import Stage
from cortado.scene.appearance import Picture
from scenes import plane, scene

SMALL = {"width": 256, "height": 144}


@pytest.fixture(scope="module")
def runs():
    """Two runs of a fluid in the plane, of which the second is thicker, shorter, and has fewer frames."""
    one = cortado.Simulation(plane(picture=SMALL))
    other = cortado.Simulation(plane(picture=SMALL).replaced("phase.0.viscosity=2.0"))
    return one.run(6), other.run(4, record_every=2)


def test_a_film_has_the_times_of_the_run_with_most_frames():
    fine, coarse = np.linspace(0.0, 1.0, 11), np.linspace(0.0, 2.0, 5)
    np.testing.assert_allclose(common_times([coarse, fine]), [*fine, 1.5, 2.0])
    np.testing.assert_allclose(common_times([fine + 1.0, coarse]), [0.0, 0.5, *(fine + 1.0)])
    np.testing.assert_array_equal(common_times([fine, fine + 1e-9]), fine)
    np.testing.assert_array_equal(common_times([np.array([0.5])]), [0.5])
    np.testing.assert_array_equal(common_times([np.array([0.0]), coarse]), coarse)


def test_the_nearest_frame_is_shown():
    own, times = np.array([0.0, 0.1, 0.25, 0.3]), np.linspace(0.0, 0.4, 41)
    shown = ShownFrames(own, times)
    distances = np.abs(own[:, None] - times)
    np.testing.assert_allclose(distances[shown.nearest, np.arange(41)], distances.min(axis=0), atol=1e-12)
    off = np.abs(shown.own[shown.nearest] - shown.times)[shown.during].max()
    assert off == pytest.approx(0.07) and shown.during.sum() == 31
    assert shown.time_in_words(8) == "0.10 s" and shown.time_in_words(40) == "stands still at 0.30 s"
    assert ShownFrames(own + 0.2, times).notes("late")[0].startswith('"late" begins at 0.2 s')


def test_labels_tell_runs_apart_by_what_differs():
    first = plane()
    thick = first.replaced("phase.0.viscosity=2.0", "picture.width=640")
    assert labels([first, thick], ["a", "b"]) == ["viscosity = 0.05 Pa s", "viscosity = 2 Pa s"]
    both = labels([first, thick.replaced("solver.time_step=0.0005")], ["a", "b"])
    assert both[1] == "viscosity = 2 Pa s, time step = 0.0005 s"
    assert labels([first, first], ["a", "b"]) == ["a", "b"]
    assert labels([first, thick.replaced("name='honey'")], ["a", "b"]) == [first.name, "honey"]
    many = ["phase.0.viscosity=1.0", "phase.0.rest_density=900.0", "solver.time_step=0.001", "forces.pressure=false"]
    assert labels([first, first.replaced(*many)], ["a", "b"]) == ["a", "b"]
    chosen = labels([first, first.replaced("solver.time_step='auto'")], ["a", "b"])
    assert chosen == ["time step = 0.0021 s", "time step = auto"]


def test_a_grid_makes_pictures_large_and_leaves_few_places_empty():
    for count, size, across in [
        (2, (1, 1), 2),
        (2, (4, 1), 1),
        (3, (1, 1), 3),
        (4, (1, 1), 2),
        (5, (1, 1), 3),
        (9, (1, 1), 3),
    ]:
        assert in_a_row(count, np.array(size, dtype=float), Picture(width=1280, height=720)) == across


@pytest.mark.parametrize("make", [plane, scene])
def test_one_camera_sees_what_all_runs_show(make):
    """A point of the scene is at the same place of every picture, in containers of another size too."""
    small = make(picture=SMALL)
    upper = 1.5 * np.array(small.container.upper)
    large = small.replaced(f"container.upper={upper.tolist()}")
    each = [ShownRun(one, cortado.Simulation(one).run(1)).stage for one in (small, large)]
    stages, _ = framed_together(each)
    points = np.array([large.container.lower, large.container.upper, small.container.upper], dtype=float)
    places = [stage.on_screen(points) for stage in stages]
    np.testing.assert_allclose(places[0], places[1], atol=1e-6)
    size = stages[0].picture.width, stages[0].picture.height
    assert (places[0] > 0.0).all() and (places[0] < size).all()
    alone = each[0].framed(each[0].ends, stages[0].picture).on_screen(points)
    assert not np.allclose(places[0], alone, atol=5.0)
    if isinstance(stages[0], Stage):
        np.testing.assert_allclose(stages[0].home_around.eye, stages[1].home_around.eye, atol=1e-9)


def test_a_run_that_ends_stands_still_and_frames_are_the_nearest(runs):
    each = [ShownRun(run.scene, run) for run in runs]
    page, times = runs_page(each, ["long", "short"], "cpu")
    np.testing.assert_array_equal(times, runs[0].times)
    stages, across = framed_together([run.stage for run in each])
    assert across == 2
    panel = each[1].panel(stages[1], "cpu", None)
    for k, frame, told in ((0, 0, "0.000 s"), (4, 2, "0.008 s"), (6, 2, "stands still at 0.008 s")):
        wanted = labelled(panel(frame, ALONE), "short", told)[1:-1, 1:]
        np.testing.assert_array_equal(page.image(k)[1:-1, -wanted.shape[1] :], wanted)
    assert '"short" ends at 0.0084 s and stands still' in page.notes and "at most 0.0021 s away" in page.notes
    assert runs_page(each[:1], ["long"], "cpu")[0].notes == ""


def test_colours_stand_for_the_same_numbers_in_all_runs(runs):
    def page(*shown) -> Page:
        known = [shown_as(run.scene, {"colour": "speed"}) for run in shown]
        each = [ShownRun(one, run, coloured_by(one, run)) for one, run in zip(known, shown, strict=True)]
        return runs_page(each, ["a", "b"], "cpu")[0]

    slow, fast = runs[0][:2], runs[0]
    beside_fast, beside_slow = page(slow, fast).image(1), page(slow, slow).image(1)
    assert 0 <= runs[0].scene.picture.width - beside_fast.shape[1] < 2  # though the scale has columns of its own
    half = beside_fast.shape[1] // 3
    assert np.abs(beside_fast[:, :half] - beside_slow[:, :half]).max() > 0.1


def test_a_film_of_trajectories(runs, tmp_path):
    pytest.importorskip("av")
    made = cortado.film_side_by_side(runs, tmp_path / "both.mp4", film_speed=0.01)
    assert "7 frames" in str(made) and "stands still" in str(made) and made.path.stat().st_size > 1000
    named = {"thin": runs[0], "thick": runs[1]}
    assert '"thick" ends' in cortado.film_side_by_side(named, tmp_path / "named.webp", film_frames=2).notes


def test_what_cannot_be_side_by_side_is_a_sentence(runs, tmp_path, monkeypatch):
    for call, words in [
        (lambda a, b: cortado.film_side_by_side([a] * 10, "x.mp4"), "There are 10 runs, but 1 to 9"),
        (lambda a, b: cortado.film_side_by_side(5, "x.mp4"), "runs is 5, but must be several trajectories"),
        (lambda a, b: cortado.film_side_by_side([a, b[:0]], "x.mp4"), "has no frames"),
        (lambda a, b: cortado.film_side_by_side([a, b], "x.avi"), "must end in .mp4"),
        (lambda a, b: cortado.film_side_by_side([a, b], "x.mp4", scenes=[a.scene]), "scenes has 1 scenes"),
        (lambda a, b: cortado.film_side_by_side([a, b], "x.mp4", lines=64), "each must have 64 x 64"),
        (lambda a, b: cortado.film_side_by_side([a, b], "x.mp4", colour="pressure"), "pressure was not recorded"),
        (lambda a, b: cortado.film_side_by_side([a, b], "x.mp4", camera=Orbit()), "2 dimensions"),
        (
            lambda a, b: cortado.film_side_by_side([a, cortado.Simulation(scene()).run(1)], "x.mp4"),
            "Some runs are in 2-D and some in 3-D",
        ),
    ]:
        monkeypatch.chdir(tmp_path)
        with one_sentence(error=(InputError, SceneError)) as caught:
            call(*runs)
        assert words in str(caught.value)


def test_the_command_draws_the_runs_of_a_sweep(tmp_path, monkeypatch, cortado_command):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(TINY_SCENE)
    options = ("--set", "phase.0.viscosity=10,5", "--steps", "2", "--no-pictures", "--out", "all")
    assert cortado_command("sweep", "scene.toml", *options)[0] == 0
    code, out, _ = cortado_command("picture", "all", "--lines", "144")
    assert code == 0 and (tmp_path / "all" / "side_by_side.png").exists() and "side_by_side.png" in out
    assert cortado_command("picture", "all", "--lines", "144", "--film", "--out", "a.webp")[0] == 0
    for words, sentence in (
        (("picture",), "RUN is missing"),
        (("picture", "all", "--frame", "9", "--lines", "144"), "--frame is 9, but together the runs have 3 frames"),
        (("picture", "all", "nothing"), "There is no run in"),
        (("picture", "all", "--device", "tpu"), "device is 'tpu'"),
    ):
        code, _, error = cortado_command(*words)
        assert code == 2 and sentence in error
        assert_one_sentence(error.strip())
    environment = json.loads((tmp_path / "all" / "phase.0.viscosity=5" / "environment.json").read_text())
    assert environment["kind"] == "run"
