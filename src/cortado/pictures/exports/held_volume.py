"""Surfaces for other programs: they end at the walls of the container, where pictures are cut, and enclose the volume
of their particles. Around each body of fluid that is apart from others, all points are moved in or out by the same
distance."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import BandLauncher
from cortado.device.threads import WARP, usable_cores
from cortado.discretise.shapes import Points
from cortado.pictures.stage import Stage
from cortado.pictures.tracing.liquid_surface import Surface, liquid_surface, sized_level
from cortado.pictures.tracing.space import environment_of
from cortado.pictures.tracing.wetting import particles_of, wetting
from cortado.scene.containers import CylinderContainer

LINKED = 1.25
"""In spacings: particles that are nearer to each other are of one body."""
NEAR = 2.0
"""In spacings: particles that link to no surface are of the body of the nearest one, unless it is farther away."""
MOST = 1.0
"""In spacings, by which points are moved at most in a pass."""
PASSES = 2
"""Of moving points out, some beyond a wall, and back to it."""
ROUNDS = 20
"""Of Newton's method, each by a fifth of a spacing at most."""


def enclosed(points: Points, triangles: np.ndarray) -> float:
    """The volume [m³] within triangles (t, 3) of points (p, 3) [m]."""
    a, b, c = (points[corner] - points[0] for corner in triangles.T)
    return float(_sixth(a, b, c).sum())


def with_volume(
    points: Points,
    triangles: np.ndarray,
    ways: Points,
    places: Points,
    spacing: float,
    kept: Callable[[Points], Points],
) -> Points:
    """The points (p, 3) [m] of a surface with triangles (t, 3), moved along ``ways`` (p, 3), unit vectors outwards or 0
    where points stay, until each body of fluid has ``spacing``³ for each of its particles at ``places`` (n, 3) [m].
    ``kept``: brings points back to a wall that were moved beyond it."""
    of_points, of_particles = _bodies(points, triangles, places, spacing)
    count = max(of_points.max(), of_particles.max(initial=-1)) + 1
    wanted = np.bincount(of_particles[of_particles >= 0], minlength=count) * spacing**3
    for _ in range(PASSES):
        volumes, shift = _volumes(points - points[0], ways, triangles, of_points, count), np.zeros(count)
        for _ in range(ROUNDS):
            volume, slope = volumes(shift)
            step = np.divide(wanted - volume, slope, out=np.zeros(count), where=slope > 0.0)
            shift = np.clip(shift + np.clip(step, -0.2 * spacing, 0.2 * spacing), -MOST * spacing, MOST * spacing)
        points = kept(points + shift[of_points][:, None] * ways)
    return points


def _bodies(points: Points, triangles: np.ndarray, places: Points, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """The numbers of the bodies of fluid that points (p,) and particles (n,) belong to; -1 of particles without one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    def parts(count: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        links = coo_array((np.ones(len(first), dtype=np.int8), (first, second)), shape=(count, count))
        return np.asarray(connected_components(links, directed=False)[1])

    sheets = parts(len(points), triangles[:, :2].T.ravel(), triangles[:, 1:].T.ravel())
    tree, n = cKDTree(places), len(places)
    near = tree.query(points, workers=usable_cores())[1]
    pairs = tree.query_pairs(LINKED * spacing, output_type="ndarray")
    first, second = np.append(pairs[:, 0], near), np.append(pairs[:, 1], n + sheets)
    found = parts(n + sheets.max() + 1, first, second)
    of_points, of_particles = found[n + sheets], found[:n]
    alone = np.flatnonzero(~np.isin(of_particles, of_points))
    if len(alone):
        distances, nearest = cKDTree(points).query(places[alone], workers=usable_cores())
        of_particles[alone] = np.where(distances < NEAR * spacing, of_points[nearest], -1)
    return of_points, of_particles


def _volumes(
    points: Points, ways: Points, triangles: np.ndarray, bodies: np.ndarray, count: int
) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """The function that gives the volumes (bodies,) [m³] and their slopes [m²] where points of bodies (p,) are moved
    along their ways by distances (bodies,) [m]: a volume is a cubic polynomial of its distance."""
    (a, b, c), (x, y, z) = ([each[corner] for corner in triangles.T] for each in (points, ways))
    own = bodies[triangles[:, 0]]
    terms = (
        _sixth(a, b, c),
        _sixth(x, b, c) + _sixth(a, y, c) + _sixth(a, b, z),
        _sixth(x, y, c) + _sixth(x, b, z) + _sixth(a, y, z),
        _sixth(x, y, z),
    )
    c0, c1, c2, c3 = (np.bincount(own, term, count) for term in terms)
    return lambda d: (c0 + d * (c1 + d * (c2 + d * c3)), c1 + d * (2.0 * c2 + 3.0 * d * c3))


def _sixth(a: Points, b: Points, c: Points) -> np.ndarray:
    """(t,) a sixth of the determinants of vectors (t, 3)."""
    return np.einsum("tk,tk->t", a, np.cross(b, c)) / 6.0


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
