"""Reads files of ``experiments/``."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cortado.errors import SceneError, Words
from cortado.scene.scene import Scene, read_toml, scene_from_dict
from cortado.scene.tables import MISSING, sentences, wanted
from experiments.experiment import Experiment
from experiments.registry import EXPERIMENT_TYPES
from experiments.scenes import merged


def load_experiment(path: str | os.PathLike[str], reduced: bool = False, overrides: Sequence[str] = ()) -> Experiment:
    """Read an experiment; raises `SceneError` in one sentence.

    Args:
        path: the file; paths in it are relative to it.
        reduced: put the settings of its table [reduced] in place of others.
        overrides: replacements such as ``steps=100``.
    """
    file = os.fspath(path)
    data = read_toml(path, overrides)
    replaced = data.pop("reduced", {})
    if not isinstance(replaced, Mapping):
        raise SceneError(file, "reduced", replaced, "a table of settings that replace others")
    if reduced:
        data |= replaced
    name = data.pop("kind", MISSING)
    if not isinstance(name, str) or name not in EXPERIMENT_TYPES:
        raise SceneError(file, "kind", name, wanted({"enum": list(EXPERIMENT_TYPES)}))
    experiment_type = EXPERIMENT_TYPES[name]
    if "scene" in experiment_type.settings.model_fields and "scene" in data:
        data["scene"] = _scene(data["scene"], file)
    try:
        with sentences(experiment_type.settings):
            settings = experiment_type.settings.model_validate(data, context={"folder": Path(file).parent})
    except SceneError as error:
        raise error.in_file(file) from None
    return Experiment(Path(file).stem, experiment_type, settings, reduced)


def _scene(value: Any, file: str) -> Scene:
    table = {"file": value} if isinstance(value, str) else value
    if not isinstance(table, Mapping):
        raise SceneError(file, "scene", value, "the path of a scene, or a table of what differs from one")
    changes = {key: entry for key, entry in table.items() if key != "file"}
    if not isinstance(table.get("file", ""), str):
        raise SceneError(file, "scene.file", table["file"], "the path of a scene")
    if "file" in table:
        base = Path(file).parent / table["file"]
        scene = scene_from_dict(merged(read_toml(base), changes), os.fspath(base))
    else:
        scene = scene_from_dict(changes, file)
    if scene.solver.chooses:
        raise SceneError(file, "scene.solver.time_step", "auto", "a number of seconds, as experiments count steps")
    if scene.schedule.courses:
        raise SceneError(file, "scene.schedule", Words("given"), "left out, as experiments say what gravity is")
    return scene
