"""From particles to a picture and back: colour field on a grid, camera, image.

Its modules are imported when they are first used, so that ``cortado.render`` is quick.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cortado.render import cameras as cameras
    from cortado.render import renderer as renderer
    from cortado.render import scene_renderer as scene_renderer
    from cortado.render import views as views

__all__ = ["cameras", "renderer", "scene_renderer", "views"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return importlib.import_module(f"cortado.render.{name}")
    raise AttributeError(f"module 'cortado.render' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
