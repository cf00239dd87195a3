"""The pages that list all keys of scenes and tasks are up to date, and their examples are valid files."""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
import scene_page
import task_page
import trimesh

from cortado.optimisation.inverse.fit_tables import FitTables
from cortado.optimisation.inverse.fit_task import load_fit
from cortado.optimisation.inverse.tables import TaskTables
from cortado.optimisation.inverse.task import load_task
from cortado.scene.scene import Scene, load_scene


@pytest.mark.parametrize("module", [scene_page, task_page])
def test_a_page_is_up_to_date(module):
    asked = f"run: python docs/site/{module.__name__}.py"
    assert module.PAGE.read_text(encoding="utf-8") == module.page(), asked


@pytest.mark.parametrize("module, models", [(scene_page, [Scene]), (task_page, [TaskTables, FitTables])])
def test_every_table_has_an_example_and_every_key_is_explained(module, models):
    tables = {name: table for model in models for name, table in model.model_json_schema()["$defs"].items()}
    assert module.examples().keys() == tables.keys()
    text = module.page()
    for name, table in tables.items():
        assert [key for key in table["properties"] if f"\n| `{key}` |" not in text] == [], name
    assert not re.findall(r"\| \.? \|\n", text), "a key without a meaning"


def parts(text: str) -> list[tuple[str, str]]:
    """Of a file its tables, each with its name; what comes before the first has the name ""."""
    found = re.split(r"^(?=\[)", text.strip() + "\n", flags=re.MULTILINE)
    return [(re.match(r"\[*([\w.]*)", part)[1] if part.startswith("[") else "", part) for part in found if part]


def replaced(whole: str, example: str) -> str:
    """A file in which the tables of an example stand in the place of those with the same names."""
    names = {name for name, _ in parts(example)}
    kept = [(name, part) for name, part in parts(whole) if name not in names]
    return "\n".join(part for _, part in sorted([*kept, *parts(example)], key=lambda named: named[0] != ""))


@pytest.mark.parametrize("model, example", scene_page.examples().items())
def test_an_example_of_a_scene_is_one(model, example, tmp_path):
    np.save(tmp_path / "drop.npy", np.full((2, 3), 0.3) + [[0.0, 0.0, 0.0], [0.05, 0.0, 0.0]])
    block = trimesh.creation.box(extents=[200.0, 200.0, 200.0])
    block.export(tmp_path / "block.stl")
    file = tmp_path / "scene.toml"
    file.write_text(replaced(scene_page.WHOLE, example))
    scene = load_scene(file)
    (table, given) = list(tomllib.loads(example).items())[-1]
    assert getattr(scene, table) != getattr(load_scene_of_the_page(tmp_path), table) or given["shape"] == "none"


def load_scene_of_the_page(folder: Path) -> Scene:
    file = folder / "whole.toml"
    file.write_text(scene_page.WHOLE)
    return load_scene(file)


@pytest.mark.parametrize("model, example", task_page.examples().items())
def test_an_example_of_a_task_is_one(model, example, tmp_path):
    file = tmp_path / "task.toml"
    is_fit = example in [part[3] for part in task_page.FIT_PARTS]
    file.write_text(scene_page.WHOLE + replaced(task_page.WHOLE_FIT if is_fit else task_page.WHOLE, example))
    assert (load_fit if is_fit else load_task)(file) is not None
