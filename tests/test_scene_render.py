"""How pictures are taken: three views, of which each dimension has its own."""

import tomllib

import numpy as np
import pytest

from bad_scenes import GOOD_SCENE, RENDER, plane
from cortado.errors import SceneError
from cortado.particles import to_device
from cortado.precision import FLOAT64
from cortado.render.scene_renderer import scene_renderer
from cortado.scene import Render, Scene, scene_from_dict
from cortado.simulation import Simulation


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
    assert Scene(**plane(render={})).render.view == "plane"
    assert Scene(**plane(render=Render(view="plane"))).render.view == "plane"


@pytest.mark.parametrize("scene", [space(), space(view="top"), Scene(**plane(render={}))])
def test_json_brings_a_render_back(scene):
    assert Scene.from_json(scene.to_json()) == scene


def test_a_plane_is_seen_as_it_is():
    for view in ({"view": "top"}, {"view": "volume", "position": [0, 0, 1], "look_at": [0, 0, 0]}):
        with pytest.raises(SceneError, match=r'^render\.view is .*"plane", as the scene has 2 dimensions\.$'):
            Scene(**plane(render=view))
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
    simulation = Simulation(Scene(**plane(render={"resolution": [20, 16]}, container=box)), precision="float64")
    renderer, c = scene_renderer(simulation), simulation.state.mass_fractions
    shift, colours = np.array([3 * 1.5, 0.0]), simulation.parameters()["colours"]
    here, there = (to_device(simulation.positions + k * shift, FLOAT64, simulation.device) for k in (0, 1))
    pictures = [renderer.render(x, c, colours) for x in (here, there)]
    np.testing.assert_allclose(*pictures, atol=1e-12)
    assert np.ptp(pictures[0]) > 0.5
