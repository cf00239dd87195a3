"""The level of a fluid on the nodes of a lattice that is fixed in space, where its surface may be.

The lattice is cut into blocks of `WIDTH` cubes along each axis. The level at the corners of all blocks tells which of
them the surface may pass; those alone are looked at more closely.
"""

from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import BandLauncher
from cortado.pictures.tracing.array_types import Floats2d, Ints
from cortado.pictures.tracing.near_particles import MODULE, NearParticles, bump_at, marked, sum_near

WIDTH = wp.constant(4)
"""Cubes along each axis of a block."""
CUBES = wp.constant(64)
"""Cubes of a block."""
LEVEL = wp.constant(wp.float32(0.6))
"""Where the surface is: within fluid the level is about 1."""


@wp.struct
class Blocks:
    """Nodes have whole numbers (i, j, k) from the corner of the first block on; a cube has that of its lowest node."""

    lower: wp.vec3
    """Corner of the first block [m]."""
    cube: wp.float32
    """Width of a cube [m]."""
    shape: wp.vec3i
    """Blocks along each axis."""
    corners: wp.array3d(dtype=wp.float32)
    """(blocks + 1 along each axis) the level at the lower corner of each block"""
    places: Ints
    """(blocks,) how many up to each are in ``levels``, itself among them if it is"""
    levels: Floats2d
    """(blocks that the surface may pass, CUBES) the level at the nodes of each"""


@wp.func
def number_of(b: Blocks, i: wp.int32, j: wp.int32, k: wp.int32):
    return (k * b.shape[1] + j) * b.shape[0] + i


@wp.func
def block_at(b: Blocks, number: wp.int32):
    """Its place along each axis."""
    i = number % b.shape[0]
    j = (number / b.shape[0]) % b.shape[1]
    return wp.vec3i(i, j, number / (b.shape[0] * b.shape[1]))


@wp.func
def index_of(b: Blocks, at: wp.vec3i):
    """That of a block in ``levels``; -1 where it has none, and -2 outside the lattice."""
    if wp.min(wp.min(at[0], at[1]), at[2]) < 0 or at[0] >= b.shape[0] or at[1] >= b.shape[1] or at[2] >= b.shape[2]:
        return -2
    block = number_of(b, at[0], at[1], at[2])
    before = wp.int32(0)
    if block > 0:
        before = b.places[block - 1]
    return wp.where(b.places[block] > before, before, -1)


@wp.func
def entry_of(b: Blocks, node: wp.vec3i):
    """Of a node in ``levels``, as one number; -1 where it has none."""
    index = index_of(b, node / WIDTH)
    if index < 0:
        return -1
    within = ((node[2] % WIDTH) * WIDTH + node[1] % WIDTH) * WIDTH + node[0] % WIDTH
    return index * CUBES + within


@wp.func
def level_at(b: Blocks, node: wp.vec3i):
    """At a node; where it is not known, that of the corner of its block, which is on the same side of the surface."""
    entry = entry_of(b, node)
    if entry < 0:
        return b.corners[node[0] / WIDTH, node[1] / WIDTH, node[2] / WIDTH]
    return b.levels[entry / CUBES, entry % CUBES]


@wp.func
def node_of(block: wp.vec3i, within: wp.int32):
    return WIDTH * block + wp.vec3i(within % WIDTH, (within / WIDTH) % WIDTH, within / (WIDTH * WIDTH))


@wp.func
def place_of(b: Blocks, x: wp.float32, y: wp.float32, z: wp.float32):
    return b.lower + b.cube * wp.vec3(x, y, z)


@wp.func
def volume(s: NearParticles, j: wp.int32):
    return s.volumes[j]


level_near = sum_near(volume, wp.float32)


