"""The isosurface of a fluid density as a surface net of quadrilaterals (Gibson 1998). The net has one corner in each
lattice cube that the surface crosses, and a quadrilateral for each crossed edge of a cube. Blocks of `WIDTH` cubes
along each axis divide the lattice. The density (``level``) is computed only in blocks that may contain the surface."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import BandLauncher
from cortado.pictures.tracing.near_particles import (
    MODULE,
    Floats,
    Floats2d,
    Ints,
    NearParticles,
    Vec3s,
    bump_at,
    last_of,
    marked,
    sum_near,
)

WIDTH = wp.constant(4)
"""Number of cubes along each axis of a block."""
CUBES = wp.constant(64)
LEVEL = wp.constant(wp.float32(0.6))
"""Density at the isosurface. The density inside fluid is about 1."""
ROUNDS_OF_NORMALS = 15
Neighbours = wp.types.vector(6, wp.int32)
"""Indices of the net corners in the six adjacent cubes, or -1 for a cube without a net corner."""


@wp.struct
class Blocks:
    """The density of fluid on a lattice of cubes, which is divided into blocks."""

    lower: wp.vec3
    cube: wp.float32
    """Width of a cube [m]."""
    shape: wp.vec3i
    corners: wp.array3d(dtype=wp.float32)
    """Density at the corners of all blocks, a 3-D array."""
    places: Ints
    """Cumulative count of the blocks that may contain the surface (blocks,)."""
    levels: Floats2d
    """Density at the nodes of the k blocks that may contain the surface (k, CUBES)."""


@wp.func
def number_of(b: Blocks, i: wp.int32, j: wp.int32, k: wp.int32):
    return (k * b.shape[1] + j) * b.shape[0] + i


@wp.func
def block_at(b: Blocks, number: wp.int32):
    i = number % b.shape[0]
    j = (number / b.shape[0]) % b.shape[1]
    return wp.vec3i(i, j, number / (b.shape[0] * b.shape[1]))


@wp.func
def index_of(b: Blocks, at: wp.vec3i):
    """Return the index of a block in ``levels``, -1 for a block without levels, or -2 outside the lattice."""
    if wp.min(wp.min(at[0], at[1]), at[2]) < 0 or at[0] >= b.shape[0] or at[1] >= b.shape[1] or at[2] >= b.shape[2]:
        return -2
    block = number_of(b, at[0], at[1], at[2])
    before = wp.int32(0)
    if block > 0:
        before = b.places[block - 1]
    return wp.where(b.places[block] > before, before, -1)


@wp.func
def entry_of(b: Blocks, node: wp.vec3i):
    index = index_of(b, node / WIDTH)
    if index < 0:
        return -1
    within = ((node[2] % WIDTH) * WIDTH + node[1] % WIDTH) * WIDTH + node[0] % WIDTH
    return index * CUBES + within


@wp.func
def level_at(b: Blocks, node: wp.vec3i):
    """Return the density at a node. In blocks without a surface, return the density at the block's corner."""
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


@wp.kernel(module=MODULE, enable_backward=False)
def mark_corners(first: wp.int32, s: NearParticles, reach: wp.float32, b: Blocks):
    """Set ``b.corners`` to 1 at corners within ``reach`` [m] of a particle along each axis."""
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
    """Return the density in the box ``ends`` (3,) [m], extended by ``reach`` [m], and the indices of the blocks that
    may contain the surface."""
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


@wp.struct
class Cubes:
    b: Blocks
    blocks: Ints
    """Indices of the blocks that may contain the surface."""
    corners: Ints
    """Number of net corners before each cube (cubes + 1,)."""
    sides: Ints
    """Number of quadrilaterals before each cube (cubes + 1,)."""


@wp.func
def signs_of(b: Blocks, node: wp.vec3i):
    """Return a bit mask of the nodes inside the fluid. The bit x + 2 y + 4 z stands for the node at (x, y, z)."""
    signs = wp.int32(0)
    for n in range(8):
        if level_at(b, node + wp.vec3i(n & 1, (n >> 1) & 1, n >> 2)) > LEVEL:
            signs = signs | (1 << n)
    return signs


@wp.kernel(module=MODULE, enable_backward=False)
def count_corners(first: wp.int32, b: Blocks, blocks: Ints, signs: Ints, corners: Ints, sides: Ints):
    n = first + wp.tid()
    found = signs_of(b, node_of(block_at(b, blocks[n / CUBES]), n % CUBES))
    signs[n] = found
    corners[n] = wp.where(found > 0 and found < 255, 1, 0)
    low = found & 1
    sides[n] = ((found >> 1) & 1 ^ low) + ((found >> 2) & 1 ^ low) + ((found >> 4) & 1 ^ low)


