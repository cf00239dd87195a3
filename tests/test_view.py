"""``cortado view``, without a browser: what its page is given."""

import sys
import urllib.request
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import cortado
from bad_scenes import assert_refused
from bad_tasks import TINY_BLOCK, TINY_SCENE
from cortado import Trajectory
from cortado.cli import main, views
from cortado.cli.views import LiveView, RecordedView, opened
from cortado.files.image_encoding import to_srgb
from cortado.pictures.shown_solids import solid_outline
from remembering_force import Memory, U

viser = pytest.importorskip("viser")
PORT = 18310
NOZZLE = """
emitter = [{phase = "water", outlet = [0.3, 0.55], radius = 0.05, length = 0.2, flow_rate = 0.05}]
"""


@pytest.fixture
def scene(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(TINY_SCENE)
    return tmp_path / "scene.toml"


@contextmanager
def window(place, port, precision="float32"):
    shown = opened(place, [], "cpu", precision, port)
    with closing(shown.window):
        yield shown


@pytest.fixture
def live(scene):
    with window(scene, PORT) as shown:
        yield shown


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


def test_what_cannot_be_computed_is_said_and_the_window_goes_on(live):
    live.gravity[1].value = float("nan")
    live.tick()
    assert not live.running.value and "gravity" in live._told.content and "Begin again." in live._told.content
    live._wish_to_begin = live.running.value = True
    live.tick()
    assert live._state.clock.steps == live.steps and live.gravity[1].value == -9.81


def test_a_nozzle_follows_its_sliders(scene):
    scene.write_text(NOZZLE + TINY_SCENE)
    with window(scene, PORT + 2) as shown:
        shown.tick()
        shown.nozzles["nozzle"][0].value = 0.4
        shown.tick()
        np.testing.assert_allclose(np.ravel(shown._state["nozzle.outlet"])[:2], [0.4, 0.55], atol=1e-6)


def coloured(shown, name: str) -> np.ndarray:
    """(n, 3) the colours of particles when the user has chosen a quantity."""
    shown.window.colour.value = name
    shown.window.refresh()
    return np.array(shown.window._cloud.colors)


@pytest.mark.parametrize(("name", "unit"), [("speed", "m/s"), ("density", "kg/m³"), ("pressure", "Pa")])
def test_particles_are_coloured_by_what_is_asked(live, name, unit):
    for _ in range(12):  # until it has fallen onto the floor
        live.tick()
    assert len(np.unique(coloured(live, "phase"), axis=0)) == 1 < len(np.unique(coloured(live, name), axis=0))
    assert f"{name} [{unit}]" in live.window.legend.content


def test_what_a_solver_does_not_know_is_said_in_a_sentence(scene, live, monkeypatch):
    scene.write_text(TINY_SCENE + "[forces]\npressure = false\n")
    with window(scene, PORT + 3) as shown:
        own = coloured(shown, "phase")
        np.testing.assert_array_equal(coloured(shown, "pressure"), own)
        assert "computes no pressure" in shown.window.legend.content
    monkeypatch.setattr(views, "ParticleSolver", int)  # a solver of another kind
    own = coloured(live, "phase")
    np.testing.assert_array_equal(coloured(live, "density"), own)
    assert "no densities" in live.window.legend.content


def test_a_run_is_played_and_gone_through(scene):
    main(["run", "scene.toml", "--steps", "4", "--out", "a", "--no-pictures"])
    with window(Path("a"), PORT + 1, None) as shown:
        trajectory = Trajectory.load("a/trajectory.vtkhdf")
        shown.show(3)
        np.testing.assert_allclose(points(shown)[:, :2], trajectory.positions[3], atol=1e-6)
        shown.show(4)
        assert shown.window._quantities["density"]().mean() == pytest.approx(1000.0, rel=0.3)
        shown._former -= 1.0
        shown.tick()
        assert shown.slider.value > 0


def test_what_drains_took_is_not_shown(scene):
    scene.write_text(TINY_SCENE + '\n[[drain]]\nshape = "box"\nname = "side"\nlower = [0.2, 0.0]\n')
    with window(scene, PORT + 5) as shown:
        shown.tick()
        assert (np.ravel(shown._state["drained"]) > 0.0).any() and points(shown).max() < 0.5
        assert shown.window._quantities["density"]().min() < 500.0
        assert len(np.unique(coloured(shown, "density"), axis=0)) > 3
        assert "<span>704" in shown.window.legend.content


def test_the_field_of_a_part_colours_particles(scene):
    simulation = cortado.Simulation("scene.toml", forces=[Memory()])
    recorded = RecordedView(simulation.scene, simulation.run(3), lambda: simulation, PORT + 3)
    for shown in (LiveView(simulation, PORT + 2), recorded):
        with closing(shown.window):
            for _ in range(3):
                shown.tick()
            if shown is recorded:
                shown.show(3)
            assert len(np.unique(coloured(shown, "phase"), axis=0)) == 1
            assert len(np.unique(coloured(shown, U.name), axis=0)) > 1
            assert U.name in shown.window.legend.content


@pytest.mark.usefixtures("unrendered")
def test_what_cannot_be_shown_is_said_in_a_sentence(scene, cortado_command):
    assert cortado_command("run", "scene.toml", "--steps", 1, "--out", "a", "--no-pictures")[0] == 0
    Path("b").mkdir()
    for arguments, sentence in (
        (["a", "--set", "solver.time_step=1"], "--set is given"),
        (["b"], "no run in"),
        (["absent"], "absent does not exist, but"),
    ):
        assert_refused(cortado_command("view", *arguments), sentence)


def test_without_viser_a_sentence_says_what_to_install(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(cortado.InputError, match=r"pip install viser"):
        opened(scene, [], "cpu", "float32", PORT)


ROD = """
[[solid]]
name = "rod"
shape = "box"
lower = [0.5, 0.1, 0.1]
upper = [0.6, 0.5, 0.2]
rotation = [0.2, 0.3, 0.4]
colour = [0.7, 0.3, 0.05]
"""
MOVED = {2: {"position": (0.3, 0.6), "rotation": (1.0,)}, 3: {"position": (0.3, 0.6, 0.1), "rotation": (1.0, 0.0, 0.0)}}


@pytest.mark.parametrize("dimension", [2, 3])
def test_solids_are_seen_where_they_are(scene, dimension):
    rod = ROD.replace("0.1, 0.1]", "0.1]").replace("0.5, 0.2]", "0.5]").replace("[0.2, 0.3, 0.4]", "0.4")
    gravity = "\n[forces]\ngravity = [0.0, 0.0, -9.81]\n"
    scene.write_text(TINY_SCENE + rod if dimension == 2 else TINY_BLOCK + gravity + ROD)
    with window(scene, PORT + 5) as shown:
        seen, made = shown.window, shown.simulation.scene
        (frame,) = seen._solids
        nodes = seen.server.scene._handle_from_node_name
        w, x, y, z = frame.wxyz
        turn = Rotation.from_quat([x, y, z, w]).as_matrix()
        lines = np.array(nodes["/solid_0/edges"].points) @ turn.T + frame.position
        np.testing.assert_allclose(lines, seen._space(solid_outline(made)), atol=1e-6)
        assert ("/solid_0/faces" in nodes) == (dimension == 3)
        if dimension == 3:
            mesh = nodes["/solid_0/faces"]
            places = mesh.vertices @ turn.T + frame.position
            found = np.unique(np.round(lines.reshape(-1, 3), 5), axis=0)
            np.testing.assert_allclose(np.unique(np.round(places, 5), axis=0), found, atol=2e-5)
            assert tuple(mesh.color) == tuple(to_srgb(np.array([[[0.7, 0.3, 0.05]]]))[0, 0])
        seen.place_solids(made.model_copy(update={"solid": (made.solid[0].model_copy(update=MOVED[dimension]),)}))
        np.testing.assert_allclose(frame.position, seen._space(np.array(MOVED[dimension]["position"])), atol=1e-6)
        assert np.abs(frame.wxyz - [w, x, y, z]).max() > 0.05
