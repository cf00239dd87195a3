"""A ray tracer for a fluid surface that reflects, refracts, absorbs and scatters light.

Over a length L in fluid, the fraction 1 - exp(-scattering L) of the ray's light becomes scattered light. Scattered
light has the fluid's colour and the brightness of the light on the fluid's surface. By the Beer-Lambert law, absorption
multiplies the remaining light by colour^(absorption L). Along the whole ray, the fluid has the optical properties of
the point at which the ray enters.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import TypesByName
from cortado.pictures.tracing.backdrop import (
    FAR,
    OPAQUE,
    Environment,
    LitSurface,
    SurfaceHit,
    at_corners,
    mirrored,
    schlick,
    shading_module,
    sky,
)
from cortado.pictures.tracing.near_particles import Ints, Vec2s, Vec3s, Vec3s2d
from cortado.pictures.tracing.ray_hits import glass_functions, meet_solid, reach_solid, shaded_solid, surface_functions
from cortado.scene.appearance import Picture


class Effort(NamedTuple):
    cube: float
    """Smallest width of a lattice cube for the fluid's surface [spacings]."""
    segments: int
    contrast: float
    """Contrast in linear light between adjacent pixels, above which a pixel gets additional rays."""
    again: int
    """Number of additional rays of a pixel."""
    lights: tuple[int, int]
    """Numbers of rays that measure the light at a surface point: rays in all directions, and rays towards the lamp."""


EFFORTS = {"traced": Effort(0.0, 4, 0.045, 4, (20, 4)), "quick": Effort(0.5, 1, 0.045, 2, (8, 2))}
SPHERE_LIGHTS, SOLID_LIGHTS = (10, 1), (40, 6)
"""Values of `Effort.lights` for spheres and for solids."""


def effort_of(picture: Picture) -> Effort:
    return EFFORTS[picture.quality or "traced"]


BOUNCED = wp.constant(wp.float32(0.45))
"""Fraction of the ambient light that a solid reflects."""


@wp.func
def past_solids(s: Environment, p: wp.vec3, d: wp.vec3, reach: wp.float32, light: wp.vec3):
    """A solid within ``reach`` [m] blocks light and adds light of its colour. A near solid blocks more than a distant
    solid. For a point inside a solid, no light is blocked."""
    hit = wp.mesh_query_ray(s.solids.opaque, p, d, reach)
    if not hit.result or hit.sign < 0.0:
        return light
    point = s.solids.surfaces[OPAQUE].corners[3 * hit.face]
    colour = s.solids.surfaces[OPAQUE].colours[point]
    return wp.lerp(BOUNCED * wp.cw_mul(colour, s.horizon), light, 0.35 * hit.t / reach)


typed = TypesByName(
    wp.float32,
    {
        wp.int32: "first",
        Environment: "s",
        LitSurface: "surface",
        Vec3s: "points normals directions light image sun",
        Vec3s2d: "shadow",
        Ints: "pixels",
        Vec2s: "offsets",
        wp.vec3: "start direction",
        SurfaceHit: "entered",
    },
)


@cache
def illuminate_kernel(has_opaque: bool, has_clear: bool) -> Any:
    module = shading_module(has_opaque, has_clear)

    @wp.kernel(module=module, enable_backward=False)
    @typed
    def illuminate(first, s, surface, points, normals, directions, sun_directions, reach, clearness, light):
        i = first + wp.tid()
        n = normals[i]
        p = points[i] + s.nearest * n
        is_under_floor = s.has_floor > 0 and p[1] < s.floor_height and n[1] < 0.0  # not seen: nothing is in its way
        around = wp.vec3(0.0)
        for k in range(directions.shape[0]):
            d = wp.normalize(n + 0.999 * directions[k])  # cosine-weighted
            arriving = wp.lerp(s.horizon, s.zenith, wp.max(d[1], 0.0))
            if d[1] < 0.0:
                arriving = 0.55 * s.floor_colour
            if not is_under_floor:
                hit = wp.mesh_query_ray(surface.mesh, p, d, reach)
                if hit.result:
                    arriving = arriving * wp.max(clearness, 0.35 * hit.t / reach)
            if has_opaque:
                arriving = past_solids(s, p, d, reach, arriving)
            around += arriving
        around = around / wp.float32(directions.shape[0])
        cosine = wp.max(wp.dot(n, s.sun), 0.0)
        sunlight = wp.float32(0.0)
        if cosine > 0.0:
            for k in range(sun_directions.shape[0]):
                arriving_sun = wp.float32(1.0)
                if wp.mesh_query_ray_anyhit(surface.mesh, p, sun_directions[k], FAR):
                    arriving_sun = clearness
                if has_opaque:
                    solid = wp.mesh_query_ray(s.solids.opaque, p, sun_directions[k], FAR)
                    if solid.result and solid.sign > 0.0:
                        arriving_sun = 0.0
                sunlight += arriving_sun
            sunlight = sunlight * cosine / wp.float32(sun_directions.shape[0])
        light[i] = 0.70 * around + s.sunlight * sunlight

    return illuminate


