"""How pictures are taken: three views, of which each dimension has its own."""

import tomllib

import numpy as np
import pytest

import cortado
from bad_scenes import GOOD_SCENE, RENDER
from bad_scenes import plane as plane_tables
from cortado.device.precision import FLOAT64
from cortado.errors import InputError, SceneError
from cortado.particles.state import to_device
from cortado.problem import Problem
from cortado.render.scene_renderer import scene_renderer
from cortado.render.views import TopView
from cortado.scene.appearance import Render
from cortado.scene.scene import Scene, scene_from_dict
from cortado.simulation import Simulation
from scenes import plane, plane_of_three, scene


def space(**render) -> Scene:
    return scene_from_dict(tomllib.loads(GOOD_SCENE) | {"render": render})


def test_a_render_keeps_what_its_file_says():
    render = scene_from_dict(tomllib.loads(GOOD_SCENE + RENDER)).render
    assert render == Render(
        view="volume",
        resolution=(32, 16),
        background=np.array([0, 0.5, 1]),
        extinction=3,
        position=[0.2, 0.3, 2],
        look_at=[0.2, 0.3, 0.1],
        field_of_view=30,
    )


def test_what_is_left_out_has_a_default():
    render = space().render
    assert (render.view, render.resolution, render.background) == ("top", (128, 128), (1.0, 1.0, 1.0))
    assert {render.extinction, render.position, render.look_at, render.field_of_view} == {None}
    assert space(view="volume", position=[0, 0, 1], look_at=[0, 0, 0]).render.field_of_view == 40.0
    assert Scene(**plane_tables(render={})).render.view == "plane"
    assert Scene(**plane_tables(render=Render(view="plane"))).render.view == "plane"


@pytest.mark.parametrize("scene", [space(), space(view="top"), Scene(**plane_tables(render={}))])
def test_json_brings_a_render_back(scene):
    assert Scene.from_json(scene.to_json()) == scene


def test_a_plane_is_seen_as_it_is():
    for view in ({"view": "top"}, {"view": "volume", "position": [0, 0, 1], "look_at": [0, 0, 0]}):
        with pytest.raises(SceneError, match=r'^render\.view is .*"plane", as the scene has 2 dimensions\.$'):
            Scene(**plane_tables(render=view))
    with pytest.raises(SceneError, match=r"""^render\.view is 'plane', but must be "top" or "volume" in 3-D\.$"""):
        space(view="plane")


def test_only_the_view_of_the_volume_has_a_camera():
    wanted = (
        r'^field_of_view is 30.0, but must be left out, as the view is "top": only the view "volume" has a camera\.$'
    )
    with pytest.raises(SceneError, match=wanted):
        Render(field_of_view=30)


def test_fluid_that_went_round_is_still_seen():
    box = {"shape": "box", "lower": [0.0, 0.0], "upper": [1.5, 1.0], "periodic": [True, False]}
    simulation = Simulation(Scene(**plane_tables(render={"resolution": [20, 16]}, container=box)), precision="float64")
    renderer, c = scene_renderer(simulation), simulation.initial.mass_fractions
    shift, colours = np.array([3 * 1.5, 0.0]), simulation.parameters()["colours"]
    here, there = (to_device(simulation.positions + k * shift, FLOAT64, simulation.device) for k in (0, 1))
    pictures = [renderer.render(x, c, colours) for x in (here, there)]
    np.testing.assert_allclose(*pictures, atol=1e-12)
    assert np.ptp(pictures[0]) > 0.5


def test_a_frame_of_a_trajectory_is_rendered():
    """By its own mass fractions, and the scene's colours where there are no others."""
    simulation = Simulation(plane_of_three(), precision="float64")
    trajectory, colours = simulation.run(steps=4), simulation.parameters()["colours"]
    renderer, frame = simulation.renderer(resolution=(24, 16)), trajectory[-1]
    picture = renderer.render(frame)
    assert picture.shape == renderer.shape == (16, 24, 3)
    np.testing.assert_array_equal(picture, renderer.render(frame.positions, frame.mass_fractions, colours))
    assert np.abs(picture - renderer.render(trajectory[0])).max() > 0.01
    assert np.abs(picture - renderer.render(frame, colours=1.0 - colours)).max() > 0.1
    loss = cortado.losses.FinalPositions(frame.positions)
    end = Problem(simulation, 4, loss).end({"colours": 0.5 * colours})
    np.testing.assert_array_equal(renderer.render(end), renderer.render(frame, colours=0.5 * colours))


def test_one_phase_needs_no_fractions():
    renderer = Simulation(plane(), precision="float64").renderer()
    x = Simulation(plane()).positions
    np.testing.assert_array_equal(renderer.render(x), renderer.render(x, np.ones((len(x), 1))))


def test_settings_replace_those_of_the_scene():
    camera = {"view": "volume", "position": [1.0, 1.0, 2.0], "look_at": [0.2, 0.2, 0.2]}
    simulation = Simulation(scene(render={**camera, "resolution": [20, 10]}))
    assert simulation.renderer().shape == (10, 20, 3)
    assert simulation.renderer(resolution=(16, 16)).view.camera.position == (1.0, 1.0, 2.0)
    above = simulation.renderer(view="top")
    assert isinstance(above.view, TopView) and above.shape == (10, 20, 3)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"resolution": 100}, r"^render\.resolution is 100, but must be .*"),
        ({"resolutoin": (9, 9)}, r"^render\.resolutoin is not a key of \[render\]; did you mean resolution\?$"),
        ({"view": "plane"}, r"""^render\.view is 'plane', but must be "top" or "volume" in 3-D\.$"""),
        ({"view": "volume"}, r"^render\.position is missing, but must be .*"),
    ],
)
def test_wrong_settings_are_refused(settings, said):
    with pytest.raises(SceneError, match=said):
        Simulation(scene()).renderer(**settings)


def test_what_a_picture_lacks_is_said():
    renderer = Simulation(plane_of_three()).renderer()
    with pytest.raises(InputError, match=r"^fractions is left out, but must be mass fractions \(64, 3\), as"):
        renderer.render(np.zeros((64, 2)))
