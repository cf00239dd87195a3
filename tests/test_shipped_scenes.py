"""No scene that is shipped is warned of for its time step, nor is a search from its start to its target."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from cortado.cli.commands.new import new_scene, templates
from cortado.errors import CortadoWarning
from cortado.optimisation.inverse.task import load_task
from cortado.rollout.run_checks import unstable_sentence
from cortado.scene.parameter_values import Tilt
from cortado.scene.scene import load_scene

ROOT = Path(__file__).parents[1]
FOLDERS = ("examples", "docs/figures", "experiments/scenes")
FILES = [path for folder in FOLDERS for path in sorted((ROOT / folder).glob("*.toml"))]
TASKS = [path for path in FILES if "[optimise]" in path.read_text(encoding="utf-8")]


def loaded(path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", CortadoWarning)
        load_scene(path)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_no_scene_is_warned_of(path):
    loaded(path)


@pytest.mark.parametrize(("template", "dimension"), [("dam", 2), ("dam", 3), *((one, None) for one in templates()[1:])])
def test_no_new_scene_is_warned_of(tmp_path, template, dimension):
    new_scene(tmp_path / "scene.toml", template, dimension)
    loaded(tmp_path / "scene.toml")


@pytest.mark.parametrize("path", TASKS, ids=lambda path: path.stem)
def test_no_search_is_warned_of(path):
    """At its start and at its target."""
    task = load_task(path)
    tilt = Tilt(task.scene.forces.gravity)
    start = {name: value for name, value in task.start.items() if not isinstance(value, str)}
    for values in (start, dict(task.true_parameters)):
        if "tilt" in values:
            values["gravity"] = tilt.gravity(np.atleast_2d(values.pop("tilt")))
        assert not task.problem.steps or unstable_sentence(values, task.scene, set()) is None
