"""Average the drawn surface over frames of a film, because fluid at rest would flicker. Particles of fluid at rest
drift by fractions of a spacing. In each block of the lattice, the change of the mean density measures how far the fluid
moves between frames. Moving fluid and drops are not averaged."""

from collections.abc import Sequence
from itertools import takewhile
from typing import Any

import warp as wp

from cortado.device.launching import BandLauncher
from cortado.device.precision import TypesByName
from cortado.pictures.tracing.backdrop import smooth_step
from cortado.pictures.tracing.near_particles import (
    MODULE,
    Floats,
    Floats2d,
    Ints,
    Ints2d,
    NearParticles,
    Vec3s2d,
    count_near,
)
from cortado.pictures.tracing.surface_net import CUBES, WIDTH, Blocks, block_at, index_of, place_of

WINDOW, SHADOW_WINDOW = 30, 6
"""Greatest numbers of frames on each side of the averaged frame: for the surface, and for the shadow."""
LIMITS, LEVEL_LIMITS, SHADOW_LIMITS = (0.35, 0.7), (0.4, 0.8), (0.02, 0.04)
"""Two limits each for the displacement [spacings], the change of density, and the change of light between frames. A
frame has full weight below the first limit and the weight 0 above the second limit."""
BODY_REACH, BODY = 6.0, wp.constant(wp.vec2(7.0, 12.0))
"""Distance [spacings] for counting particles around a block. Numbers of particles that mark a drop and bulk fluid."""
TOUCHING = wp.constant(27)


@wp.struct
class Still:
    """Fluid of one frame of a film, prepared for averages over frames."""

    b: Blocks
    blocks: Ints
    first: wp.vec3i
    means: Floats
    """Mean density of the fluid in each block (blocks,)."""
    bodies: Floats
    """Kind of fluid around each block (blocks,), from 0 for drops to 1 for bulk fluid."""
    light: Vec3s2d
    """Light at each node of the floor (nodes, nodes)."""


@wp.func
def nearness(j: wp.int32, before: wp.int32, window: wp.int32):
    """Return a weight that decreases with the number of frames between frame ``j`` and the averaged frame."""
    away = wp.where(j < before, j, j - before) + 1
    return 1.0 - float(away) / float(window + 1)


typed = TypesByName(
    wp.int32,
    {
        Still: "own",
        wp.array(dtype=Still): "others",
        wp.vec2: "limits",
        wp.float32: "width reach",
        NearParticles: "s",
        Ints2d: "touching indices",
        Floats: "means bodies",
        Floats2d: "ways shares levels",
        Vec3s2d: "found",
    },
)


@wp.kernel(module=MODULE, enable_backward=False)
@typed
def find_means(first, own, s, reach, means, bodies):
    n = first + wp.tid()
    total = wp.float32(0.0)
    for k in range(CUBES):
        total += own.b.levels[n, k]
    means[n] = total / float(CUBES)
    at = wp.float32(WIDTH) * (wp.vec3(block_at(own.b, own.blocks[n])) + wp.vec3(0.5))
    near = count_near(s, place_of(own.b, at[0], at[1], at[2]), reach)
    bodies[n] = 1.0 - smooth_step(BODY[1], BODY[0], near)


@wp.kernel(module=MODULE, enable_backward=False)
@typed
def find_ways(first, own, others, width, touching, indices, ways):
    """Compute the distance [spacings] that the fluid in each block moved between two frames."""
    n = first + wp.tid()
    at = block_at(own.b, own.blocks[n])
    for k in range(TOUCHING):
        touching[n, k] = index_of(own.b, at + wp.vec3i(k % 3 - 1, (k / 3) % 3 - 1, k / 9 - 1))
    for j in range(others.shape[0]):
        other = others[j]
        there = at + own.first - other.first
        index = index_of(other.b, there)
        mean = wp.float32(0.0)
        if index >= 0:
            mean = other.means[index]
        elif index == -1:
            mean = other.b.corners[there[0], there[1], there[2]]
        indices[n, j] = index
        ways[n, j] = width * wp.abs(mean - own.means[n])


