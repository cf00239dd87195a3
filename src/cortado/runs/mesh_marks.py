"""Marks of the mesh files that a scene names, by which one sees later whether they are still those of a run."""

import json
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path

from cortado.errors import InputError
from cortado.runs.run_files import bytes_of


def mesh_marks(scene_json: str) -> dict[str, str]:
    """What marks each file of a mesh in a resolved scene, by its path."""
    tables = json.loads(scene_json)
    meshes = [table for kind in ("solid", "fluid") for table in tables.get(kind) or () if table.get("file")]
    return {table["file"]: _mark(Path(table["file"])) for table in meshes}


def require_meshes(marks: Mapping[str, str], run: Path) -> None:
    """Raises `InputError` for a file that is no longer the one a run was made with."""
    for name, mark in marks.items():
        if not Path(name).is_file():
            raise InputError(f"{name} is missing, but the run in {run} was made with it: put it back.")
        if _mark(Path(name)) != mark:
            raise InputError(f"{name} has changed since the run in {run} was made with it: put the former file back.")


def _mark(path: Path) -> str:
    return sha256(bytes_of(path)).hexdigest()