INDEX = wp.constant(wp.float32(1.33))
FAINT = wp.constant(wp.float32(0.05))
"""Reflectance of the fluid's surface above which a ray is split."""
DARK = wp.constant(wp.float32(10.0))
"""Number of mean free paths in fluid after which light is neglected."""


@wp.struct
class Eye:
    """The ray of a pixel has the direction ``forward + a right + b up``, with a and b from -1 to 1."""

    position: wp.vec3
    forward: wp.vec3
    right: wp.vec3
    up: wp.vec3
    columns: wp.int32
    rows: wp.int32


@wp.func
def toned(colour: wp.vec3):
    """Compress bright light to values below 1. Light up to 0.75 is unchanged."""
    found = wp.vec3(0.0)
    for k in range(3):
        x = colour[k]
        if x > 0.75:
            x = 0.75 + 0.25 * (1.0 - wp.exp(-(x - 0.75) / 0.25))
        found[k] = wp.max(x, 0.0)
    return found


@wp.func
def tinted(colour: wp.vec3, taken: wp.float32):
    """Return the colour of white light after absorption in the fluid. ``taken`` is the absorbed fraction."""
    base = wp.vec3(wp.max(colour[0], 0.02), wp.max(colour[1], 0.02), wp.max(colour[2], 0.02))
    return wp.vec3(wp.pow(base[0], taken), wp.pow(base[1], taken), wp.pow(base[2], taken))


@cache
def trace_kernel(has_opaque: bool, has_clear: bool) -> Any:
    module = shading_module(has_opaque, has_clear)
    glass, background = glass_functions(has_opaque, has_clear)
    meet, leave = surface_functions(has_opaque, has_clear)

    @wp.func
    @typed
    def within(s, shadow, surface, start, direction, entered, spread):
        """Return the light along a ray inside the fluid."""
        found = wp.vec3(0.0)
        through = wp.vec3(1.0)
        o = start
        d = direction
        c = entered.colour
        lit = entered.light
        medium = at_corners(surface, surface.media, entered.face, entered.u, entered.v)
        inside = wp.bool(True)
        for _ in range(s.segments):
            if inside:
                met = leave(s, surface, o, d, wp.min(DARK / wp.max(medium[0], 1.0e-6), FAR))
                left = wp.exp(-medium[0] * met.t)
                soft = 0.55 * lit + wp.vec3(0.40)
                found += wp.cw_mul(through, wp.cw_mul(c, soft)) * (1.0 - left)
                taken = medium[1] * met.t
                through = wp.cw_mul(through, tinted(c, taken)) * left
                if met.is_solid:
                    return found + wp.cw_mul(through, shaded_solid(s, met, d, 0.0))
            else:
                met = meet(s, surface, o, d)
            if not met.found or wp.max(wp.max(through[0], through[1]), through[2]) < 0.02:
                break
            p = o + met.t * d
            n = met.normal
            cosine = -wp.dot(n, d)
            if inside:
                outside = wp.sqrt(wp.max(1.0 - INDEX * INDEX * (1.0 - cosine * cosine), 0.0))  # cosine there
                kept = wp.max(schlick(0.02, outside) - FAINT, 0.0) / (1.0 - FAINT)
                refracted = wp.normalize(INDEX * d + (INDEX * cosine - outside) * n)
                if kept > 0.0 and outside > 0.0:
                    if meet(s, surface, p - s.nearest * n, refracted).found:
                        kept = 0.0  # it goes on through that
                    else:
                        leaving = background(s, shadow, p - s.nearest * n, refracted, spread)
                        found += (1.0 - kept) * wp.cw_mul(through, leaving)
                        through = kept * through
                if kept > 0.0:
                    d = wp.normalize(mirrored(d, n))
                    o = p + s.nearest * n
                else:
                    d = refracted
                    o = p - s.nearest * n
                    inside = False
            else:
                passed = glass(s, o, d, met.t, spread)
                found += wp.cw_mul(through, passed.light)
                through = through * passed.through
                reflectance = schlick(0.02, cosine)
                r = wp.normalize(mirrored(d, n))
                found += wp.cw_mul(through, sky(s, wp.vec3(r[0], wp.abs(r[1]), r[2]))) * reflectance
                through = through * (1.0 - reflectance)
                c = met.colour
                lit = met.light
                medium = at_corners(surface, surface.media, met.face, met.u, met.v)
                sine2 = (1.0 - cosine * cosine) / (INDEX * INDEX)
                d = wp.normalize(d / INDEX + (cosine / INDEX - wp.sqrt(1.0 - sine2)) * n)
                o = p - s.nearest * n
                inside = True
        if inside:
            left_over = tinted(c, wp.min(medium[1] * s.size, 1.0))  # it goes on to and fro
            return found + wp.cw_mul(through, wp.cw_mul(left_over, lit))
        return found + wp.cw_mul(through, background(s, shadow, o, d, spread))

    @wp.func
    def seen(s: Environment, shadow: Vec3s2d, surface: LitSurface, o: wp.vec3, d: wp.vec3, spread: wp.float32):
        met = meet(s, surface, o, d)
        floor_at = FAR
        if s.has_floor > 0 and d[1] < -1.0e-4:
            floor_at = (s.floor_height - o[1]) / d[1]
        if met.t > floor_at or not met.found:
            found = background(s, shadow, o, d, spread)
            solid_at = FAR
            if has_opaque:
                solid_at = reach_solid(s, o, d).t
            if floor_at < solid_at:  # the floor is a little glossy
                r = wp.vec3(d[0], -d[1], d[2])
                p = o + floor_at * d
                image = meet(s, surface, p, r)
                instead_of = sky(s, r)
                if has_opaque:
                    solid = meet_solid(s, p + wp.vec3(0.0, s.nearest, 0.0), r)
                    if not image.found:
                        image = solid
                        instead_of = found
                if image.found:
                    strength = schlick(0.04, -d[1]) * wp.exp(-2.5 * image.t / s.size)
                    found += strength * (wp.cw_mul(image.colour, image.light) - instead_of)
            return toned(found)
        if surface.is_flat > 0:
            return met.colour
        p = o + met.t * d
        n = met.normal
        cosine = -wp.dot(n, d)
        reflectance = schlick(0.02, cosine)
        r = wp.normalize(mirrored(d, n))
        start = p + s.nearest * n
        other = meet(s, surface, start, r)
        reflected = wp.cw_mul(other.colour, other.light)
        if not other.found:
            reflected = background(s, shadow, start, r, spread)
        sine2 = (1.0 - cosine * cosine) / (INDEX * INDEX)
        refracted = wp.normalize(d / INDEX + (cosine / INDEX - wp.sqrt(1.0 - sine2)) * n)
        body = within(s, shadow, surface, p - s.nearest * n, refracted, met, spread)
        passed = glass(s, o, d, met.t + 2.0 * s.nearest, spread)
        return toned(passed.light + passed.through * (reflectance * reflected + (1.0 - reflectance) * body))

    @wp.kernel(module=module, enable_backward=False)
    @typed
    def trace(first, eye: Eye, s, surface, shadow, pixels, offsets, image):
        """The light of a pixel is the mean over rays at ``offsets`` from the pixel's middle [pixels]."""
        pixel = pixels[first + wp.tid()]
        spread = 2.0 * wp.length(eye.right) / wp.float32(eye.columns)
        light = wp.vec3(0.0)
        for k in range(offsets.shape[0]):
            a = 2.0 * (wp.float32(pixel % eye.columns) + 0.5 + offsets[k][0]) / wp.float32(eye.columns) - 1.0
            b = 1.0 - 2.0 * (wp.float32(pixel / eye.columns) + 0.5 + offsets[k][1]) / wp.float32(eye.rows)
            d = wp.normalize(eye.forward + a * eye.right + b * eye.up)
            light += seen(s, shadow, surface, eye.position, d, spread)
        image[pixel] = light / wp.float32(offsets.shape[0])

    return trace


