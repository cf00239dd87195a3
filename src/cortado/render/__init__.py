"""Differentiable rendering of particles through a colour field on a grid.

Names are imported on first use, so that importing ``cortado.render`` is fast.
"""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if TYPE_CHECKING:
    from cortado.render import cameras as cameras
    from cortado.render import renderer as renderer
    from cortado.render.cameras import Orthographic as Orthographic
    from cortado.render.cameras import Perspective as Perspective
    from cortado.render.cameras import TopView as TopView
    from cortado.render.cameras import Volume as Volume
    from cortado.render.renderer import Renderer as Renderer

_MODULES = ("cameras", "renderer")
_HOMES = {"Renderer": "renderer", **dict.fromkeys(("Orthographic", "Perspective", "TopView", "Volume"), "cameras")}
__all__ = sorted([*_MODULES, *_HOMES])

if not TYPE_CHECKING:
    __getattr__ = getter(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
