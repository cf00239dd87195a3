"""The surface of a fluid that ends at the walls of its container, as other programs need it: pictures are cut there."""

from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from cortado.device.bands import BandLauncher
from cortado.device.threads import WARP
from cortado.discretise.shapes import Points
from cortado.pictures.environment import environment_of
from cortado.pictures.liquid import liquid_surface
from cortado.pictures.stage import Stage
from cortado.pictures.surface import Surface
from cortado.pictures.wetting import particles_of, wetting
from cortado.scene.containers import CylinderContainer


def contained_liquid(stage: Stage, positions: Points, colours: Points, device: Any = "cpu") -> Surface:
    """The surface of what particles at positions (n, 3) [m] with colours (n, 3) fill, see `liquid_surface`, in the axes
    of the scene. Where fluid touches walls it is extended behind them, and its points there are then moved to the wall.

    Raises:
        ComputationError: there is no surface.
    """
    launch, stage = BandLauncher(wp.get_device(device)), replace(stage, solids=())
    with WARP:
        own = particles_of(stage, positions, colours, launch)
        found = liquid_surface(wetting(stage, environment_of(stage), own, launch), stage.spacing, launch)
        points, normals = (one.numpy().astype(np.float64) for one in (found.points, found.normals))
        triangles, colours = found.triangles.numpy().reshape(-1, 3), found.colours.numpy()
    if stage.cuts:
        kept = _in_room(stage, points)
        beyond = np.linalg.norm(points - kept, axis=1)
        is_moved = beyond > 0.0
        normals[is_moved] = (points - kept)[is_moved] / beyond[is_moved, None]
        points = kept
    return Surface(points @ stage.frame + stage.origin, triangles, normals @ stage.frame, colours)


def _in_room(stage: Stage, points: Points) -> Points:
    """(p, 3) the points of the container that are nearest to points (p, 3) [m], in the frame of the picture."""
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
