"""Tables of a scene: the JSON schema of all, several phases and how they mix, and how pictures are taken."""

import json
import math
import re
import tomllib
import warnings
from unicodedata import normalize

import numpy as np
import pytest
from pydantic import ValidationError

import cortado
import experiments.registry  # noqa: F401  so that the tables of all experiments are there
from bad_scenes import GOOD_SCENE, MIXTURE
from bad_scenes import plane as plane_tables
from cortado import InputError, Problem, SceneError, Simulation
from cortado.device.precision import FLOAT64
from cortado.optimisation.task_tables import TaskTables
from cortado.particles.state import to_device
from cortado.render.cameras import TopView
from cortado.render.renderer import scene_renderer
from cortado.scene.appearance import Render
from cortado.scene.fluid_particles import fluid_particles
from cortado.scene.model import MixtureTable
from cortado.scene.scene import Scene, scene_from_dict
from cortado.scene.tables import Table
from every_key import json_schema
from scenes import box, plane, plane_of_three, scene


def _tables(table: type[Table] = Table) -> list[type[Table]]:
    return [table, *(found for one in table.__subclasses__() for found in _tables(one))]


TABLES = [table for table in _tables() if table.model_fields]


def schema_of(table: type[Table], name: str) -> dict:
    """What a field is if it is given, with what it refers to."""
    whole = json_schema(table)
    part = whole["properties"][name]
    part = {**part, **part["anyOf"][0]} if "anyOf" in part else part
    return whole["$defs"][part["$ref"].rpartition("/")[2]] if "$ref" in part else part


def refused(table: type[Table], name: str, value: object) -> bool:
    """Whether a value is none of the field's, whatever the other fields are."""
    try:
        table.model_validate({name: value})
    except ValidationError as error:
        return any(one["loc"][:1] == (name,) and one["type"] != "scene" for one in error.errors())
    return False


# The factors of a continuation schedule also have to grow: tests/test_extinction_schedule.py.


tables = pytest.mark.parametrize("table", TABLES)


@tables
def test_every_number_has_a_unit_which_is_that_of_its_description(table):
    for name in table.model_fields:
        schema = schema_of(table, name)
        number = schema.get("items", schema)
        if number.get("type") == "number":
            described = normalize("NFKC", schema.get("description", "")).replace(" / ", "/")
            said = re.search(r"\[([^\]]*[a-zA-Z/][^\]]*)\]", described)
            assert number["unit"] and (said is None or normalize("NFKC", number["unit"]).startswith(said[1])), name


@tables
def test_ranges_in_the_schema_are_the_ranges_that_are_refused(table):
    """The factors of a continuation schedule also have to grow: tests/test_extinction_schedule.py."""
    for name in table.model_fields.keys() - {"extinction_schedule"}:
        check_ranges(table, name)


def check_ranges(table, name):
    schema = schema_of(table, name)
    entry = schema.get("items", {})
    one, wrap = (entry, lambda value: [value] * schema.get("minItems", 1)) if "type" in entry else (schema, lambda x: x)
    for bound, outwards in (("minimum", -1), ("exclusiveMinimum", -1), ("maximum", 1)):
        if bound in one:
            beyond = one[bound] + outwards if one["type"] == "integer" else math.nextafter(one[bound], outwards * 1e99)
            assert refused(table, name, wrap(beyond)), name
            assert refused(table, name, wrap(one[bound])) == (bound == "exclusiveMinimum"), name
    options = one.get("enum", [one["const"]] if "const" in one else [])
    for option in options:
        assert not refused(table, name, wrap(option)) and refused(table, name, wrap(f"{option}s")), name
    if one.get("type") in ("number", "integer", "boolean"):
        assert refused(table, name, wrap("1")) and refused(table, name, wrap(math.nan)), name
    if schema.get("type") == "array" and entry.get("type", "array") != "array":
        good = entry.get("maximum", [*options, True if entry["type"] == "boolean" else "text"][0])
        for size in range(5):
            fits = schema.get("minItems", 0) <= size <= schema.get("maxItems", size)
            assert refused(table, name, [good] * size) != fits, name


@pytest.mark.parametrize("model", [Scene, TaskTables])
def test_an_editor_is_told_what_fields_mean_and_what_they_are_if_left_out(model):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        schema = json.loads(json.dumps(model.model_json_schema()))
    for table in [schema, *schema["$defs"].values()]:
        for name, field in table.get("properties", {}).items():
            assert "description" in field or "$ref" in field or name == "shape", name
            assert name in table.get("required", []) or "default" in field


