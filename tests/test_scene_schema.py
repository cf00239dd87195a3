"""The JSON schema of scenes, tasks and experiments: units, ranges and words for an editor, as they are checked."""

import json
import math
import re
import warnings
from unicodedata import normalize

import pytest
from pydantic import ValidationError

import experiments.registry  # noqa: F401  so that the tables of all experiments are there
from cortado.optimisation.inverse.tables import TaskTables
from cortado.scene.scene import Scene
from cortado.scene.tables import Table


def _tables(table: type[Table] = Table) -> list[type[Table]]:
    return [table, *(found for one in table.__subclasses__() for found in _tables(one))]


TABLES = [table for table in _tables() if table.model_fields]
FIELDS = [pytest.param(table, name, id=f"{table.__name__}.{name}") for table in TABLES for name in table.model_fields]


def schema_of(table: type[Table], name: str) -> dict:
    """What a field is if it is given, with what it refers to."""
    whole = table.model_json_schema()
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


@pytest.mark.parametrize("table, name", FIELDS)
def test_every_number_has_a_unit_which_is_that_of_its_description(table, name):
    schema = schema_of(table, name)
    number = schema.get("items", schema)
    if number.get("type") == "number":
        described = normalize("NFKC", schema.get("description", "")).replace(" / ", "/")
        said = re.search(r"\[([^\]]*[a-zA-Z/][^\]]*)\]", described)
        assert number["unit"] and (said is None or normalize("NFKC", number["unit"]).startswith(said[1]))


# The factors of a continuation schedule also have to grow: tests/test_extinction_schedule.py.
@pytest.mark.parametrize("table, name", [field for field in FIELDS if field.values[1] != "extinction_schedule"])
def test_ranges_in_the_schema_are_the_ranges_that_are_refused(table, name):
    schema = schema_of(table, name)
    entry = schema.get("items", {})
    one, wrap = (entry, lambda value: [value] * schema.get("minItems", 1)) if "type" in entry else (schema, lambda x: x)
    for bound, outwards in (("minimum", -1), ("exclusiveMinimum", -1), ("maximum", 1)):
        if bound in one:
            beyond = one[bound] + outwards if one["type"] == "integer" else math.nextafter(one[bound], outwards * 1e99)
            assert refused(table, name, wrap(beyond))
            assert refused(table, name, wrap(one[bound])) == (bound == "exclusiveMinimum")
    options = one.get("enum", [one["const"]] if "const" in one else [])
    for option in options:
        assert not refused(table, name, wrap(option)) and refused(table, name, wrap(f"{option}s"))
    if one.get("type") in ("number", "integer", "boolean"):
        assert refused(table, name, wrap("1")) and refused(table, name, wrap(math.nan))
    if schema.get("type") == "array" and entry.get("type", "array") != "array":
        good = entry.get("maximum", [*options, True if entry["type"] == "boolean" else "text"][0])
        for size in range(5):
            fits = schema.get("minItems", 0) <= size <= schema.get("maxItems", size)
            assert refused(table, name, [good] * size) != fits


@pytest.mark.parametrize("model", [Scene, TaskTables])
def test_an_editor_is_told_what_fields_mean_and_what_they_are_if_left_out(model):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        schema = json.loads(json.dumps(model.model_json_schema()))
    for table in [schema, *schema["$defs"].values()]:
        for name, field in table.get("properties", {}).items():
            assert "description" in field or "$ref" in field or name == "shape", name
            assert name in table.get("required", []) or "default" in field


def test_what_the_schema_of_a_scene_says():
    schema = Scene.model_json_schema()["$defs"]
    spacing, gravity = schema["DiscretisationTable"]["properties"]["spacing"], schema["Forces"]["properties"]["gravity"]
    assert (spacing["unit"], spacing["exclusiveMinimum"], spacing["maximum"]) == ("m", 0.0, 1e50)
    assert (gravity["items"]["unit"], gravity["default"]) == ("m/s2", [0.0, -9.81, 0.0])
    assert schema["Forces"]["properties"]["surface_tension"]["description"] == "tension of the free surface"
    assert schema["MixtureTable"]["properties"]["free_energy"]["enum"] == ["double_well", "miscible"]
    time_step = schema["PcisphSolver"]["properties"]["time_step"]
    assert time_step["description"].startswith("Length of a step [s]") and time_step["anyOf"][1]["const"] == "auto"