@wp.func
def corner_in(cubes: Cubes, node: wp.vec3i):
    entry = entry_of(cubes.b, node)
    if entry < 0:
        return -1
    number = cubes.corners[entry]
    return wp.where(cubes.corners[entry + 1] > number, number, -1)


@wp.func
def along(axis: wp.int32):
    return wp.vec3i(wp.where(axis == 0, 1, 0), wp.where(axis == 1, 1, 0), wp.where(axis == 2, 1, 0))


@wp.func
def differ(signs: wp.int32, m: wp.int32, n: wp.int32):
    return ((signs >> m) ^ (signs >> n)) & 1 == 1


@wp.kernel(module=MODULE, enable_backward=False)
def place_corners(
    first: wp.int32, cubes: Cubes, signs: Ints, points: Vec3s, own_signs: Ints, neighbours: wp.array(dtype=Neighbours)
):
    n = first + wp.tid()
    v = cubes.corners[n]
    if cubes.corners[n + 1] == v:
        return
    node = node_of(block_at(cubes.b, cubes.blocks[n / CUBES]), n % CUBES)
    found = signs[n]
    place = wp.vec3(0.0)
    count = wp.float32(0.0)
    for axis in range(3):
        step = 1 << axis
        way = along(axis)
        for corner in range(8):
            if corner & step == 0 and differ(found, corner, corner + step):
                end = node + wp.vec3i(corner & 1, (corner >> 1) & 1, corner >> 2)
                low = level_at(cubes.b, end)
                part = (LEVEL - low) / (level_at(cubes.b, end + way) - low)
                place += wp.vec3(float(end[0]), float(end[1]), float(end[2]))
                place[axis] += part
                count += 1.0
    place = place / count
    points[v] = place_of(cubes.b, place[0], place[1], place[2])
    own_signs[v] = found
    beside = Neighbours()
    for axis in range(3):
        # a face is passed if its four nodes differ
        face = wp.where(axis == 0, 0x55, wp.where(axis == 1, 0x33, 0x0F))
        lower = found & face
        upper = (found >> (1 << axis)) & face
        beside[2 * axis] = -1
        beside[2 * axis + 1] = -1
        if lower != 0 and lower != face:
            beside[2 * axis] = corner_in(cubes, node - along(axis))
        if upper != 0 and upper != face:
            beside[2 * axis + 1] = corner_in(cubes, node + along(axis))
    neighbours[v] = beside


@wp.kernel(module=MODULE, enable_backward=False)
def list_triangles(first: wp.int32, cubes: Cubes, signs: Ints, points: Vec3s, triangles: Ints):
    """Split each quadrilateral into two triangles along its shorter diagonal."""
    n = first + wp.tid()
    side = cubes.sides[n]
    if cubes.sides[n + 1] == side:
        return
    node = node_of(block_at(cubes.b, cubes.blocks[n / CUBES]), n % CUBES)
    for axis in range(3):
        if differ(signs[n], 0, 1 << axis):
            u = along((axis + 1) % 3)
            w = along((axis + 2) % 3)
            outwards = signs[n] & 1 == 1
            p = corner_in(cubes, node - u - w)
            q = corner_in(cubes, node - wp.where(outwards, w, u))
            r = corner_in(cubes, node)
            s = corner_in(cubes, node - wp.where(outwards, u, w))
            if wp.min(wp.min(p, q), wp.min(r, s)) < 0:  # none there
                p, q, r, s = 0, 0, 0, 0
            t = 6 * side
            other = wp.length_sq(points[p] - points[r]) > wp.length_sq(points[q] - points[s])
            triangles[t] = p
            triangles[t + 1] = q
            triangles[t + 2] = wp.where(other, s, r)
            triangles[t + 3] = r
            triangles[t + 4] = s
            triangles[t + 5] = wp.where(other, q, p)
            side += 1


@wp.func
def sum_beside(beside: Neighbours, values: Vec3s):
    total = wp.vec3(0.0)
    count = wp.float32(0.0)
    for k in range(6):
        if beside[k] >= 0:
            total += values[beside[k]]
            count += 1.0
    return total, count


