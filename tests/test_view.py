"""``cortado view``, without a browser: what its page is given."""

import urllib.request
from pathlib import Path

import numpy as np
import pytest

import cortado
from bad_tasks import TINY_SCENE
from cortado.cli import main
from cortado.commands.view import opened
from cortado.commands.view_live import LiveView
from cortado.io.trajectory import Trajectory
from cortado.scene.scene import Scene
from cortado.shading.scene_view import outline

viser = pytest.importorskip("viser")
PORT = 18310
NOZZLE = """
[emitter]
phase = "water"
outlet = [0.3, 0.55]
radius = 0.05
length = 0.2
flow_rate = 0.05
"""


@pytest.fixture
def scene(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(TINY_SCENE)
    return tmp_path / "scene.toml"


@pytest.fixture
def live(scene):
    shown = opened(scene, [], "cpu", "float32", PORT)
    yield shown
    shown.window.close()


def points(shown) -> np.ndarray:
    return np.array(shown.window._cloud.points)


def test_a_scene_runs_and_begins_again(live):
    assert isinstance(live, LiveView)
    assert b"<html" in urllib.request.urlopen(live.window.address).read()
    first = points(live)
    for _ in range(3):
        live.tick()
    steps = live._state.clock.steps
    assert steps == 3 * live.steps
    own = live.simulation.run(steps)
    np.testing.assert_allclose(points(live)[:, :2], own.positions[-1], atol=1e-6)
    live.running.value = False
    live.tick()
    assert live._state.clock.steps == steps
    live._wish_to_begin = True
    live.tick()
    np.testing.assert_array_equal(points(live), first)
    assert np.abs(own.positions[-1] - first[:, :2]).max() > 1e-4


def test_gravity_follows_its_sliders(live):
    live.gravity[1].value = 9.81
    live.tick()
    assert np.asarray(live._state["velocities"])[:, 1].mean() > 0.0


def test_a_nozzle_follows_its_sliders(scene):
    scene.write_text(TINY_SCENE + NOZZLE)
    shown = opened(scene, [], "cpu", "float32", PORT + 2)
    try:
        shown.tick()
        shown.nozzle[0].value = 0.4
        shown.tick()
        np.testing.assert_allclose(np.ravel(shown._state["outlet"])[:2], [0.4, 0.55], atol=1e-6)
    finally:
        shown.window.close()


def test_particles_are_coloured_by_what_is_asked(live):
    live.tick()
    live.window.colour.value = "phase"
    live.window._draw()
    phase = np.array(live.window._cloud.colors)
    live.window.colour.value = "density"
    live.window._draw()
    density = np.array(live.window._cloud.colors)
    assert len(np.unique(phase, axis=0)) == 1 < len(np.unique(density, axis=0))
    assert "kg/m³" in live.window.legend.content


def test_a_run_is_played_and_gone_through(scene):
    main(["run", "scene.toml", "--steps", "4", "--out", "a", "--no-pictures"])
    shown = opened(Path("a"), [], "cpu", "float32", PORT + 1)
    try:
        trajectory = Trajectory.load("a/trajectory.vtkhdf")
        shown.show(3)
        np.testing.assert_allclose(points(shown)[:, :2], trajectory.positions[3], atol=1e-6)
        shown.window.colour.value = "density"
        shown.show(4)
        assert shown._densities(4).mean() == pytest.approx(1000.0, rel=0.3)
        shown._former -= 1.0
        shown.tick()
        assert shown.slider.value > 0
    finally:
        shown.window.close()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [(["a", "--set", "solver.time_step=1"], "--set is given"), (["b"], "no run in"), (["c.toml"], "c.toml")],
)
def test_what_cannot_be_shown_is_said_in_a_sentence(scene, arguments, sentence, capsys):
    main(["run", "scene.toml", "--steps", "1", "--out", "a", "--no-pictures"])
    Path("b").mkdir()
    with pytest.raises(SystemExit) as end:
        main(["view", *arguments])
    error = capsys.readouterr().err.splitlines()[-1]
    assert end.value.code == 2 and sentence in error


def test_without_viser_a_sentence_says_what_to_install(scene, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(cortado.InputError, match=r"pip install 'cortado-sph\[view\]'"):
        opened(scene, [], "cpu", "float32", PORT)


def test_a_container_has_its_edges(scene):
    made = cortado.Simulation(scene).scene
    assert outline(made).shape == (4, 2, 2)
    assert isinstance(made, Scene)
