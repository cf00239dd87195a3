"""The surface of a fluid that ends at the walls of its container, as other programs need it: pictures are cut there."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from cortado.device.bands import BandLauncher
from cortado.device.threads import WARP
from cortado.discretise.shapes import Points
from cortado.pictures.environment import environment_of
from cortado.pictures.held_volume import with_volume
from cortado.pictures.liquid import liquid_surface, sized_level
from cortado.pictures.stage import Stage
from cortado.pictures.surface import Surface
from cortado.pictures.wetting import particles_of, wetting
from cortado.scene.containers import CylinderContainer

SAME = 1e-6
"""In spacings: points that a turn into the axes of the container and back moves by less are where they were."""


def contained_liquid(stage: Stage, positions: Points, colours: Points, device: Any = "cpu") -> Surface:
    """The surface of what particles at positions (n, 3) [m] with colours (n, 3) fill, see `liquid_surface`, in the axes
    of the scene. Where fluid touches walls it is extended behind them, and its points there are then moved to the wall.
    The others are moved until the surface encloses the volume of the particles; see `with_volume`.

    Raises:
        ComputationError: there is no surface.
    """
    launch, stage = BandLauncher(wp.get_device(device)), replace(stage, solids=())
    with WARP:
        own = particles_of(stage, positions, colours, launch)
        fluid = wetting(stage, environment_of(stage), own, launch)
        found = liquid_surface(fluid, stage.spacing, launch, sized_level(fluid, stage.spacing, launch))
        places = own.places.numpy().astype(np.float64)
        points, normals = (one.numpy().astype(np.float64) for one in (found.points, found.normals))
        triangles, colours = found.triangles.numpy().reshape(-1, 3), found.colours.numpy()
    kept = _in_room(stage, points)
    beyond = np.linalg.norm(points - kept, axis=1)
    is_free = beyond <= SAME * stage.spacing
    normals[~is_free] = (points - kept)[~is_free] / beyond[~is_free, None]
    ways, in_room = np.where(is_free[:, None], normals, 0.0), partial(_in_room, stage)
    points = with_volume(kept, triangles, ways, places, stage.spacing, in_room)
    return Surface(points @ stage.frame + stage.origin, triangles, normals @ stage.frame, colours)


def _in_room(stage: Stage, points: Points) -> Points:
    """(p, 3) the points of the container, where it cuts fluid, that are nearest to points (p, 3) [m], in the frame of
    the picture."""
    if not stage.cuts:
        return points
    lower, upper = stage.room
    places = points @ stage.glass_frame.T
    if isinstance(stage.container, CylinderContainer):
        radius = 0.5 * (upper[0] - lower[0])
        off = places[:, ::2] - 0.5 * (lower + upper)[::2]
        places[:, ::2] -= off * np.maximum(1.0 - radius / np.linalg.norm(off, axis=1, keepdims=True), 0.0)
        places[:, 1] = np.clip(places[:, 1], lower[1], upper[1])
    else:
        places = np.clip(places, lower, upper)
    found: Points = places @ stage.glass_frame
    return found
