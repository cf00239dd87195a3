"""From particles to a picture and back: colour field on a grid, camera, image.

Its names are imported when they are first used, so that ``cortado.render`` is quick.
"""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if TYPE_CHECKING:
    from cortado.render import cameras as cameras
    from cortado.render import renderer as renderer
    from cortado.render import scene_renderer as scene_renderer
    from cortado.render import views as views
    from cortado.render.cameras import Orthographic as Orthographic
    from cortado.render.cameras import Perspective as Perspective
    from cortado.render.renderer import Renderer as Renderer
    from cortado.render.views import TopView as TopView
    from cortado.render.views import Volume as Volume

_MODULES = ("cameras", "renderer", "scene_renderer", "views")
_HOMES = {
    "Orthographic": "cameras",
    "Perspective": "cameras",
    "Renderer": "renderer",
    "TopView": "views",
    "Volume": "views",
}
__all__ = sorted([*_MODULES, *_HOMES])

if not TYPE_CHECKING:
    __getattr__ = getter(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
