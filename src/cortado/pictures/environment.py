"""The surroundings of a stage, as kernels see them."""

from typing import Any

import numpy as np
import warp as wp

from cortado.pictures.pane import EDGE
from cortado.pictures.stage import Stage
from cortado.pictures.surroundings import GLASS_BOX, GLASS_CYLINDER, NO_GLASS, Environment


def environment_of(stage: Stage) -> Any:
    """`Environment`; what it knows of solids is added by others."""
    picture, light, s = stage.picture, stage.picture.sun_and_sky, Environment()
    horizon = np.asarray(light.background)
    s.size, s.nearest = stage.size, 1e-4 * stage.size
    s.sun, s.fill = wp.vec3(*stage.sun), wp.vec3(*stage.fill)
    s.horizon, s.zenith = wp.vec3(*horizon), wp.vec3(*(horizon * light.zenith))
    s.lamp, s.strip, s.sunlight = wp.vec3(*light.lamp), wp.vec3(*light.strip), wp.vec3(*light.sunlight)
    s.has_floor, s.floor_height = int(picture.floor), float(stage.lower[1])
    s.floor_colour = wp.vec3(*(0.93 * horizon))
    s.floor_centre = wp.vec3(*(0.5 * (stage.lower + stage.upper)))
    s.grid = _round_length(stage.size / 6.0)
    s.glass = NO_GLASS
    if stage.container.extent() is not None:
        lower, upper = stage.glass_ends
        s.glass = GLASS_BOX if stage.container.shape == "box" else GLASS_CYLINDER
        s.glass_frame = wp.mat33(*stage.glass_frame.ravel())
        s.glass_lower, s.glass_upper = wp.vec3(*lower), wp.vec3(*upper)
        lower, upper = (np.clip(end, -1e8, 1e8) for end in stage.room)
        s.room_lower, s.room_upper = wp.vec3(*lower), wp.vec3(*upper)
        s.has_room = int(stage.cuts and picture.surface == "liquid")
        finish = stage.container.finish
        s.edge_colour = wp.vec3(*(EDGE if finish is None else finish.colour))
        if finish is not None and not finish.transparency:
            s.has_walls, s.wall_colour, s.wall_reflectivity = 1, wp.vec3(*finish.colour), finish.reflectivity
        s.panes = wp.mat33(*(stage.panes * (1 - s.has_walls)).ravel(), 0.0, 0.0, 0.0)
    return s


def _round_length(length: float) -> float:
    """The next of 1, 2 and 5 times a power of ten below a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= length * (1.0 + 1e-9)))
