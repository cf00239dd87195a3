"""A scene as somebody wants it drawn: with other keys of its table [picture]."""

from collections.abc import Collection, Mapping
from typing import Any

from pydantic_core import PydanticCustomError

from cortado.arrays import whole_number
from cortado.errors import SceneError
from cortado.scene.camera_paths import CameraPath
from cortado.scene.picture import Picture
from cortado.scene.scene import Scene
from cortado.scene.sentences import field_name

WIDE = 16.0 / 9.0
"""Columns over rows of pictures of so many lines."""


def shown_as(scene: Scene, settings: Mapping[str, Any], fields: Collection[str] = ()) -> Scene:
    """The scene with keys of [picture] replaced. ``lines`` sets width and height, and ``camera`` takes a path too, such
    as `pictures.Orbit`; ``colour`` may name one of ``fields``, which not all scenes have.

    Raises:
        SceneError: settings that do not fit.
    """
    given = {} if scene.picture is None else scene.picture.model_dump()
    wanted = {**given, **settings}
    if "lines" in settings:
        lines = whole_number("lines", wanted.pop("lines"), 64)
        wanted |= {"width": 2 * round(0.5 * WIDE * lines), "height": lines}
    if isinstance(wanted.get("camera"), CameraPath):
        wanted |= {"camera": given.get("camera"), "camera_path": wanted["camera"].model_dump()}
    own = wanted.get("colour")
    is_field = isinstance(own, str) and own in fields
    try:
        table = Picture(**{**wanted, "colour": "phase"} if is_field else wanted)
        table = table.in_scene(scene.dimension, [one.name for one in scene.solid], ("picture",))
    except SceneError as problem:
        raise SceneError(None, f"picture.{problem.field}", *problem.args[2:]) from None
    except PydanticCustomError as problem:
        error = (problem.context or {})["error"]
        raise SceneError(None, field_name(error.path), error.found, error.wanted) from None
    return scene.model_copy(update={"picture": table.model_copy(update={"colour": own}) if is_field else table})
