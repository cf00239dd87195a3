"""The shadow that fluid casts on the floor: soft, and in the colour of the fluid."""

from collections.abc import Sequence

import numpy as np

from cortado.discretise.shapes import Points
from cortado.pictures.shown_solids import ShownSolid
from cortado.pictures.solid_mesh import SolidMesh
from cortado.pictures.stage import Stage

NODES = 320
"""Along either side of the floor that may lie in shadow."""
ABOVE = 1e-3
"""In sizes of what is shown: a side of a solid that is no higher lies on the floor."""
REACH = 1.5
"""Half the width of that part of the floor, in sizes of what is shown."""


def floor_shadow(stage: Stage, positions: Points, colours: Points) -> tuple[Points, Points, float]:
    """The part of the light that reaches the floor, (nodes, nodes, 3), by x and z; where its first node is, (3,) [m];
    and how far nodes are apart [m].

    ``positions`` (n, 3) [m] are in the frame of the picture, ``colours`` (n, 3) linear.
    """
    corner, cell = _nodes(stage)
    height = positions[:, 1:2] - stage.lower[1]
    cast = positions[:, ::2] - height * stage.sun[::2] / stage.sun[1]
    volume = stage.spacing**3
    near, least = np.exp(-height[:, 0] / (0.15 * stage.size)), 0.8 * stage.spacing
    key = _thickness(cast, colours, corner, cell, volume, max(0.022 * stage.size, least))
    around = _thickness(positions[:, ::2], colours, corner, cell, volume * near, max(0.05 * stage.size, least))
    light = 1.0 - stage.picture.sun_and_sky.shadow * _hidden(stage, *key) - 0.32 * _hidden(stage, *around)
    return light, corner, cell


def solid_shadow(stage: Stage, solids: Sequence[tuple[ShownSolid, SolidMesh]]) -> Points:
    """(nodes, nodes, 3) the part of the light that solids leave on the floor; as `floor_shadow`."""
    corner, cell = _nodes(stage)
    light = np.ones((NODES, NODES, 3))
    for shown, mesh in solids:
        a, b, c = mesh.points[mesh.triangles].transpose(1, 0, 2)
        middle = (a + b + c) / 3.0
        casts = middle[:, 1] > stage.lower[1] + ABOVE * stage.size
        if stage.cuts_solids:
            casts &= ((middle >= stage.lower) & (middle <= stage.upper))[:, ::2].all(axis=1)
        middle, area = middle[casts], 0.5 * np.cross(b - a, c - a)[casts]
        height, colours = middle[:, 1:2] - stage.lower[1], np.tile(shown.colour, (len(middle), 1))
        cast = middle[:, ::2] - height * stage.sun[::2] / stage.sun[1]
        thick, flat = 3.0 * stage.spacing, np.abs(area[:, 1]) * np.exp(-height[:, 0] / (0.15 * stage.size))
        towards = np.abs(area @ stage.sun) / stage.sun[1]
        key = _thickness(cast, colours, corner, cell, thick * towards, 0.022 * stage.size)
        around = _thickness(middle[:, ::2], colours, corner, cell, thick * flat, 0.05 * stage.size)
        hidden = [1.0 - np.exp(-thickness / (0.75 * stage.spacing)) for thickness, _ in (key, around)]
        kept_off = (1.0 - shown.transparency) * (stage.picture.sun_and_sky.shadow * hidden[0] + 0.32 * hidden[1])
        light = np.minimum(light, 1.0 - kept_off[..., None])
    return light


def _nodes(stage: Stage) -> tuple[Points, float]:
    """Where the first node is, (3,) [m], and how far nodes are apart [m]."""
    middle = 0.5 * (stage.lower + stage.upper)
    corner = np.array([middle[0], stage.lower[1], middle[2]]) - np.array([REACH, 0.0, REACH]) * stage.size
    return corner, 2.0 * REACH * stage.size / (NODES - 1)


def _thickness(
    places: Points, colours: Points, corner: Points, cell: float, volume: Points | float, blur: float
) -> tuple[Points, Points]:
    """How thick the fluid is above every node, (nodes, nodes) [m], and its mean colour (nodes, nodes, 3)."""
    from scipy.ndimage import gaussian_filter

    at = np.rint((places - corner[[0, 2]]) / cell).astype(int)
    on = ((at >= 0) & (at < NODES)).all(axis=1)
    flat, weights = at[on, 0] * NODES + at[on, 1], np.broadcast_to(volume, len(places))[on] / cell**2

    def spread(values: Points) -> Points:
        total = np.bincount(flat, weights * values, minlength=NODES * NODES).reshape(NODES, NODES)
        return gaussian_filter(total, blur / cell)

    total = spread(np.ones(len(flat)))
    tinted = np.stack([spread(colours[on, k]) for k in range(3)], axis=-1)
    return total, tinted / np.maximum(total, 1e-12)[..., None]


def _hidden(stage: Stage, thickness: Points, colour: Points) -> Points:
    """(nodes, nodes, 3) the part of the light that fluid of a thickness keeps off."""
    reached = 1.0 - np.exp(-thickness / (0.75 * stage.spacing))
    hue = colour / np.maximum(colour.max(axis=-1, keepdims=True), 1e-6)
    return reached[..., None] * (1.0 - 0.4 * stage.transparency * (0.35 + 0.65 * hue))
