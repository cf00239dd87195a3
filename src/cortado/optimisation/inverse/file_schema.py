"""The JSON schema of a scene file, for editors: the tables of a scene, and those of a task, which may stand beside."""

import json
from typing import Any

from cortado.optimisation.inverse.tables import FitTables, TaskTables
from cortado.scene.scene import Scene


def file_schema() -> dict[str, Any]:
    """Of a scene or a task. It knows names, types, units and ranges; Cortado itself checks what must fit together."""
    scene, task, fit = (model.model_json_schema() for model in (Scene, TaskTables, FitTables))
    tables = {**scene["$defs"], **task["$defs"], **fit["$defs"]}
    for table in tables.values():
        _require_shape(table)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **{key: value for key, value in scene.items() if key != "$defs"},
        "title": "A scene of Cortado, or a task",
        "properties": {**scene["properties"], **task["properties"], **fit["properties"]},
        "$defs": tables,
    }


def file_schema_text() -> str:
    """The schema as it is shipped."""
    return json.dumps(file_schema(), indent=1, ensure_ascii=False) + "\n"


def _require_shape(table: dict[str, Any]) -> None:
    """A shape has a default in Python, but has to be named in a file."""
    if "shape" in table.get("properties", {}):
        table["required"] = ["shape", *table.get("required", [])]
