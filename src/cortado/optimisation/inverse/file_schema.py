"""The JSON schema of a scene file, for editors: the tables of a scene, and those of a task and of a data set, which may
stand beside."""

import json
from typing import Any

from cortado.optimisation.datasets import DatasetTables
from cortado.optimisation.inverse.fit_tables import FitTables
from cortado.optimisation.inverse.tables import TaskTables
from cortado.scene.scene import Scene


def file_schema() -> dict[str, Any]:
    """Of a scene or a task. It knows names, types, units and ranges; Cortado itself checks what must fit together."""
    models = (Scene, TaskTables, FitTables, DatasetTables)
    scene, task, fit, data_set = (model.model_json_schema() for model in models)
    tables = {**scene["$defs"], **task["$defs"], **fit["$defs"], **data_set["$defs"]}
    for table in tables.values():
        _require_shape(table)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **{key: value for key, value in scene.items() if key != "$defs"},
        "title": "A scene of Cortado, a task, or a data set",
        "properties": {**scene["properties"], **task["properties"], **fit["properties"], **data_set["properties"]},
        "$defs": tables,
    }


def file_schema_text() -> str:
    """The schema as it is shipped."""
    return json.dumps(file_schema(), indent=1, ensure_ascii=False) + "\n"


def _require_shape(table: dict[str, Any]) -> None:
    """A shape has a default in Python, but has to be named in a file."""
    if "shape" in table.get("properties", {}):
        table["required"] = ["shape", *table.get("required", [])]