ROTATED_GRID = ((-0.375, -0.125), (0.375, 0.125), (-0.125, 0.375), (0.125, -0.375))
"""Offsets of additional rays from the middle of a pixel [pixels]."""
MIDDLE = ((0.0, 0.0),)
TILE = 8, 4


def in_tiles(columns: int, rows: int) -> np.ndarray:
    """Return the indices of the pixels on the white squares of a chequerboard, ordered in small tiles."""
    wide, high = TILE
    row, column = np.divmod(np.arange(columns * rows), columns)
    tile = (row // high) * -(-columns // wide) + column // wide
    numbers = np.argsort(tile, kind="stable").astype(np.int32)
    return numbers[((row + column) % 2 == 0)[numbers]]


@wp.kernel(module=kernel_module("contrast"), enable_backward=False)
def find_contrast(first: wp.int32, columns: wp.int32, image: Vec3s, contrast: wp.float32, found: Ints):
    """Fill the missing half of a chequerboard image: each missing pixel is the mean of its neighbours. Set ``found`` to
    1 at pixels that differ from neighbouring pixels by more than ``contrast``."""
    i = first + wp.tid()
    column = i % columns
    row = i / columns
    rows = image.shape[0] / columns
    black = (column + row) % 2
    least = wp.vec3(1.0e9)
    greatest = wp.vec3(-1.0e9)
    if black == 0:
        least = image[i]
        greatest = image[i]
    total = wp.vec3(0.0)
    count = wp.float32(0.0)
    for k in range(4):
        across = 2 * (k & 1) - 1
        down = 2 * (k >> 1) - 1
        if black > 0:  # beside, above and below it
            across, down = (across + down) // 2, (across - down) // 2
        if column + across >= 0 and column + across < columns and row + down >= 0 and row + down < rows:
            light = image[i + down * columns + across]
            least = wp.min(least, light)
            greatest = wp.max(greatest, light)
            total += light
            count += 1.0
    off = greatest - least
    found[i] = wp.where(wp.max(wp.max(off[0], off[1]), off[2]) > contrast, 1, 0)
    if black > 0:
        image[i] = total / count