PHASES = [{"name": name, "rest_density": 1000, "viscosity": 0.001} for name in ("water", "oil", "ink")]
FLUIDS = [box([0, a], [1, b], phase=phase) for a, b, phase in [(0.5, 1, "ink"), (0, 0.5, "water"), (1, 1.1, "oil")]]


def test_phases_are_counted_in_the_order_of_the_scene():
    scene = Scene(**plane_tables(phase=PHASES, fluid=FLUIDS))
    assert fluid_particles(scene).phase.tolist() == [2] * 50 + [0] * 50 + [1] * 10
    assert Scene.from_json(scene.to_json()) == scene and scene.mixture == MixtureTable()


def test_a_mixture_keeps_what_its_file_says_and_has_an_interface_as_wide_as_a_spacing_if_that_is_left_out():
    mixture = scene_from_dict(tomllib.loads(GOOD_SCENE + MIXTURE)).mixture
    assert (mixture.free_energy, mixture.strength, mixture.mobility) == ("miscible", 2.0, 1e-5)
    assert (mixture.mobility_form, mixture.interface_width, mixture.width(0.05)) == ("constant", 0.1, 0.1)
    mixture = Scene(**plane_tables(phase=PHASES, mixture={"mobility": 1e-6})).mixture
    assert (mixture.interface_width, mixture.width(0.1)) == (None, 0.1)
    assert (mixture.free_energy, mixture.strength, mixture.mobility_form) == ("double_well", 1.0, "degenerate")


def test_one_phase_has_nothing_to_mix_with():
    wanted = r"^mixture is given, but must be left out, as the scene has only one phase\.$"
    with pytest.raises(SceneError, match=wanted):
        Scene(**plane_tables(mixture=MixtureTable(mobility=1e-6)))
    assert Scene(**plane_tables(mixture=MixtureTable())) == Scene(**plane_tables())


def space(**render) -> Scene:
    return scene_from_dict(tomllib.loads(GOOD_SCENE) | {"render": render})


def test_what_is_left_out_has_a_default():
    render = space().render
    for made in (space(), space(view="top"), Scene(**plane_tables(render={}))):
        assert Scene.from_json(made.to_json()) == made
    assert (render.view, render.resolution, render.background) == ("top", (128, 128), (1.0, 1.0, 1.0))
    assert {render.extinction, render.position, render.look_at, render.field_of_view} == {None}
    assert space(view="volume", position=[0, 0, 1], look_at=[0, 0, 0]).render.field_of_view == 40.0
    assert Scene(**plane_tables(render={})).render.view == "plane"
    assert Scene(**plane_tables(render=Render(view="plane"))).render.view == "plane"


def test_a_view_that_a_scene_has_not_is_refused():
    for view in ({"view": "top"}, {"view": "volume", "position": [0, 0, 1], "look_at": [0, 0, 0]}):
        with pytest.raises(SceneError, match=r'^render\.view is .*"plane", as the scene has 2 dimensions\.$'):
            Scene(**plane_tables(render=view))
    with pytest.raises(SceneError, match=r"""^render\.view is 'plane', but must be "top" or "volume" in 3-D\.$"""):
        space(view="plane")
    wanted = r'^field_of_view is 30.0, but must be left out, as the view is "top": only .* "volume" has a camera\.$'
    with pytest.raises(SceneError, match=wanted):
        Render(field_of_view=30)


def test_fluid_that_went_round_is_still_seen():
    round_it = box([0.0, 0.0], [1.5, 1.0], periodic=[True, False])
    tables = plane_tables(render={"resolution": [20, 16]}, container=round_it)
    simulation = Simulation(Scene(**tables), precision="float64")
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


def test_one_phase_needs_no_fractions_and_several_do():
    renderer = Simulation(plane(), precision="float64").renderer()
    x = Simulation(plane()).positions
    np.testing.assert_array_equal(renderer.render(x), renderer.render(x, np.ones((len(x), 1))))
    with pytest.raises(InputError, match=r"^fractions is left out, but must be mass fractions \(64, 3\)"):
        Simulation(plane_of_three()).renderer().render(np.zeros((64, 2)))


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