@wp.kernel(module=MODULE, enable_backward=False)
def smooth(first: wp.int32, neighbours: wp.array(dtype=Neighbours), weights: Floats, values: Vec3s, found: Vec3s):
    v = first + wp.tid()
    total, count = sum_beside(neighbours[v], values)
    found[v] = wp.lerp(values[v], total / wp.max(count, 1.0), wp.where(count > 0.0, weights[v], 0.0))


@wp.kernel(module=MODULE, enable_backward=False)
def find_normals(first: wp.int32, signs: Ints, neighbours: wp.array(dtype=Neighbours), points: Vec3s, normals: Vec3s):
    """The normal is the mean over the adjacent quadrilaterals, weighted by area."""
    v = first + wp.tid()
    beside = neighbours[v]
    total = wp.vec3(0.0)
    for axis in range(3):
        a = (axis + 1) % 3
        b = (axis + 2) % 3
        for which in range(4):
            m = which & 1
            n = which >> 1
            low = (m << a) | (n << b)
            if differ(signs[v], low, low | (1 << axis)):
                p = beside[2 * a + m]
                q = beside[2 * b + n]
                if p >= 0 and q >= 0:
                    across = wp.cross(points[p] - points[v], points[q] - points[v])
                    outwards = wp.where((signs[v] >> low) & 1 == 1, 1.0, -1.0)
                    turned = wp.where(m == n, 1.0, -1.0)
                    total += outwards * turned * across
    normals[v] = wp.normalize(total)


@wp.kernel(module=MODULE, enable_backward=False)
def smooth_normals(first: wp.int32, neighbours: wp.array(dtype=Neighbours), values: Vec3s, found: Vec3s):
    v = first + wp.tid()
    total, _count = sum_beside(neighbours[v], values)
    if wp.length_sq(total) == 0.0:
        total = values[v]
    found[v] = wp.normalize(total)


@dataclass(frozen=True)
class SurfaceNet:
    cubes: Any
    cube_signs: wp.array
    points: wp.array
    """Positions of the net corners (corners,) [m]."""
    signs: wp.array
    neighbours: wp.array
    sides: int


def net_of(b: Any, blocks: wp.array, launch: BandLauncher) -> SurfaceNet:
    """``blocks`` are the indices of the blocks that may contain the surface."""
    device, count, cubes = launch.device, len(blocks) * CUBES, Cubes()
    signs = wp.empty(count, dtype=wp.int32, device=device)
    cubes.b, cubes.blocks = b, blocks
    cubes.corners, cubes.sides = (wp.zeros(count + 1, dtype=wp.int32, device=device) for _ in range(2))
    launch(count_corners, count, b=b, blocks=blocks, signs=signs, corners=cubes.corners, sides=cubes.sides)
    for counts in (cubes.corners, cubes.sides):
        wp.utils.array_scan(counts, counts, inclusive=False)
    corners, sides = last_of(cubes.corners), last_of(cubes.sides)
    points, own, beside = (wp.empty(corners, dtype=kind, device=device) for kind in (wp.vec3, wp.int32, Neighbours))
    launch(place_corners, count, cubes=cubes, signs=signs, points=points, own_signs=own, neighbours=beside)
    return SurfaceNet(cubes, signs, points, own, beside, sides)


def smoothed(values: wp.array, neighbours: wp.array, weights: wp.array, rounds: int, launch: BandLauncher) -> wp.array:
    """Each round moves vectors (p,) towards the mean of their neighbours, by the fractions ``weights`` (p,)."""
    own = {"neighbours": neighbours, "weights": weights}
    return launch.to_and_fro(smooth, rounds, wp.clone(values), wp.empty_like(values), **own)


def normals_of(net: SurfaceNet, points: wp.array, launch: BandLauncher) -> wp.array:
    """Return outward unit normals (p,) at net corners with the positions ``points`` (p,)."""
    normals, other = wp.empty_like(points), wp.empty_like(points)
    launch(find_normals, len(points), signs=net.signs, neighbours=net.neighbours, points=points, normals=normals)
    return launch.to_and_fro(smooth_normals, ROUNDS_OF_NORMALS, normals, other, neighbours=net.neighbours)


def triangles_of(net: SurfaceNet, points: wp.array, launch: BandLauncher) -> wp.array:
    """Return indices (3 t,) of the net corners at the corners of t triangles."""
    found = wp.empty(6 * net.sides, dtype=wp.int32, device=launch.device)
    launch(list_triangles, len(net.cube_signs), cubes=net.cubes, signs=net.cube_signs, points=points, triangles=found)
    return found


level_near = sum_near(volume, wp.float32)
