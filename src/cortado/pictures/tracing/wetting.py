"""Mirror images of particles behind walls and solids that they touch.

The surface around fluid is drawn with them: it goes on behind a wall, which cuts or hides it, and no gap is seen
between fluid and wall.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import BandLauncher
from cortado.discretise.shapes import Points
from cortado.pictures.shown_solids import ShownSolid
from cortado.pictures.stage import Stage
from cortado.pictures.tracing.near_particles import MODULE, Ints, Look, Particles, Vec3s, last_of, mixed
from cortado.pictures.tracing.surroundings import GLASS_BOX, Environment

SKIN = 0.7
"""In spacings: about how far beyond a particle fluid is drawn."""
DEPTHS = (1.0, 0.7, 0.4, 0.1)
"""Of mirror images behind a surface, in parts of the distance of what they show; the first that a thin solid hides."""
ON_SURFACE = 0.05
"""In spacings: how near to a surface a point is on it."""
SAME_SIDE = 0.8
"""Greatest cosine between the normals of two sides of a corner."""


def mirrored(
    points: Points, solids: Sequence[ShownSolid], touching: float, spacing: float
) -> tuple[Points, np.ndarray]:
    """Return mirror images (m, d) [m] of points (n, d) [m] behind solids, and the point of each, (m,).

    Points have images if they are nearer to a solid than ``touching`` [m]: behind each side of it that they touch, and
    behind corners between these. Where a solid is too thin to hide fluid that is drawn there, images are nearer to the
    surface, or there are none.
    """
    dimension = points.shape[1]
    images, of = [np.zeros((0, dimension))], [np.zeros(0, dtype=int)]
    for shown in solids:
        distances = shown.solid.distance(points)
        near = np.flatnonzero((distances > 0.0) & (distances < touching))
        ways = _ways(points[near], shown, touching, spacing)
        for count in range(1, dimension + 1):
            for chosen in combinations(ways, count):
                there = np.all([way.any(axis=1) for way in chosen], axis=0)
                images.append((points[near] + np.sum(chosen, axis=0))[there])
                of.append(near[there])
    return np.concatenate(images), np.concatenate(of)


def _ways(points: Points, shown: ShownSolid, touching: float, spacing: float) -> list[Points]:
    """Return the way (n, d) [m] from each of the points (n, d) [m] to its image behind each side that it touches; 0
    where there is none. Sides are looked for towards the nearest point, and along the axes of the solid."""
    solid, normals, ways = shown.solid, list[Points](), list[Points]()
    for probe in touching * np.concatenate([np.zeros((1, len(shown.turn))), shown.turn.T, -shown.turn.T]):
        feet, away = solid.nearest(points + probe), solid.outward(points + probe)
        heights = ((points - feet) * away).sum(axis=1)[:, None]
        below = points - heights * away
        is_new = ((heights > 0.0) & (heights < touching))[:, 0] & (np.abs(solid.distance(below)) < ON_SURFACE * spacing)
        for other in normals:
            is_new &= (away * other).sum(axis=1) < SAME_SIDE
        way = np.zeros_like(points)
        for part in DEPTHS[::-1]:
            hidden = is_new & (solid.distance(below - (part * heights + SKIN * spacing) * away) < 0.0)
            way = np.where(hidden[:, None], -(1.0 + part) * heights * away, way)
        normals.append(np.where(is_new[:, None], away, 0.0))
        ways.append(way)
    return ways


TOUCHING, TOUCHING_SOLID, TOUCHING_ROUND = wp.constant(wp.float32(0.8)), 1.1, wp.constant(wp.float32(1.5))
"""In spacings: fluid that is nearer to a flat wall, to a solid and to a round wall touches it. A cubic lattice in a
round cup ends up to one and a half spacings from its wall."""


@wp.kernel(module=MODULE, enable_backward=False)
def turn(first: wp.int32, frame: wp.mat33, places: Vec3s):
    i = first + wp.tid()
    places[i] = frame * places[i]


def particles_of(
    stage: Stage, positions: np.ndarray, colours: np.ndarray, launch: BandLauncher, fractions: Points | None = None
) -> Particles:
    """Return particles in the picture's frame, at positions (n, 3) [m] in the scene's axes, with colours (n, 3) and
    mass fractions (n, phases), even ones if left out. Along a periodic axis they are where their images within the
    period are."""
    media = stage.media.mean(axis=0) if fractions is None else mixed(fractions, stage.media)
    places = stage.container.domain(3).wrapped(positions)
    found = Particles.on(launch.device, np.subtract(places, stage.origin), colours, media)
    launch(turn, len(found), frame=wp.mat33(*stage.frame.ravel()), places=found.places)
    return found


@wp.func
def images_along(s: Environment, q: wp.vec3, axis: wp.int32, spacing: wp.float32):
    """Return which images a particle, in the container's frame, has along an axis, as bits 1 and 2: those behind the
    lower and the upper wall. Along the first axis of a cylinder they are behind its round wall."""
    found = wp.int32(0)
    if s.glass == wp.static(GLASS_BOX) or axis == 1:
        if wp.abs(q[axis] - s.room_lower[axis]) < TOUCHING * spacing:
            found = found | 1
        if wp.abs(q[axis] - s.room_upper[axis]) < TOUCHING * spacing:
            found = found | 2
    elif axis == 0:
        off = q - 0.5 * (s.glass_lower + s.glass_upper)
        radius = 0.5 * (s.glass_upper[0] - s.glass_lower[0])
        if wp.abs(radius - wp.sqrt(off[0] * off[0] + off[2] * off[2])) < TOUCHING_ROUND * spacing:
            found = 3
    return found


@wp.func
def image_along(s: Environment, q: wp.vec3, axis: wp.int32, which: wp.int32, spacing: wp.float32):
    """Return the way from a particle to an image: 0 to image 0, itself, and then to those of `images_along`."""
    way = wp.vec3(0.0)
    if which == 0:
        return way
    if s.glass == wp.static(GLASS_BOX) or axis == 1:
        way[axis] = 2.0 * (wp.where(which == 1, s.room_lower[axis], s.room_upper[axis]) - q[axis])
        return way
    off = q - 0.5 * (s.glass_lower + s.glass_upper)
    return float(which) * spacing * wp.normalize(wp.vec3(off[0], 0.0, off[2]))


@wp.func
def has_image(which: wp.int32, images: wp.int32):
    return which == 0 or (images >> (which - 1)) & 1 == 1


@wp.kernel(module=MODULE, enable_backward=False)
def count_images(first: wp.int32, s: Environment, spacing: wp.float32, places: Vec3s, counts: Ints):
    """Count the images of each particle, itself among them."""
    i = first + wp.tid()
    q = s.glass_frame * places[i]
    count = wp.int32(1)
    for axis in range(3):
        images = images_along(s, q, axis, spacing)
        count = count * (1 + (images & 1) + (images >> 1))
    counts[i] = count


@wp.kernel(module=MODULE, enable_backward=False)
def list_images(
    first: wp.int32,
    s: Environment,
    spacing: wp.float32,
    places: Vec3s,
    looks: wp.array(dtype=Look),
    counts: Ints,
    image_places: Vec3s,
    image_looks: wp.array(dtype=Look),
):
    """List places and looks of all images; ``counts`` has the number of images up to each particle."""
    i = first + wp.tid()
    n = wp.int32(0)
    if i > 0:
        n = counts[i - 1]
    q = s.glass_frame * places[i]
    along = wp.vec3i(images_along(s, q, 0, spacing), images_along(s, q, 1, spacing), images_along(s, q, 2, spacing))
    for which in range(27):
        a = which % 3
        b = (which / 3) % 3
        c = which / 9
        if has_image(a, along[0]) and has_image(b, along[1]) and has_image(c, along[2]):
            way = image_along(s, q, 0, a, spacing) + image_along(s, q, 1, b, spacing)
            way += image_along(s, q, 2, c, spacing)
            image_places[n] = wp.transpose(s.glass_frame) * (q + way)
            image_looks[n] = looks[i]
            n += 1


def wetting(stage: Stage, s: Any, particles: Particles, launch: BandLauncher) -> Particles:
    """Return particles with their images behind solids and behind the walls of the container of an `Environment` s."""
    if stage.solids:
        placed = particles.places.numpy().astype(np.float64)
        images, of = mirrored(placed, stage.solids, TOUCHING_SOLID * stage.spacing, stage.spacing)
        particles = particles.and_images(images, of)
    if not stage.cuts:
        return particles
    own, given = {"s": s, "spacing": stage.spacing}, {"places": particles.places, "looks": particles.looks}
    counts = wp.empty(len(particles), dtype=wp.int32, device=particles.places.device)
    launch(count_images, len(particles), **own, places=particles.places, counts=counts)
    wp.utils.array_scan(counts, counts)
    total = last_of(counts)
    found = Particles(*(wp.empty(total, dtype=one, device=counts.device) for one in (wp.vec3, Look)))
    filled = {"image_places": found.places, "image_looks": found.looks}
    launch(list_images, len(particles), **own, **given, counts=counts, **filled)
    return found
