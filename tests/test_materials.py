"""Materials by name: what scenes say of them, how far one sees into fluids, and how solids and walls look."""

import numpy as np
import pytest
import warp as wp

import cortado
from cortado.device.launching import BandLauncher
from cortado.errors import SceneError
from cortado.pictures.painter import colours_of, painter
from cortado.pictures.stage import TINT, media_of
from cortado.pictures.tracing.liquid_surface import liquid_surface
from cortado.pictures.tracing.near_particles import Particles
from cortado.pictures.tracing.space import State, environment_of
from cortado.scene.appearance import FINISHES, LIQUIDS
from scenes import bodies, box

DARK = (0.06, 0.06, 0.06)
FRONT = {"camera": [0.03, 0.03, 0.5], "look_at": [0.03, 0.03, 0.01], "field_of_view": 12.0}


def scene_of(*materials, depth=0.02, picture=None, container=None, **tables):
    count, own = len(materials), {"rest_density": 1000.0, "viscosity": 0.01}
    tables["phase"] = [{**own, "name": f"p{k}", "material": name} for k, name in enumerate(materials)]
    ends = [(0.06 * k / count, 0.06 * (k + 1) / count) for k in range(count)]
    fluid = [box([x, 0.0, 0.0], [to, 0.06, depth], phase=f"p{k}") for k, (x, to) in enumerate(ends)]
    room = {**box([0.0] * 3, [0.06, 0.12, depth]), **(container or {})}
    tables["picture"] = {"width": 64, "height": 64, "floor": False, "background": DARK, **FRONT, **(picture or {})}
    return bodies(3, fluid, room, 0.01, **tables)


def drawn(scene, shown=True):
    simulation = cortado.Simulation(scene)
    x, fractions = simulation.positions, simulation.parameters().get("mass_fractions")
    colours, keep = colours_of(scene, fractions, len(x)), slice(None if shown else 0)
    fractions = None if fractions is None else fractions[keep]
    return painter(scene, x).image(*State(x[keep], colours[keep], fractions=fractions))


def middle(image):
    return image[28:36, 28:36].mean(axis=(0, 1))


def test_one_sees_through_water_and_not_milk_and_honey_takes_blue():
    water, milk = (middle(drawn(scene_of(name))) for name in ("water", "milk"))
    empty = middle(drawn(scene_of("water"), shown=False))
    assert np.abs(water - empty).max() < 0.05 and (milk - empty).min() > 0.2
    bright = {"background": (0.7,) * 3}
    thin, thick = (middle(drawn(scene_of("honey", depth=depth, picture=bright))) for depth in (0.01, 0.04))
    assert thick[2] / thick[0] < 0.7 * thin[2] / thin[0] < 0.7


def test_fluids_side_by_side_keep_their_own_media():
    image = drawn(scene_of("milk", "water"))
    left, right = image[28:36, 14:22].mean(), image[28:36, 42:50].mean()
    assert left > right + 0.2


def test_water_beside_a_thin_wall_is_no_milk():
    """Across a wall of one and a half spacings, where a part of the milk's smoothing reaches: one sees through the
    water's side all the same, and no further into the milk's."""
    places = 0.01 * (np.stack(np.meshgrid(*[np.arange(6.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5)
    both = np.concatenate([places - [0.06, 0.0, 0.0], places + [0.015, 0.0, 0.0]])
    media = [[LIQUIDS[name].scattering, LIQUIDS[name].absorption] for name in ("water", "milk")]
    launch = BandLauncher(wp.get_device("cpu"))
    particles = Particles.on(launch.device, both, np.zeros_like(both), np.repeat(media, len(places), axis=0))
    found = liquid_surface(particles, 0.01, launch)
    scattering, left = found.media.numpy()[:, 0], found.points.numpy()[:, 0] < 0.007
    assert scattering[left].max() < 10.0 and scattering[~left].min() > 100.0


def test_what_a_picture_says_wins_over_materials():
    water = [LIQUIDS["water"].scattering, LIQUIDS["water"].absorption]
    media, through = media_of(scene_of("water"), 1.0)
    np.testing.assert_allclose(media, [water])
    assert 0.95 < through < 1.0
    media, through = media_of(scene_of("water", picture={"transparency": 0.5}), 1.0)
    np.testing.assert_allclose(media, [np.log(2.0) / 0.1 * np.array([1.0, TINT])])
    assert through == 0.5
    media, through = media_of(scene_of("water", picture={"colour": "speed"}), 1.0)
    assert media[0, 0] == 300.0 and through == 0.0


def test_a_colour_that_is_given_wins_and_another_material_has_another():
    scene = scene_of("milk")
    assert scene.phase[0].colour == LIQUIDS["milk"].colour
    assert scene.replaced("phase.p0.material=honey").phase[0].colour == LIQUIDS["honey"].colour
    red = scene.replaced("phase.p0.colour=[0.8,0.1,0.1]").replaced("phase.p0.material=oil")
    assert red.phase[0].colour == (0.8, 0.1, 0.1) and red.phase[0].material == "oil"
    assert cortado.Scene.from_json(scene.to_json()) == scene


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("phase.p0.material=steel", ["material is 'steel'", *LIQUIDS]),
        ("container.material=water", ["container.material is 'water'", *FINISHES]),
        ("container.colour=[1,2,3]", ["container.colour[1] is 2", "at most 1"]),
    ],
)
def test_a_wrong_name_is_a_sentence_with_the_names(override, words):
    with pytest.raises(SceneError) as error:
        scene_of("water").replaced(override)
    assert all(word in str(error.value) for word in words)


def test_painted_walls_are_seen_behind_the_fluid_and_above_it():
    orange = scene_of("water", container={"colour": [0.8, 0.3, 0.05]})
    image = drawn(orange)
    assert image[30, 32, 0] > 3.0 * image[30, 32, 2]
    above = drawn(orange.replaced("picture.look_at=[0.03,0.09,0.01]", "picture.camera=[0.03,0.09,0.5]"))[28, 32]
    assert above[0] > 3.0 * above[2]
    clear = drawn(scene_of("water"))
    assert not clear[30, 32, 0] > 1.5 * clear[30, 32, 2]


def test_the_walls_of_a_container_are_clear_unless_it_says_so():
    def walls(**container):
        scene = scene_of("water", container=container)
        return environment_of(painter(scene, np.full((1, 3), 0.01)).stage)

    assert [walls(**one).has_walls for one in ({}, {"material": "glass"}, {"material": "steel"})] == [0, 0, 1]
    assert walls(material="steel").wall_reflectivity == np.float32(FINISHES["steel"].reflectivity)
    assert walls(colour=[0.5, 0.2, 0.1]).has_walls == 1


def test_finishes_of_solids():
    def finish(**given):
        ball = {"name": "ball", "shape": "sphere", "centre": [0.03, 0.09, 0.01], "radius": 0.005, **given}
        return scene_of("water", solid=[ball]).solid[0].finish

    assert finish(material="steel") == FINISHES["steel"] and finish(material="glass") == FINISHES["glass"]
    assert finish(material="glass", transparency=0.5).transparency == 0.5
    gold = finish(material="steel", colour=[0.9, 0.6, 0.1])
    assert gold.colour == (0.9, 0.6, 0.1) and gold.reflectivity == FINISHES["steel"].reflectivity
    assert finish().reflectivity == finish().transparency == 0.0