@wp.kernel(module=MODULE, enable_backward=False)
def mark_corners(first: wp.int32, s: NearParticles, reach: wp.float32, b: Blocks):
    """Give those that a particle may reach a level that is not 0."""
    p = s.places[first + wp.tid()] - b.lower
    wide = b.cube * float(WIDTH)
    low = (p - wp.vec3(reach)) / wide
    high = (p + wp.vec3(reach)) / wide
    for k in range(wp.max(int(wp.ceil(low[2])), 0), wp.min(int(wp.floor(high[2])), b.shape[2]) + 1):
        for j in range(wp.max(int(wp.ceil(low[1])), 0), wp.min(int(wp.floor(high[1])), b.shape[1]) + 1):
            for i in range(wp.max(int(wp.ceil(low[0])), 0), wp.min(int(wp.floor(high[0])), b.shape[0]) + 1):
                b.corners[i, j, k] = 1.0


@wp.kernel(module=MODULE, enable_backward=False)
def find_corners(first: wp.int32, s: NearParticles, reach: wp.float32, b: Blocks):
    n = first + wp.tid()
    columns = b.shape[0] + 1
    rows = b.shape[1] + 1
    i = n % columns
    j = (n / columns) % rows
    k = n / (columns * rows)
    w = float(WIDTH)
    if b.corners[i, j, k] > 0.0:
        b.corners[i, j, k] = level_near(s, place_of(b, w * float(i), w * float(j), w * float(k)), reach)


@wp.kernel(module=MODULE, enable_backward=False)
def find_passed(first: wp.int32, b: Blocks, left: wp.float32, passed: Ints):
    """Which blocks the surface may pass; ``left``: of a bump in the middle of a block, at its corners."""
    n = first + wp.tid()
    at = block_at(b, n)
    least = wp.float32(1.0e9)
    greatest = wp.float32(0.0)
    for corner in range(8):
        level = b.corners[at[0] + (corner & 1), at[1] + ((corner >> 1) & 1), at[2] + (corner >> 2)]
        least = wp.min(least, level)
        greatest = wp.max(greatest, level)
    passed[n] = wp.where(least < 1.0 - left * (1.0 - LEVEL) and greatest > left * LEVEL, 1, 0)


@wp.kernel(module=MODULE, enable_backward=False)
def find_levels(first: wp.int32, s: NearParticles, reach: wp.float32, b: Blocks, blocks: Ints):
    n = first + wp.tid()
    node = node_of(block_at(b, blocks[n / CUBES]), n % CUBES)
    p = place_of(b, float(node[0]), float(node[1]), float(node[2]))
    b.levels[n / CUBES, n % CUBES] = level_near(s, p, reach)


def level_blocks(
    s: Any, ends: tuple[np.ndarray, np.ndarray], cube: float, reach: float, launch: BandLauncher
) -> tuple[Any, wp.array]:
    """`Blocks` around particles s between ``ends``, (3,) each [m], and the numbers of those that the surface may
    pass."""
    device, wide = launch.device, WIDTH * cube
    low, high = np.floor((ends[0] - reach) / wide), np.ceil((ends[1] + reach) / wide)
    b, shape = Blocks(), (high - low).astype(int)
    b.lower, b.cube, b.shape = wp.vec3(*(low * wide)), cube, wp.vec3i(*shape)
    b.corners = wp.zeros(tuple(shape + 1), dtype=wp.float32, device=device)
    launch(mark_corners, len(s.places), s=s, reach=reach, b=b)
    launch(find_corners, b.corners.size, s=s, reach=reach, b=b)
    passed = wp.empty(int(shape.prod()), dtype=wp.int32, device=device)
    launch(find_passed, len(passed), b=b, left=bump_at(0.5 * 3.0**0.5 * wide / reach), passed=passed)
    blocks, b.places = marked(passed, launch)
    b.levels = wp.empty((len(blocks), CUBES), dtype=wp.float32, device=device)
    launch(find_levels, len(blocks) * CUBES, s=s, reach=reach, b=b, blocks=blocks)
    return b, blocks
