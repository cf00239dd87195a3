"""Files of the folder of a run as they are read again: whole, damaged, or of an earlier Cortado."""

import json
import math
import os
from pathlib import Path
from typing import Any

from cortado.errors import InputError
from cortado.files.atomic import parsed_json
from cortado.files.input_files import content, reason

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
