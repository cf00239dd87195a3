"""Variants of scenes, with a few values replaced."""

import warnings
from collections.abc import Mapping
from typing import Any

from cortado.errors import CortadoWarning
from cortado.scene.scene import Scene, scene_from_dict


def varied(scene: Scene, **changes: Any) -> Scene:
    """The scene with values replaced: ``varied(scene, forces={"viscosity": "none"}, phase={"viscosity": 2.0})``.

    A table replaces the keys that it has; beside a list of tables it does so in each of them. Nothing is said of keys
    that a term would need which is switched off.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".* changes nothing", CortadoWarning)
        return scene_from_dict(merged(scene.model_dump(), changes))


def merged(data: Any, changes: Any) -> Any:
    """Data with changes put in, table by table."""
    if isinstance(data, (list, tuple)) and data and isinstance(changes, Mapping):
        return [merged(entry, changes) for entry in data]
    if isinstance(data, Mapping) and isinstance(changes, Mapping):
        return {**data, **{key: merged(data.get(key), value) for key, value in changes.items()}}
    return changes