@wp.kernel(module=MODULE, enable_backward=False)
@typed
def find_shares(first, touching, ways, bodies, before, window, limits, shares):
    n = first + wp.tid()
    left = bodies[n]
    for j in range(ways.shape[1]):
        if j == before:
            left = bodies[n]
        if left > 0.0:
            total = wp.float32(0.0)
            weights = wp.float32(0.0)
            for k in range(TOUCHING):
                m = touching[n, k]
                if m >= 0:
                    off = wp.abs(k % 3 - 1) + wp.abs((k / 3) % 3 - 1) + wp.abs(k / 9 - 1)
                    weight = 1.0 / float(1 << off)
                    total += weight * ways[m, j] * ways[m, j]
                    weights += weight
            left *= smooth_step(limits[1], limits[0], wp.max(wp.sqrt(total / weights), ways[n, j]))
        shares[n, j] = left * nearness(j, before, window)


@wp.kernel(module=MODULE, enable_backward=False)
@typed
def average_level(first, own, others, before, limits, indices, shares, levels):
    n = (first + wp.tid()) / CUBES
    k = (first + wp.tid()) % CUBES
    level = own.b.levels[n, k]
    total = wp.float32(0.0)
    weights = wp.float32(1.0)
    left = wp.float32(1.0)
    for j in range(others.shape[0]):
        if j == before:
            left = 1.0
        if left > 0.0 and shares[n, j] > 0.0 and indices[n, j] >= 0:
            change = others[j].b.levels[indices[n, j], k] - level
            left *= smooth_step(limits[1], limits[0], wp.abs(change))
            total += left * shares[n, j] * change
            weights += left * shares[n, j]
    levels[n, k] = level + total / weights


@wp.kernel(module=MODULE, enable_backward=False)
@typed
def average_light(first, own, others, before, window, limits, found):
    i = (first + wp.tid()) / found.shape[1]
    k = (first + wp.tid()) % found.shape[1]
    light = own.light[i, k]
    total = wp.vec3(0.0)
    weights = wp.float32(1.0)
    left = wp.float32(1.0)
    for j in range(others.shape[0]):
        if j == before:
            left = 1.0
        if left > 0.0 and wp.min(light) < 1.0:
            change = others[j].light[i, k] - light
            left *= smooth_step(limits[1], limits[0], wp.max(wp.abs(change)))
            weight = left * wp.max(nearness(j, before, window), 0.0)
            total += weight * change
            weights += weight
    found[i, k] = light + total / weights


def still_of(level: tuple[Any, wp.array], s: Any, light: wp.array, launch: BandLauncher) -> Any:
    found = Still()
    found.b, found.blocks = level
    wide = found.b.cube * float(WIDTH)
    found.first, found.light = wp.vec3i(*(round(end / wide) for end in found.b.lower)), light
    means, bodies = (wp.empty(len(found.blocks), dtype=wp.float32, device=launch.device) for _ in range(2))
    launch(find_means, len(means), own=found, s=s, reach=BODY_REACH * s.spacing, means=means, bodies=bodies)
    found.means, found.bodies = means, bodies
    return found


def steadied(own: Any, before: Sequence[Any], after: Sequence[Any], spacing: float, launch: BandLauncher) -> Any:
    """Average the frame ``own`` with frames ``before`` and ``after`` this frame, both in order of distance."""
    before, after = (list(takewhile(lambda other: other.b.cube == own.b.cube, side)) for side in (before, after))
    if not before and not after:
        return own
    device, count, shape = launch.device, len(own.blocks), (len(own.blocks), len(before) + len(after))
    found, others = own.to(device), {"others": wp.array([*before, *after], dtype=Still, device=device)}
    touching, indices = (wp.empty(size, dtype=wp.int32, device=device) for size in ((count, int(TOUCHING)), shape))
    ways, shares = (wp.empty(shape, dtype=wp.float32, device=device) for _ in range(2))
    own_ways = {"indices": indices, "touching": touching, "ways": ways}
    launch(find_ways, count, own=own, **others, width=own.b.cube * float(WIDTH) / spacing, **own_ways)
    given = {"before": len(before), "limits": wp.vec2(*LIMITS), "window": WINDOW}
    launch(find_shares, count, touching=touching, ways=ways, bodies=own.bodies, **given, shares=shares)
    found.b.levels, found.light = wp.empty_like(own.b.levels), wp.empty_like(own.light)
    given = {"before": len(before), "limits": wp.vec2(*LEVEL_LIMITS), "indices": indices, "shares": shares}
    launch(average_level, own.b.levels.size, own=own, **others, **given, levels=found.b.levels)
    given = {"before": len(before), "limits": wp.vec2(*SHADOW_LIMITS), "window": SHADOW_WINDOW}
    launch(average_light, own.light.size, own=own, **others, **given, found=found.light)
    return found
