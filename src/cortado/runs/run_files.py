"""Files in the folder of a run, written and read again: damaged ones, those of an earlier Cortado, changed meshes."""

from __future__ import annotations

import json
import math
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from hashlib import sha256
from importlib import metadata
from pathlib import Path
from typing import Any

from cortado.errors import LONGEST, InputError, shown
from cortado.files.input_files import content, reason
from cortado.files.output_files import parsed_json
from cortado.version import __version__

FORMER_FRAMES = 120
"""The default of film_frames in folders without a format."""
LARGEST = 2**31
"""Bytes of a file that is read again when a run goes on."""


def in_present_words(scene_json: str, has_format: bool) -> str:
    """A scene of a folder of before: `colour` of [picture] was called colour_by, and in folders without a format the
    default of film_frames, 120, was written as if it were asked for."""
    try:
        scene = json.loads(scene_json)
        picture = scene["picture"]
        if "colour_by" in picture:
            picture["colour"] = picture.pop("colour_by") or "phase"
        if not has_format and picture["film_frames"] == FORMER_FRAMES:
            del picture["film_frames"]
    except (ValueError, RecursionError, LookupError, TypeError):
        return scene_json  # an error is reported where it is read
    return json.dumps(scene)


def computed(scene: Any) -> Any:
    """A scene without what changes only how it is shown, and what is read of it."""
    shown = ("picture", "sensor")
    return {name: table for name, table in scene.items() if name not in shown} if isinstance(scene, dict) else scene


def finite(value: Any) -> Any:
    """A value without numbers that JSON does not have."""
    if isinstance(value, dict):
        return {name: finite(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def bytes_of(path: Path) -> bytes:
    """All of a file; raises `InputError` if it is no regular one, or very large."""
    try:
        return content(path, LARGEST)
    except OSError as problem:
        raise InputError(f"{path} cannot be read: {reason(problem)}.") from problem


def read_json(path: Path) -> Any:
    try:
        return parsed_json(bytes_of(path))
    except ValueError as problem:
        raise InputError(f"{path} cannot be read: {reason(problem)}.") from problem


def cut_torn_line(path: Path) -> None:
    """Removes what a killed run left of a last line, so that the next line begins a line."""
    if path.exists():
        os.truncate(path, bytes_of(path).rfind(b"\n") + 1)


_PACKAGES = ("warp-lang", "numpy", "scipy", "pydantic", "h5py", "matplotlib")


def session(command: Sequence[str], device: str) -> dict[str, Any]:
    """Where and when a part of a run happens: operating system, Python, the versions that matter, the command."""
    return {
        "cortado": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "executable": sys.executable,
        "packages": {name: _version(name) for name in _PACKAGES},
        "device": device,
        "command": list(command),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def plain(value: Any) -> Any:
    """NumPy numbers and arrays as Python numbers and lists."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")


def as_json(value: Any) -> Any:
    """A value as it comes back from a file: arrays and tuples are lists."""
    return json.loads(json.dumps(value, default=plain))


def require_same(former: Any, given: Any, folder: Path, field: str = "") -> None:
    """Raise InputError, with the field, where what is given differs from what the run in a folder was begun with."""
    if isinstance(former, dict) and isinstance(given, dict):
        for name in sorted({*former, *given}):
            require_same(former.get(name), given.get(name), folder, f"{field}.{name}".lstrip("."))
    elif _are_tables(former) and _are_tables(given) and len(former) == len(given):
        for k, pair in enumerate(zip(former, given, strict=True)):
            require_same(*pair, folder, f"{field}[{k}]")
    elif former != given:
        raise InputError(
            f"The run in {folder} was begun with {field} = {_written(former)} and is now given {field} = "
            f"{_written(given)}; give the former, or choose another --out."
        )


def _written(value: Any) -> str:
    """As in a file; what is left out has no value."""
    if value is None:
        return "nothing"
    return json.dumps(value)[: 2 * LONGEST] if isinstance(value, dict) else shown(value)


def _are_tables(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(entry, dict) for entry in value)


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


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
